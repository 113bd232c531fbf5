"""What a network beside the online layer could earn on laps and logs that were left out, and from which inputs.

    python -m benchmarks.network [--out out/network] [--only putnam] [--data DIR]
    python -m benchmarks.network --steps [--test] [--only cell] [--data DIR]

Each fold leaves out a lap of Putnam Park or a development log of the 1:10 car, or is a simulated cell of the generalisation
matrix. The car is calibrated and the layer fitted on the rest. There layers that did not know a stretch drive along it, and
learners are fitted to what these leave of increments. On the left-out drive a learner's prediction is added to the physics,
and the layer learns what is then left. ``--steps`` scores the layer with the throttle's steps, everywhere and where they earn
their place, and trees beside it, on the measured folds, all simulated cells with the usual noise, and further logs of the
1:10 car: those for development, or with ``--test`` those for publishing.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
import torch
from torch import nn

from benchmarks.fold_tables import HORIZONS_S, by_group, tables
from benchmarks.logs import add_data_option
from benchmarks.matrix.scored_cells import RACER, Cell, season_logs, simulated_cells, test_drive, training_drive
from dynssm_ros.arrays import Indices, Vector
from dynssm_ros.files import write_json
from dynssm_ros.identification.result.calibration import calibrate
from dynssm_ros.learning.dataset import normalisation
from dynssm_ros.learning.earned_layer import LayerBase, earned_layer
from dynssm_ros.learning.models.base import OnlineConfig
from dynssm_ros.learning.models.physics import PhysicsConfig
from dynssm_ros.learning.models.registry import build_model, load_model_config
from dynssm_ros.learning.online import LayerDrive, fit_layer
from dynssm_ros.runtime.along import Along
from dynssm_ros.runtime.features import INPUT_CHANGE, LayerFeatures, throttle_steps
from dynssm_ros.runtime.online import CHANNELS, Learned, OnlineLayer, Seen
from dynssm_ros.runtime.path_judge import PathJudge
from dynssm_ros.runtime.rollout import RolloutCorrection, Step, path_errors, roll_out
from dynssm_ros.signals.extraction import extract
from dynssm_ros.signals.recording import Recording, concatenate
from dynssm_ros.signals.signal_map import load_signal_map
from dynssm_ros.vehicle import Vehicle, load_vehicle, save_vehicle
from dynssm_ros.vehicle.kinematics import PATH_HORIZON_S

_GATES_S = (28.6, 248.9, 409.0, np.inf)  # of Putnam Park's laps
_SETTLED_S = 16.0  # before it the log's heading settles
_DART = {
    "free": "dart/free_driving_1002", "circles_1211": "dart_season/circles_0904_1211",
    "circles_1554": "dart_season/circles_0909_1554", "ramp": "dart_season/circles_fast_ramp_0927_1818",
}  # fmt: skip
_SIMULATED = (
    "orca-rk4-usual-none", "orca-double_track-usual-grip", "av21-rk4-usual-grip", "av21-double_track-usual-none",
    "racer-rk4-usual-mass", "racer-double_track-usual-bank",
)  # fmt: skip
"""Development cells of the generalisation matrix, with noise: nothing bends in these cars, and some have changed."""
_HISTORY_S = 0.64
_STRIDE_S = 0.2  # between starts of paths
_FIRST_S = 10.0  # of a drive, in which the layer meets what is new
_LIMIT = 4.0  # of inputs, whose usual size is one, and of corrections in their standard deviations

Predict = Callable[[Vector], Vector]
"""From inputs ``(N, n)`` to what is left of increments, ``(N, 3)``, in their standard deviations."""
Stretches = list[tuple[LayerDrive, OnlineLayer]]
"""Parts of a training, each with a layer that did not know it."""
Look = Callable[[Vector, Seen], Vector]
"""From windows ``(N, H, 7)`` and what the layer sees of them to inputs ``(N, n)``."""


class Fold(NamedTuple):
    """A training, and the drive that it is scored on."""

    name: str
    vehicle: str
    training: Recording
    left_out: Recording
    trained: str = ""
    """Name of the training, if others share it."""


def folds(data: Path) -> dict[str, Callable[[], Fold]]:
    """What makes each fold, by name; marked test logs and test cells are in none."""
    laps = {f"putnam_{lap}": partial(_lap, lap, data) for lap in range(1, len(_GATES_S))}
    logs = {f"dart_{name}": partial(_log, name, data) for name in _DART}
    cells = {f"simulated_{cell.name}": partial(_cell, cell) for cell in simulated_cells() if cell.name in _SIMULATED}
    return {**laps, **logs, **cells}


def _lap(lap: int, data: Path) -> Fold:
    log = _extracted(data / "av21" / "putnam_park_run4_2", "av21", 25.0)
    seconds = (log.time - log.time[0]) / 1e9
    inside = (seconds >= _GATES_S[lap - 1]) & (seconds < _GATES_S[lap])
    return Fold(f"putnam_{lap}", "av21", log.select((seconds >= _SETTLED_S) & ~inside), log.select(inside))


def _log(left: str, data: Path) -> Fold:
    logs = {name: _extracted(data / bag, "default", 50.0) for name, bag in _DART.items()}
    return Fold(f"dart_{left}", RACER, concatenate([log for name, log in logs.items() if name != left]), logs[left])


def _cell(cell: Cell) -> Fold:
    training, test = (
        concatenate(drives) for drives in (training_drive(cell.training, Path()), test_drive(cell, Path()))
    )
    return Fold(f"simulated_{cell.name}", cell.training.vehicle, training, test, cell.training.name)


def further_folds(data: Path, test: bool) -> dict[str, Callable[[], Fold]]:
    """Measured folds, all simulated cells with the usual noise, and the logs of the 1:10 car's season.

    ``season`` logs follow a training with four logs, ``alone`` logs one with free driving alone, which never coasts.
    """
    cells = [cell for cell in simulated_cells() if cell.is_test == test and "-usual-" in cell.name]
    logs = [log.name for log in season_logs(data, test)]
    trainings = {"season": tuple(_DART.values()), "alone": (_DART["free"],)}
    laps = {name: fold for name, fold in folds(data).items() if name.startswith(("putnam", "dart"))} if not test else {}
    simulated = {
        f"{'same' if cell.change == 'none' else 'changed'}_{cell.name}": partial(_cell, cell) for cell in cells
    }
    season = {
        f"{training}_{name}": partial(_season_log, name, training, bags, data)
        for training, bags in trainings.items()
        for name in logs
        if f"dart_season/{name}" not in bags
    }
    return {**laps, **simulated, **season}


def _season_log(name: str, training: str, bags: tuple[str, ...], data: Path) -> Fold:
    logs = [_extracted(data / bag, "default", 50.0) for bag in bags]
    log = _extracted(data / "dart_season" / name, "default", 50.0)
    return Fold(f"{training}_{name}", RACER, concatenate(logs), log, training)


@cache
def _extracted(bag: Path, signals: str, rate: float) -> Recording:
    return extract([bag], load_signal_map(signals).with_commands("none"), rate)


@dataclass(frozen=True)
class Study:
    """A fold with its calibrated car and its layer."""

    fold: Fold
    base: LayerBase

    @classmethod
    def of(cls, fold: Fold, out: Path) -> Study:
        """Calibrates the car; one that lies in ``out`` is taken."""
        file = out / f"{fold.trained or fold.name}.yaml"
        if not file.is_file():
            car = load_vehicle(fold.vehicle)
            save_vehicle(calibrate(fold.training, car, min_speed=car.minimum_speed).vehicle, file)
        car = load_vehicle(file)
        H = max(1, round(_HISTORY_S / car.sampling_time))
        ends = fold.training.window_ends(H, min_speed=car.minimum_speed)
        scale = normalisation(fold.training, ends)
        return cls(fold, LayerBase(car, PhysicsConfig(nominal="calibrated"), scale, H, OnlineConfig()))

    @property
    def car(self) -> Vehicle:
        return self.base.vehicle

    @property
    def moves(self) -> bool:
        """Whether the left-out drive has rows that are fast enough for the model."""
        return len(self.fold.left_out.window_ends(self.base.H, min_speed=self.car.minimum_speed)) > 0

    def drive(self, log: Recording, ends: Indices, features: LayerFeatures) -> LayerDrive:
        """A log as a layer sees it."""
        return LayerDrive.of(log, ends, self.base.H, features.seen)

    def fitted(self, features: LayerFeatures) -> tuple[OnlineLayer, Stretches]:
        """The layer of the training, and its stretches, each with a layer that did not know it."""
        log = self.fold.training
        ends = log.window_ends(self.base.H, min_speed=self.car.minimum_speed)
        drives = [self.drive(log, some, features) for some in np.array_split(ends, self.base.config.folds)]
        found = fit_layer(drives, features, self.base.normalisation, self.base.config)
        return found.layer, [(drive, each.layer) for drive, each in zip(drives, found.left_out, strict=True)]

    def everything(self, windows: Vector, seen: Seen) -> Vector:
        """All that the layer sees."""
        return limited(seen.features.reshape(len(windows), -1))

    def operating_point(self, windows: Vector, seen: Seen) -> Vector:
        """State, inputs and their last three changes, and the throttle's steps."""
        mean, std = np.array(self.base.normalisation.input_mean[:5]), np.array(self.base.normalisation.input_std[:5])
        applied = windows[:, -4:, 3:5] + windows[:, -4:, 5:]
        level = (np.concatenate([windows[:, -1, :3], applied[:, -1]], axis=1) - mean) / std
        changes = (np.diff(applied, axis=1) / (INPUT_CHANGE * std[3:])).reshape(len(windows), -1)
        return np.concatenate([limited(level), limited(changes), throttle_steps(windows)], axis=1)

    def with_increments(self, windows: Vector, seen: Seen) -> Vector:
        """The operating point and the last three measured increments."""
        moved = np.diff(windows[:, -4:, :CHANNELS], axis=1) / np.array(self.base.normalisation.increment_scale)
        return np.concatenate([self.operating_point(windows, seen), limited(moved.reshape(len(windows), -1))], axis=1)


