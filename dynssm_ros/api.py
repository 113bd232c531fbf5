"""The Python API: one function for each command, from data to data. The command line calls these and prints.

All functions take vehicles, models, signal maps and tracks by shipped name, by path, or as the object itself. Nothing is
printed; ``on_progress`` is called with what is done and what there is to do. What is wrong with the input raises a
:class:`~dynssm_ros.errors.UserError` whose message is one line; data that look wrong a
:class:`~dynssm_ros.errors.DataWarning`.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from dynssm_ros import __version__
from dynssm_ros.errors import ConfigurationError, DataWarning
from dynssm_ros.extras import require
from dynssm_ros.files import checksum, content_key, digest, write_json
from dynssm_ros.parallel import HERE, Workers, connected, each
from dynssm_ros.progress import Progress
from dynssm_ros.runtime.plausibility import implausible_rows
from dynssm_ros.signals.recording import Recording, concatenate
from dynssm_ros.signals.season import Season, recording_files
from dynssm_ros.signals.signal_map import Commands, SignalMap, load_signal_map
from dynssm_ros.vehicle import Vehicle, load_vehicle
from dynssm_ros.vehicle.integrators import Integrator
from dynssm_ros.vehicle.kinematics import PATH_HORIZON_S

if TYPE_CHECKING:
    from dynssm_ros.control.race import Race
    from dynssm_ros.control.settings import Objective
    from dynssm_ros.evaluation.open_loop import Evaluation
    from dynssm_ros.evaluation.season_review import Review
    from dynssm_ros.evaluation.sweep import Errors, Space, Sweep
    from dynssm_ros.identification.result.calibration import Calibration
    from dynssm_ros.identification.result.diagnosis import Diagnosis
    from dynssm_ros.learning.models.base import ModelConfig
    from dynssm_ros.learning.stages import Trained
    from dynssm_ros.runtime.artifact import Artifact
    from dynssm_ros.runtime.contract import WindowModel
    from dynssm_ros.signals.inspection import Inspection
    from dynssm_ros.signals.season import Session
    from dynssm_ros.simulation.laps import Run
    from dynssm_ros.simulation.plant import PlantKind
    from dynssm_ros.track.racing_line import LineKind
    from dynssm_ros.track.tracks import Track

PathLike = str | Path
Log = Recording | PathLike
"""A recording, or the Parquet file of one."""


def load_model(name_or_dir: PathLike, vehicle: Vehicle | PathLike | None = None) -> WindowModel:
    """Opens a trained model's folder, or one of the baselines ``persistence``, ``single_track``, ``single_track_ewma`` and
    ``single_track_ekf``.

    Example:
        >>> model = load_model("single_track", "orca")
        >>> model.H, model.T_s
        (1, 0.02)
    """
    from dynssm_ros.runtime.registry import load_model

    return load_model(name_or_dir, None if vehicle is None else _vehicle_in_windows(vehicle))


def simulate(
    vehicle: Vehicle | PathLike,
    track: Track | PathLike,
    duration: float | None = None,
    laps: float | None = None,
    plant: PlantKind = "euler",
    line: LineKind = "centre",
    seed: int = 0,
    aggressiveness: float = 0.95,
    variation: float = 0.5,
    noise: tuple[float, float, float] = (0.0, 0.0, 0.0),
    effects: Mapping[str, Mapping[str, float]] | None = None,
    scale: float = 1.0,
    on_progress: Progress | None = None,
) -> Run:
    """Drives a simulated car around a track.

    Args:
        vehicle: the car.
        track: ``oval``, ``road_course``, ``club``, ``club_b``, or a file ``x_m,y_m,w_tr_right_m,w_tr_left_m``.
        duration: time to drive (s); 60 if neither this nor ``laps``.
        laps: laps to drive, instead of a duration.
        plant: ``euler``, ``rk4`` or ``double_track``.
        line: what the driver follows: ``centre`` or ``racing``.
        seed: of the driver's variation and the noise.
        aggressiveness: share of the car's limits in use.
        variation: how much speed and line vary, 0 to 1.
        noise: standard deviations of the measured ``v_x, v_y, omega`` (m/s, m/s, rad/s).
        effects: physics that the vehicle file does not have, by name, with parameters.
        scale: of the track.
        on_progress: called with simulated milliseconds or metres.

    Example:
        >>> run = simulate("orca", "club", duration=2.0, effects={"front_grip": {"factor": 0.9}})
        >>> run.state.shape
        (101, 3)
    """
    require("simulate", "race")
    from dynssm_ros.simulation.laps import simulate
    from dynssm_ros.track.driver import Style
    from dynssm_ros.track.racing_line import line_of

    car = _vehicle(vehicle).with_effects((name, dict(values)) for name, values in (effects or {}).items())
    course = _track(track).scaled(scale)
    if duration is None and laps is None:
        duration = 60.0
    style = Style(aggressiveness, variation)
    return simulate(
        car, course, duration, laps, plant, seed=seed, style=style, line=line_of(line, car, course), noise=noise,
        progress=on_progress,
    )  # fmt: skip


def inspect(
    bag: PathLike, vehicle: Vehicle | PathLike | None = None, on_progress: Progress | None = None
) -> Inspection:
    """Says what is in a race log: topics, rates, gaps, clocks, and a first signal map.

    Args:
        bag: rosbag2 folder or ``.mcap``/``.db3`` file.
        vehicle: with whose wheelbase the scale of the steering follows from the curvature that is driven.
        on_progress: called with messages read.

    Example:
        >>> found = inspect("laps_bag", "orca")  # doctest: +SKIP
        >>> print(found.signal_map())  # doctest: +SKIP
    """
    from dynssm_ros.signals.inspection import inspect

    car = None if vehicle is None else _vehicle(vehicle).constants
    return inspect(bag, None if car is None else car.l_f + car.l_r, on_progress)


def extract(
    bags: PathLike | Sequence[PathLike],
    signals: SignalMap | PathLike = "default",
    rate: float = 50.0,
    commands: Commands | None = None,
    drop_bad: bool = False,
    on_progress: Progress | None = None,
) -> Recording:
    """Turns race logs into a recording: named SI signals on a uniform time grid.

    Args:
        bags: rosbag2 folders or ``.mcap``/``.db3`` files, in the order of driving.
        signals: signal map: which topic and field is which signal.
        rate: of the grid (Hz).
        commands: source of the command inputs; the signal map's if not given.
        drop_bad: leave out samples that are not finite or out of order instead of raising.
        on_progress: called with messages read.

    Example:
        >>> recording = extract("laps_bag", rate=50.0)  # doctest: +SKIP
        >>> recording["v_x"].mean()  # doctest: +SKIP
        1.93
    """
    from dynssm_ros.signals.extraction import extract

    several = [bags] if isinstance(bags, (str, Path)) else list(bags)
    return extract(several, _signal_map(signals, commands), rate, drop_bad, on_progress)


def extract_season(
    bags: Sequence[PathLike],
    out: PathLike,
    car: str,
    track: str,
    signals: SignalMap | PathLike = "default",
    rate: float = 50.0,
    commands: Commands | None = None,
    drop_bad: bool = False,
    workers: Workers = HERE,
    on_progress: Progress | None = None,
) -> tuple[Season, list[Session]]:
    """Turns race logs into a season, one recording for each; those that are as they were are not read again.

    Args:
        bags: rosbag2 folders or ``.mcap``/``.db3`` files. One that cannot be read is listed with its reason.
        out: folder of the season; sessions of other logs stay.
        car: which car drove.
        track: where.
        signals: signal map: which topic and field is which signal.
        rate: of the grid (Hz).
        commands: source of the command inputs; the signal map's if not given.
        drop_bad: leave out samples that are not finite or out of order instead of listing the log as not readable.
        workers: where logs are read; those of a cluster find them, and the folder, by the same paths.
        on_progress: called with the logs that are done.

    Returns:
        The season, and those of its sessions that were extracted now.

    Example:
        >>> season, new = extract_season(["run_1", "run_2"], "season", "av21", "putnam")  # doctest: +SKIP
        >>> [session.session for session in season.chosen("seconds > 60")]  # doctest: +SKIP
        ['run_1', 'run_2']
    """
    from dynssm_ros.signals.season_extraction import extract_season, logs_of

    logs = logs_of(
        [Path(bag) for bag in bags], car, track, _signal_map(signals, commands), rate=rate, drop_bad=drop_bad
    )
    return extract_season(logs, out, workers, on_progress)


def calibrate(
    recordings: Log | Sequence[Log],
    vehicle: Vehicle | PathLike,
    horizon: float | None = None,
    min_speed: float | None = None,
    holdout: float = 0.0,
    integrator: Integrator | None = None,
    starts: int = 3,
    seed: int = 0,
    commands: Commands | None = None,
    on_progress: Progress | None = None,
    track: Track | PathLike | None = None,
) -> Calibration:
    """Fits the nominal parameters of a vehicle to measured laps, within their bounds, with standard deviations.

    Args:
        recordings: of one car.
        vehicle: start values, bounds, and what is known before.
        horizon: length of the simulations that are compared with the laps (s); if not given, 0.5, less for short logs.
        min_speed: slower rows are left out (m/s); the vehicle file's if not given.
        holdout: last fraction of each recording that is left out.
        integrator: of the model; if not given, Runge-Kutta unless Euler is clearly closer to the data.
        starts: starting points of the search.
        seed: of the random ones.
        commands: source of the command inputs; the recording's own if not given.
        on_progress: called after each starting point.
        track: from whose start the places of the vehicle's effects are counted.

    Example:
        >>> laps = recorded(simulate("orca", "club", duration=20.0))
        >>> found = calibrate(laps, "orca")
        >>> round(found.vehicle.coefficients["D_f"].nominal, 4)
        0.192
    """
    require("calibrate", "train")
    from dynssm_ros.identification.result.calibration import calibrate

    car = _vehicle(vehicle)
    data = _joined(_opened(recordings, car), commands, holdout)
    line = None if track is None else _centre_line(track, data)
    return calibrate(data, car, horizon, min_speed, integrator, starts, seed, on_progress, line)


class TrainingResult(NamedTuple):
    """A trained model and where it was written."""

    trained: Trained
    artifact: Artifact


def train(
    recordings: Log | Sequence[Log],
    model: ModelConfig | PathLike,
    vehicle: Vehicle | PathLike,
    out: PathLike,
    holdout: float = 0.0,
    commands: Commands | None = None,
    seed: int | None = None,
    epochs: int | None = None,
    device: str = "cpu",
    on_progress: Callable[[int, int, str], None] | None = None,
    picture: Callable[[Trained, Path], None] | None = None,
    memory: float | None = None,
) -> TrainingResult:
    """Trains a model and writes its folder: card, weights, ONNX graph, metrics. Continues after a kill.

    Args:
        recordings: of one car.
        model: model file: shipped name or path.
        vehicle: the car; calibrated on the recordings first if the model asks for it.
        out: folder to write. ``OUT.checkpoint.pt`` beside it is removed when the model is there.
        holdout: last fraction of each recording that is left out.
        commands: source of the command inputs; the recording's own if not given.
        seed: instead of the model file's.
        epochs: instead of the model file's, in each stage.
        device: ``cpu`` or ``cuda``.
        on_progress: called after each epoch with epochs done, epochs at most and a line about them.
        picture: draws the training to the file in the folder that it is given.
        memory: what the rows of the recordings' files may take (MB): if all take more, a sample of each log is trained on.

    Example:
        >>> laps = recorded(simulate("orca", "club", duration=20.0))
        >>> result = train(laps, "ridge", "orca", "ridge_model")
        >>> result.artifact.card.window
        30
    """
    require("train", "train")
    from dynssm_ros.identification.result.calibration import calibrate
    from dynssm_ros.learning.export import check_replaceable, save_artifact
    from dynssm_ros.learning.sampling import sampled
    from dynssm_ros.learning.stages import check_device, checkpoints, train

    check_device(device)
    folder = Path(out) if Path(out).name else Path(out).absolute()  # "." has no name to put the checkpoint beside
    check_replaceable(folder)
    config = model_config(model, seed, epochs)
    checkpoint, car = checkpoint_of(folder), _vehicle_in_windows(vehicle)
    if memory is None:
        data = _joined(_opened(recordings, car), commands, holdout)
    else:
        data = sampled(_looked_at(recordings, car), memory, commands=commands, holdout=holdout)
    trained = train(
        data, config, car, checkpoint, device=device, progress=on_progress,
        calibrate=lambda data, car, integrator: calibrate(data, car, integrator=integrator).vehicle,
    )  # fmt: skip
    artifact = save_artifact(trained, folder, {"holdout": holdout, "device": device}, picture)
    for path in checkpoints(config, checkpoint):
        path.unlink(missing_ok=True)
    return TrainingResult(trained, artifact)


def model_config(model: ModelConfig | PathLike, seed: int | None = None, epochs: int | None = None) -> ModelConfig:
    """A model file with other training settings, where given."""
    from dynssm_ros.learning.models.registry import load_model_config

    given = {key: value for key, value in (("seed", seed), ("epochs", epochs)) if value is not None}
    config = load_model_config(model) if isinstance(model, (str, Path)) else model
    return config.with_training(**given)


def review_season(
    season: Season | PathLike,
    models: Sequence[PathLike],
    vehicle: Vehicle | PathLike,
    out: PathLike,
    where: str | None = None,
    stretch: float | None = None,
    workers: Workers = HERE,
    on_progress: Progress | None = None,
) -> list[Review]:
    """Looks at each session of a season: scores models, calibrates the car, and says what its simulation gets wrong.

    Args:
        season: folder of it.
        models: folders or names; the calibrated car, and the same with an average of its errors, are scored beside them.
        vehicle: the car as it is known: simple models are of it, calibration and diagnosis start from it.
        out: folder for what is found in each session, which is not looked at again while it is as it was.
        where: chooses sessions.
        stretch: length of the stretches of sessions that coefficients are of (s); if not given, whole sessions.
        workers: where sessions are looked at; those of a cluster find all folders by the same paths.
        on_progress: called with the sessions that are done.

    Returns:
        In the order of driving.

    Example:
        >>> for alarm in alarms(review_season("season", ["model"], "av21.yaml", "review")):  # doctest: +SKIP
        ...     print(alarm.review.session, alarm.words)
    """
    require("season", "train", "race")
    from dynssm_ros.evaluation.season_review import SIMPLE

    opened = season if isinstance(season, Season) else Season.load(season)
    names = [*dict.fromkeys([*map(str, models), *SIMPLE])]
    task = partial(_reviewed, names, _vehicle(vehicle), Path(out), stretch)
    sessions = [(session, opened.file(session.place)) for session in opened.chosen(where)]
    found: dict[int, Review] = {}
    for k, review in each(task, sessions, workers):
        found[k] = review
        if on_progress is not None:
            on_progress(len(found), len(sessions))
    return [found[k] for k in sorted(found)]


def _reviewed(models: list[str], car: Vehicle, out: Path, stretch: float | None, task: tuple[Session, Path]) -> Review:
    """What is found in a session, or was found in it before."""
    from dynssm_ros.evaluation.season_review import read_review, review

    session, file = task
    trained = [digest(Path(name)) for name in models if Path(name).exists()]
    key = content_key([__version__, car.model_dump(mode="json"), models, trained, stretch, checksum(file)])
    kept = out / "sessions" / f"{'-'.join(session.place)}.json"
    known = read_review(kept)
    if known is not None and known.key == key:
        return known
    found = review(Recording.load(file), session, key, open_models(models, car), car, stretch)
    write_json(kept, found.model_dump(mode="json"))
    return found


def sweep(
    recordings: Log | Sequence[Log],
    model: PathLike,
    vehicle: Vehicle | PathLike,
    out: PathLike,
    space: Space | PathLike = "dynssm",
    trials: int = 24,
    holdout: float = 0.25,
    validation: Log | Sequence[Log] = (),
    commands: Commands | None = None,
    seed: int = 0,
    epochs: int | None = None,
    workers: Workers = HERE,
    on_progress: Progress | None = None,
) -> Sweep:
    """Trains a model with other settings of its file, again and again, and scores it on laps that were left out.

    The first trial is the file as it is. Each model is in ``OUT/trials``. Continues after a kill, or with more trials.

    Args:
        recordings: of one car, to train on.
        model: model file: shipped name or path.
        vehicle: the car.
        out: folder of the sweep.
        space: fields of the model file and what they may be: shipped name, path, or the object.
        trials: in all.
        holdout: last fraction of each recording that is left out, to score on.
        validation: recordings to score on, instead of that fraction.
        commands: source of the command inputs; the recording's own if not given.
        seed: of the choices.
        epochs: instead of the model file's, in each stage.
        workers: where trials are done; those of a cluster find the recordings and ``out`` by the same paths.
        on_progress: called with the trials that are done.

    Raises:
        ConfigurationError: a field that the model file does not have, or whose own value is not in the space.

    Example:
        >>> found = sweep("laps.parquet", "dynssm", "orca", "sweep")  # doctest: +SKIP
        >>> found.best.settings["training.learning_rate"]  # doctest: +SKIP
        0.0031
    """
    require("sweep", "sweep", "train", "race")
    from dynssm_ros.evaluation.sweep import Space, Sweep
    from dynssm_ros.learning.models.registry import field_of, load_model_config

    space = space if isinstance(space, Space) else Space.load(space)
    car, config = _vehicle_in_windows(vehicle), load_model_config(model)
    for logs in (recordings, validation):
        _opened(logs, car)  # what is wrong with them is said once
    about = {
        "model": config.model_dump(mode="json"), "vehicle": car.model_dump(mode="json"), "holdout": holdout,
        "recordings": list(map(_name, _files(recordings))), "validation": list(map(_name, _files(validation))),
        "commands": commands, "epochs": epochs,
    }  # fmt: skip
    found = Sweep(Path(out), space, {name: field_of(config, name) for name in space.choices}, seed, about)
    objective = partial(
        _scored, list(_files(recordings)), list(_files(validation)), model, car, Path(out), holdout, commands, epochs
    )
    found.run(objective, trials, workers, on_progress)
    return found


def _scored(
    recordings: list[Log], validation: list[Log], model: PathLike, car: Vehicle, out: Path, holdout: float,
    commands: Commands | None, epochs: int | None, number: int, settings: Mapping[str, Any],
) -> Errors:  # fmt: skip
    """Trains with settings, and scores on laps that were left out."""
    from dynssm_ros.evaluation.open_loop import evaluate
    from dynssm_ros.evaluation.sweep import STRIDE, Errors
    from dynssm_ros.learning.models.registry import load_model_config, overrides

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DataWarning)
        part = 0.0 if validation else holdout
        config = model_config(load_model_config(model, overrides(settings)), None, epochs)
        train(recordings, config, car, out / "trials" / f"{number:03d}", part, commands)
        trained = load_model(out / "trials" / f"{number:03d}")
        logs = [log.with_commands(trained.commands) for log in _opened(validation or recordings, car)]
    log = concatenate(logs if validation else [log.split_last(holdout)[1] for log in logs])
    score = evaluate(log, {trained.name: trained}, stride=STRIDE, calls=1).scores[trained.name]
    v_x, v_y, omega = map(float, score.rmse)
    return Errors(float(score.rollout.ade), (v_x, v_y, omega))


def checkpoint_of(out: Path) -> Path:
    """Where a training that writes ``out`` keeps its state."""
    return out.with_name(f"{out.name}.checkpoint.pt")


def evaluate(
    recordings: Log | Sequence[Log],
    models: Sequence[WindowModel | PathLike] | Mapping[str, WindowModel],
    vehicle: Vehicle | PathLike | None = None,
    holdout: float | None = None,
    commands: Commands | None = None,
    min_speed: float | None = None,
    horizon: float = PATH_HORIZON_S,
    stride: int = 1,
    track: Track | PathLike | None = None,
    on_progress: Progress | None = None,
    name: str = "",
    workers: Workers = HERE,
) -> Evaluation:
    """Scores models on recordings: one-step errors, rollouts, displacement, coverage, latency.

    Args:
        recordings: to score on, of one car, in the order of driving; online layers learn on from one to the next.
        models: folders, names of baselines, or models.
        vehicle: of the single-track baselines.
        holdout: score only this last fraction of the recording.
        commands: protocol; if not given, that of the models' training.
        min_speed: stretches below are left out (m/s); the largest ``minimum_speed`` of the models' cars if not given.
        horizon: length of the rollouts (s).
        stride: a rollout starts at every ``stride``-th row.
        track: on which errors are placed; if not given, the first full lap of the recording.
        on_progress: called with predictions made.
        name: of the recording, for people; that of its file, or its sources, if not given.
        workers: where models are scored.

    Example:
        >>> laps = recorded(simulate("orca", "club", duration=10.0))
        >>> scores = evaluate(laps, ["persistence", "single_track"], "orca").scores
        >>> bool(scores["single_track"].rmse[0] < 1e-9)
        True
    """
    require("evaluate", "race")
    from dynssm_ros.evaluation.open_loop import evaluate, shared_commands
    from dynssm_ros.track.lap_position import first_lap

    opened = models if isinstance(models, Mapping) else open_models(models, vehicle)
    car = next((model.vehicle for model in opened.values() if model.vehicle is not None), None)
    log = _joined(_opened(recordings, car), None, 0.0)
    line = first_lap(log) if track is None else _centre_line(track, log)
    log = log.with_commands(commands or shared_commands(opened))
    opened = with_offline(opened)
    split = "whole recording"
    if holdout is not None:
        if holdout <= 0:
            raise ConfigurationError(f"--holdout {holdout:g}: expected a fraction above 0 and up to 1")
        log, split = log.split_last(holdout)[1], f"last {100 * holdout:.3g} % of the recording, as one block"
    if not name:
        name = ", ".join(Path(each).name for each in _several(recordings) if isinstance(each, (str, Path)))
    return evaluate(
        log, opened, name, split, min_speed, horizon, stride, line=line, progress=on_progress, workers=workers
    )


def open_models(
    models: Sequence[WindowModel | PathLike], vehicle: Vehicle | PathLike | None = None
) -> dict[str, WindowModel]:
    """Models by their names; where two have the same one, what was given disambiguates."""
    opened = {str(m): load_model(m, vehicle) if isinstance(m, (str, Path)) else m for m in models}
    return disambiguated(opened, lambda model: model.name)


def with_offline(models: Mapping[str, WindowModel]) -> dict[str, WindowModel]:
    """Models, each that has an online layer followed by itself without it."""
    from dynssm_ros.runtime.contract import without_online

    both: dict[str, WindowModel] = {}
    for label, model in models.items():
        both[label] = model
        if model.online is not None:
            both[f"{label} (offline)"] = without_online(model)
    return both


def disambiguated(opened: Mapping[str, Any], name: Callable[[Any], str]) -> dict[str, Any]:
    """What was opened, by name; where several have the same one, by what was given."""
    called = [name(each) for each in opened.values()]
    return {given if called.count(name(each)) > 1 else name(each): each for given, each in opened.items()}


def replay(
    bag: PathLike,
    model: PathLike,
    out: PathLike,
    signals: SignalMap | PathLike = "default",
    with_inputs: bool = False,
    max_age: float = 0.2,
    on_progress: Progress | None = None,
    online: bool = True,
    online_state: PathLike | None = None,
) -> Any:
    """Predicts offline what the node would have published for a bag, into a new bag.

    Args:
        bag: what was recorded.
        model: model folder.
        out: the new bag.
        signals: signal map: which topic and field is which signal.
        with_inputs: also copy all topics of ``bag``.
        max_age: oldest actuator sample that a prediction may rest on (s).
        on_progress: called with messages read.
        online: whether the model's online layer learns and corrects, if it has one.
        online_state: file of what it has learned: read before, if it is there, and written after.

    Returns:
        The number of predictions, the refusals by reason, and notes on a bag that had to be recovered.

    Example:
        >>> replay("laps_bag", "model", "predictions")  # doctest: +SKIP
        (995, Counter({<Refusal.FILLING: ...>: 5}), [])
    """
    from dynssm_ros.runtime.artifact import open_artifact
    from dynssm_ros.runtime.onnx_model import OnnxModel
    from dynssm_ros.runtime.predictor import Predictor
    from dynssm_ros.runtime.replay import replay_to_bag

    signal_map = signals if isinstance(signals, SignalMap) else load_signal_map(signals)
    predictor = Predictor(OnnxModel(open_artifact(model)), signal_map, max_age, online)
    state = None if online_state is None else Path(online_state)
    if state is not None and state.exists():
        predictor.load_online(state)
    outcome = replay_to_bag(Path(bag), predictor, Path(out), with_inputs, on_progress)
    if state is not None:
        predictor.save_online(state)
    return outcome


def diagnose(
    recordings: Log | Sequence[Log],
    vehicle: Vehicle | PathLike,
    horizon: float = 0.5,
    holdout: float = 0.25,
    min_speed: float | None = None,
    integrator: Integrator | None = None,
    track: Track | PathLike | None = None,
    commands: Commands | None = None,
    on_progress: Callable[[str], None] | None = None,
    exclude: Collection[str] = (),
    suspect: Log | Sequence[Log] = (),
    workers: Workers = HERE,
) -> Diagnosis:
    """Finds out what the simulation gets wrong about measured laps, and why.

    Args:
        recordings: of one car. What only one of several has is named with it.
        vehicle: the simulated car; how well it is known decides whether a coefficient that has to move is a cause.
        horizon: time that is simulated from a measured state on (s).
        holdout: share at the end that only measures the improvement; whole laps if there are three.
        min_speed: stretches below are left out (m/s); the vehicle file's if not given.
        integrator: of the simulation; if not given, the vehicle's, else Runge-Kutta, unless others are clearly closer.
        track: from whose start positions on the lap are counted; if not given, the first full lap.
        commands: source of the command inputs; the recording's own if not given.
        on_progress: called with what is being done.
        exclude: names of effects that are impossible there, such as wind in a hall.
        suspect: recordings of the same car in which something may have changed since ``recordings``.
        workers: where candidates are tried.

    Example:
        >>> hidden = {"steering_offset": {"offset": 0.03}}
        >>> noise = (0.005, 0.005, 0.02)
        >>> laps = recorded(simulate("orca", "club", duration=40.0, plant="rk4", effects=hidden, noise=noise))
        >>> [cause.effect for cause in diagnose(laps, "orca", integrator="rk4").causes]
        ['steering_offset']
    """
    require("diagnose", "train")
    from dynssm_ros.identification.result.diagnose import diagnose

    line, car = None if track is None else _track(track).centre, _vehicle(vehicle)
    report = on_progress or (lambda words: None)
    data, changed = ([log.with_commands(commands) for log in _opened(logs, car)] for logs in (recordings, suspect))
    with connected(workers) as pool:
        return diagnose(data, car, horizon, holdout, min_speed, integrator, line, report, exclude, changed, pool)


def race(
    vehicle: Vehicle | PathLike,
    track: Track | PathLike,
    models: Sequence[str],
    plant: PlantKind = "rk4",
    objective: Objective = "tracking",
    laps: int = 1,
    line: str = "racing",
    speed_scale: float | None = None,
    horizon: int | None = None,
    along_horizon: bool = False,
    offset_free: bool = False,
    effects: Mapping[str, Mapping[str, float]] | None = None,
    scale: float | None = None,
    lap_length: float | None = None,
    start: float = 0.0,
    start_offset: float = 0.0,
    start_speed: float | None = None,
    on_progress: Callable[[int, int, str], None] | None = None,
    noise: tuple[float, float, float] = (0.0, 0.0, 0.0),
    pose_noise: tuple[float, float, float] = (0.0, 0.0, 0.0),
    delay: float = 0.0,
    seed: int = 0,
    as_is: bool = False,
    learn: bool = False,
) -> list[Race]:
    """Drives laps in closed loop: a predictive controller with each model in turn, on a simulated car.

    Args:
        vehicle: the car.
        track: where.
        models: ``true`` (the plant's own), vehicle files, model folders, or names of baselines.
        plant: ``euler``, ``rk4`` or ``double_track``.
        objective: ``tracking`` follows the line at its own speed; ``progress`` goes as far as the borders allow.
        laps: to drive.
        line: ``centre``, ``racing``, or a file ``s_m,x_m,y_m,v_mps`` with its own speed.
        speed_scale: share of the car's limits in the line's speed; of a file, factor on it. If not given it is 1, or a safe
            share to begin with for a car that learns.
        horizon: steps of T_s that are planned ahead; as the car needs if not given.
        along_horizon: read the models anew at every step of the horizon.
        offset_free: follow what each model mispredicts at a fixed rate, not at one that the data choose.
        effects: physics that the plant has and no model but ``true`` knows, by name, with parameters.
        scale: of the track.
        lap_length: or the length that it is scaled to (m).
        start: where the car starts on the centre line (m).
        start_offset: how far left of the line it starts (m).
        start_speed: how fast (m/s), 0 from standstill; the line's own speed if not given.
        on_progress: called with millimetres driven and the model's name.
        noise: standard deviations of white noise on the measured ``v_x, v_y`` (m/s), ``omega`` (rad/s).
        pose_noise: likewise on ``x, y`` (m), ``theta`` (rad).
        delay: from an instant until the command that answers it acts (s); the controller knows it.
        seed: of the noise.
        as_is: plan with what each model says, whether or not it has predicted better than the calibrated car.
        learn: drive each section of the lap faster every lap, as far as the laps so far have shown it is safe.

    Example:
        >>> (lap,) = race("orca", "club", ["true"], speed_scale=0.8)
        >>> lap.completed, lap.outside
        (True, 0.0)
    """
    require("race", "race")
    from dynssm_ros.control.lap_learning import SAFE
    from dynssm_ros.control.race import Course, Start, race
    from dynssm_ros.control.race_models import load_prediction_model
    from dynssm_ros.control.reference import load_reference
    from dynssm_ros.control.settings import Settings
    from dynssm_ros.simulation.sensing import Sensing

    car = _vehicle(vehicle)
    driven = car.with_effects((name, dict(values)) for name, values in (effects or {}).items())
    road = _sized(_track(track), scale, lap_length)
    for text in models:
        if list(models).count(text) > 1:
            raise ConfigurationError(f"--model {text}: given twice; expected different models")
    opened = {
        text: load_prediction_model(text, car, driven, plant, along_horizon=along_horizon, as_is=as_is)
        for text in models
    }
    for name, model in disambiguated(opened, lambda model: model.name).items():
        model.name = name
    pace = (SAFE if learn else 1.0) if speed_scale is None else speed_scale
    reference = load_reference(line, car, road, pace)
    settings = Settings.of(car, objective, horizon, offset_free, not as_is)
    sensing = Sensing(noise, pose_noise, delay, seed)
    begins = Start(start, start_offset, start_speed)
    course = Course(driven, road, plant, reference, settings, laps, begins, sensing, car if learn else None)
    races = []
    for k, model in enumerate(opened.values()):

        def report(done: int, total: int, words: str, k: int = k) -> None:
            if on_progress is not None:
                on_progress(k * total + done, len(opened) * total, words)

        races.append(race(course, model, report))
    return races


def recorded(run: Run) -> Recording:
    """A simulated drive as a recording, as if it had been written to a bag and extracted.

    Example:
        >>> len(recorded(simulate("orca", "club", duration=1.0)))
        51
    """
    from dynssm_ros.simulation.laps import as_recording

    return as_recording(run)


def _vehicle(vehicle: Vehicle | PathLike) -> Vehicle:
    return vehicle if isinstance(vehicle, Vehicle) else load_vehicle(vehicle)


def _vehicle_in_windows(vehicle: Vehicle | PathLike) -> Vehicle:
    """The car as a model of windows can have it; a :class:`DataWarning` names effects that are left out."""
    car = _vehicle(vehicle)
    for effect in car.active_effects:
        if effect.needs:
            warnings.warn(
                f"vehicle {car.name}: {effect.NAME} reads {', '.join(effect.needs)}, which windows of rows do not tell, "
                "so that it is left to the online layer",
                DataWarning, stacklevel=3,
            )  # fmt: skip
    return car.in_windows


def _signal_map(signals: SignalMap | PathLike, commands: Commands | None) -> SignalMap:
    signal_map = signals if isinstance(signals, SignalMap) else load_signal_map(signals)
    return signal_map.with_commands(commands)


def _opened(logs: Log | Sequence[Log], car: Vehicle | None) -> list[Recording]:
    """Recordings, all of a season's folder; a :class:`DataWarning` names what of them the car cannot have done."""
    opened = []
    for log in _files(logs):
        recording = log if isinstance(log, Recording) else Recording.load(log)
        if car is not None and math.isclose(car.sampling_time, recording.T_s):  # else the command ends with that
            for words in implausible_rows(recording, car):
                warnings.warn(f"{_name(log)}: {words}", DataWarning, stacklevel=3)
        opened.append(recording)
    return opened


def _looked_at(logs: Log | Sequence[Log], car: Vehicle) -> list[Path]:
    """Files of recordings, each of which was looked at; see :func:`_opened`."""
    files = [log for log in _files(logs) if not isinstance(log, Recording)]
    if len(files) < sum(1 for _ in _files(logs)):
        raise ConfigurationError("memory: a recording that is not in a file takes its memory already; expected files")
    for file in files:
        _opened(file, car)
    return [Path(file) for file in files]


def _joined(recordings: Sequence[Recording], commands: Commands | None, holdout: float) -> Recording:
    """Recordings one after the other, each without its last fraction ``holdout``."""
    return concatenate([each.with_commands(commands).split_last(holdout)[0] for each in recordings])


def _files(logs: Log | Sequence[Log]) -> Iterator[Log]:
    """Recordings or their files, those of seasons one by one."""
    for log in _several(logs):
        yield from [log] if isinstance(log, Recording) else recording_files([log])


def _name(log: Log) -> str:
    return ", ".join(log.info.source) if isinstance(log, Recording) else str(log)


def _several(logs: Log | Sequence[Log]) -> list[Log]:
    return [logs] if isinstance(logs, (Recording, str, Path)) else list(logs)


def _track(track: Track | PathLike) -> Track:
    from dynssm_ros.track.tracks import Track, load_track

    return track if isinstance(track, Track) else load_track(track)


def _sized(track: Track, scale: float | None, lap_length: float | None) -> Track:
    """The track at the size asked for."""
    if scale is not None and lap_length is not None:
        raise ConfigurationError(f"--scale {scale:g} and --lap-length {lap_length:g}; expected one of them")
    if lap_length is not None:
        scale = lap_length / track.length
    return track if scale is None else track.scaled(scale)


def _centre_line(track: Track | PathLike, log: Recording) -> Any:
    """The centre line of a track on which the recording was driven."""
    import numpy as np

    road = _track(track)
    if not log.has_pose:
        raise ConfigurationError(f"--track {track}: the recording holds no positions (x, y) to place on it")
    _, lateral = road.project(np.stack([log["x"], log["y"]], axis=1))
    away, width = float(np.median(np.abs(lateral))), float(np.mean(road.width_left + road.width_right))
    if away > width:
        raise ConfigurationError(
            f"--track {track}: the recording lies {away:.3g} m (median) from its centre line; expected the same "
            f"coordinates, so at most the track's width of {width:.3g} m"
        )
    return road.centre