def limited(values: Vector) -> Vector:
    """Squeezed to the range that trainings have seen."""
    inside: Vector = _LIMIT * np.tanh(values / _LIMIT)
    return inside


def left_by(layer: OnlineLayer, drive: LayerDrive) -> Vector:
    """What a layer that learns along a drive leaves of its increments, ``(N, 3)``, in units of s_delta."""
    seen, (rows, increments) = drive.see(slice(None)), drive.measured(slice(None))
    learned = Along(layer).over(seen, rows, increments, drive.ends)
    left: Vector = (increments - layer.increments(seen.features, learned.weights)) / layer.scale
    return left


def ridge(X: Vector, Y: Vector) -> Predict:
    """Ridge regression; a thirtieth of an input's usual square as its weight's penalty."""
    mean = X.mean(axis=0)
    Z = X - mean
    W = np.linalg.solve(Z.T @ Z / len(Z) + 0.03 * np.eye(Z.shape[1]), Z.T @ np.clip(Y, -3, 3) / len(Z))
    return lambda x: np.asarray((x - mean) @ W)


def trees(X: Vector, Y: Vector) -> Predict:
    """Boosted trees for each channel."""
    from sklearn.ensemble import HistGradientBoostingRegressor

    settings: dict[str, Any] = {
        "max_iter": 60, "max_leaf_nodes": 12, "learning_rate": 0.08, "min_samples_leaf": 60, "l2_regularization": 1.0,
    }  # fmt: skip
    fitted = [HistGradientBoostingRegressor(**settings, random_state=0).fit(X, np.clip(y, -3, 3)) for y in Y.T]
    return lambda x: np.stack([each.predict(x) for each in fitted], axis=1)


class Network(nn.Module):
    """A linear map and, beside it, 16 hidden units."""

    def __init__(self, inputs: int) -> None:
        super().__init__()
        self.linear = nn.Linear(inputs, CHANNELS)
        self.hidden = nn.Sequential(nn.Linear(inputs, 16), nn.SiLU(), nn.Linear(16, CHANNELS))
        for last in (self.linear, cast(nn.Linear, self.hidden[-1])):
            nn.init.zeros_(last.weight)
            nn.init.zeros_(last.bias)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Inputs ``(N, n)`` to a bounded correction ``(N, 3)``."""
        return _LIMIT * torch.tanh((self.linear(x) + self.hidden(x)) / _LIMIT)


def network(X: Vector, Y: Vector) -> Predict:
    """:class:`Network`, trained one step ahead."""
    torch.manual_seed(0)
    inputs, wanted = (torch.tensor(each, dtype=torch.float32) for each in (X, Y))
    model, epochs, size = Network(X.shape[1]), 15, 128
    optimiser = torch.optim.AdamW(model.parameters(), lr=0.004, weight_decay=0.01)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, epochs * -(-len(X) // size))
    for _ in range(epochs):
        for batch in torch.split(torch.randperm(len(X)), size):
            loss = nn.functional.huber_loss(model(inputs[batch]), wanted[batch], delta=2.0)
            optimiser.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            optimiser.step()
            schedule.step()

    def predict(x: Vector) -> Vector:
        with torch.no_grad():
            found: Vector = model(torch.tensor(x, dtype=torch.float32)).double().numpy()
        return found

    return predict


class Scored(NamedTuple):
    """Errors on the left-out drive."""

    rmse: Vector  # one step, (3,)
    first: Vector  # the same in the first 10 s
    distances: Vector  # mean distance of paths, (starts, horizons) (m)


def score(
    study: Study, features: LayerFeatures, layer: OnlineLayer, trusted: Vector, learner: Look | None = None
) -> Scored:
    """Drives along the left-out log; ``learner``: adds ``(N, 3)`` (m/s, m/s, rad/s) to the physics."""
    log, H, T_s = study.fold.left_out, study.base.H, study.car.sampling_time
    ends = log.window_ends(H, min_speed=study.car.minimum_speed)
    windows = log.windows(ends, H)
    seen, (rows, increments) = features.seen(windows), study.drive(log, ends, features).measured(slice(None))
    left = increments - (0.0 if learner is None else learner(windows, seen))
    known = Along(layer).over(seen, rows, left, ends)._replace(trusted=trusted)
    errors = left - layer.increments(seen.features, known.weights)
    steps = round(max(HORIZONS_S) / T_s)
    starts = log.window_ends(H, steps, study.car.minimum_speed)[:: max(1, round(_STRIDE_S / T_s))]
    correction = RolloutCorrection(layer, known.at(np.searchsorted(ends, starts)))

    predicted = log.windows(starts, H, steps)
    states = roll_out(corrected(features, correction, T_s, learner), predicted, H)
    distances = path_errors(predicted[:, H - 1 : H, :3], states, predicted[:, H:, :3], T_s)
    until = [round(horizon / T_s) for horizon in HORIZONS_S]
    first = log.time[ends] < log.time[ends[0]] + 1e9 * _FIRST_S
    one_step, at_first = (np.sqrt(np.mean(each**2, axis=0)) for each in (errors, errors[first]))
    return Scored(one_step, at_first, np.stack([distances[:, :k].mean(axis=1) for k in until], axis=1))


def corrected(features: LayerFeatures, correction: RolloutCorrection, T_s: float, learner: Look | None) -> Step:
    """The steps of rollouts with what a learner adds to the physics: it fades as the layer's correction does."""

    def step(windows: Vector) -> Vector:
        seen, k = features.seen(windows), correction.steps
        moved = windows[:, -1, :CHANNELS] + correction.increments(seen)
        if learner is None:
            return moved
        share = min(max(2.0 - k * T_s / PATH_HORIZON_S, 0.0), 1.0)
        acts = correction.learned.trusted[:, None] if k else 1.0
        return np.asarray(moved + share * acts * learner(windows, seen))

    return step


def judged(study: Study, features: LayerFeatures, layer: OnlineLayer) -> Vector:
    """Where on the left-out drive the paths of the layer alone are believed."""
    log, H = study.fold.left_out, study.base.H
    ends = log.window_ends(H, min_speed=study.car.minimum_speed)
    drive = study.drive(log, ends, features)
    seen, windows = drive.see(slice(None)), log.windows(ends, H)
    known: Learned = Along(layer).over(seen, *drive.measured(slice(None)), ends)
    return PathJudge(layer, features.seen, features).along(windows, ends, known, seen)


def ratios(ours: Scored, alone: Scored) -> list[float]:
    """Errors over those of the layer alone, see :data:`fold_tables.ERRORS`; one step as geometric mean over the channels."""
    step, first = (
        float(np.exp(np.mean(np.log(a / b)))) for a, b in ((ours.rmse, alone.rmse), (ours.first, alone.first))
    )
    return [step, *(ours.distances.mean(axis=0) / alone.distances.mean(axis=0)).tolist(), first]


def scored(study: Study) -> dict[str, list[float]]:
    """:func:`ratios` of all learners."""
    features = study.base.features(False)
    layer, stretches = study.fitted(features)
    trusted = judged(study, features, layer)
    alone = score(study, features, layer, trusted)
    left = left_of(stretches)
    found = {}
    looks = {"all features": study.everything, "operating point": study.operating_point}
    cases = [(name, look, fit) for name, look in looks.items() for fit in (ridge, trees, network)]
    for name, look, fit in [*cases, ("operating point, increments", study.with_increments, network)]:
        learner = learned(study, layer, look, fit, stretches=stretches, left=left)
        found[f"{fit.__name__}, {name}"] = ratios(score(study, features, layer, trusted, learner), alone)
    steps = study.base._replace(config=OnlineConfig(throttle_steps=True)).features(False)
    found["layer with the throttle's steps"] = ratios(score(study, steps, study.fitted(steps)[0], trusted), alone)
    return found


def left_of(stretches: Stretches) -> Vector:
    """What the layers that did not know the stretches leave of their increments, ``(N, 3)``, in units of s_delta."""
    return np.concatenate([left_by(layer, drive) for drive, layer in stretches])


def learned(
    study: Study,
    layer: OnlineLayer,
    look: Look,
    fit: Callable[[Vector, Vector], Predict],
    *,
    stretches: Stretches,
    left: Vector,
) -> Look:
    """What a learner that is fitted to :func:`left_of` the stretches adds to the physics."""
    H, log = study.base.H, study.fold.training
    inputs = [look(log.windows(drive.ends, H), drive.see(slice(None))) for drive, _ in stretches]
    size = left.std(axis=0)
    predict = fit(np.concatenate(inputs), left / size)
    return lambda windows, seen: np.asarray(predict(look(windows, seen)) * size * layer.scale)


def steps_scored(study: Study) -> dict[str, list[float]]:
    """:func:`ratios` of the layer with the throttle's steps, of the one that ``train`` gives, and of trees."""
    model = build_model(load_model_config("rls"), study.base.vehicle, study.base.normalisation)

    def fitted(steps: bool | None) -> tuple[LayerFeatures, OnlineLayer]:
        base = study.base._replace(config=OnlineConfig(throttle_steps=steps))
        return earned_layer(base, model, study.fold.training, [])[:2]

    def of(features: LayerFeatures, layer: OnlineLayer) -> Scored:
        return score(study, features, layer, judged(study, features, layer))

    chosen = fitted(None)
    earned = chosen[0].layout.throttle
    layers = {earned: chosen, not earned: fitted(not earned)}
    features = layers[False][0]
    layer, stretches = study.fitted(features)
    trusted = judged(study, features, layer)
    alone = score(study, features, layer, trusted)
    left = left_of(stretches)
    forced = ratios(of(*layers[True]), of(*layers[False]))
    found = {"steps everywhere": forced, "steps where they earn it": forced if earned else [1.0] * len(forced)}
    for name, look in (("all features", study.everything), ("operating point", study.operating_point)):
        learner = learned(study, layer, look, trees, stretches=stretches, left=left)
        found[f"trees, {name}"] = ratios(score(study, features, layer, trusted, learner), alone)
    return found


def main() -> None:
    """Scores the folds and prints the tables; what is done is kept in ``--out``."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("out/network"))
    add_data_option(parser)
    parser.add_argument("--only", default="", help="folds whose names begin so")
    parser.add_argument("--steps", action="store_true", help="the throttle's steps alone, on further cells and logs")
    parser.add_argument("--test", action="store_true", help="with --steps: on what is for publishing only")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    out = arguments.out / ("steps_test" if arguments.test else "steps") if arguments.steps else arguments.out
    out.mkdir(parents=True, exist_ok=True)
    wanted = further_folds(arguments.data, arguments.test) if arguments.steps else folds(arguments.data)
    known = kept(wanted, steps_scored if arguments.steps else scored, out, arguments.only)
    print(by_group(known) if arguments.steps else tables(known))


def kept(
    wanted: Mapping[str, Callable[[], Fold]], score: Callable[[Study], dict[str, list[float]]], out: Path, only: str
) -> dict[str, dict[str, list[float]]]:
    """Scores of the folds whose names begin with ``only``, and of those that lie in ``out``, where all are kept."""
    known: dict[str, dict[str, list[float]]] = {}
    for name, fold in wanted.items():
        file = out / f"{name}.json"
        if not file.is_file() and name.startswith(only):
            study = Study.of(fold(), out)
            if study.moves:
                write_json(file, score(study))
        if file.is_file():
            known[name] = json.loads(file.read_text(encoding="utf-8"))
    return known


if __name__ == "__main__":
    main()
