"""A model that is to take the place of another while the car drives, tried before in a process of its own.

There it is opened, predicts the last seconds, and is compared with what was measured and with the calibrated car. That
process has limits of memory and time: a model that takes all of either ends it, and not the node.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from dynssm_ros.arrays import Vector
from dynssm_ros.errors import ArtifactError
from dynssm_ros.extras import load_plugins
from dynssm_ros.runtime.artifact import ModelCard, parse_artifact
from dynssm_ros.runtime.baselines import SingleTrack
from dynssm_ros.runtime.bounded import answer, ask
from dynssm_ros.runtime.contract import WindowPrediction
from dynssm_ros.runtime.learner import OnlineLearner
from dynssm_ros.runtime.onnx_model import OnnxModel
from dynssm_ros.runtime.plausibility import Plausibility
from dynssm_ros.signals.inputs import WINDOW_COLUMNS
from dynssm_ros.signals.signal_map import STATE_SIGNALS

_MASS, _WHEELBASE = 0.25, 0.1  # relative differences of one car from day to day
_PREDICTING_S = 0.5  # for the windows that are compared
_FEWEST, _MOST = 25, 250  # windows that are compared
_MANY = 5.0  # times as large errors
_USUAL_ERROR = 0.2  # of a good model, in s_delta
_TOLERATED = 0.05  # share of implausible predictions
_STEADY_SPEEDS = 0.1, 0.3, 0.5  # of a car that has not driven yet, in top speeds of the plausible range


def try_model(path: Path, files: Mapping[str, bytes], present: ModelCard, rows: Vector) -> None:
    """Tries the model in ``files``, as :func:`~dynssm_ros.runtime.artifact.read_folder` gives them, in another process.

    Args:
        path: of the folder.
        files: its content.
        present: card of the model that it is to replace.
        rows: of the last seconds, T_s of ``present`` apart, ``(N, 7)``.

    Raises:
        ArtifactError: it is not usable, or predicts worse by far than the calibrated car.
    """
    ask("dynssm_ros.runtime.trial", path, dict(files), present, rows)


def require_same_use(model: OnnxModel, present: ModelCard) -> None:
    """Checks that ``model`` is for the commands, the sampling time and the car of the ``present`` one.

    Raises:
        ArtifactError: it is not.
    """
    path, card = model.artifact.path, model.card
    if model.commands != present.commands:
        raise ArtifactError(
            f"{path}: trained with commands '{model.commands}', but the node runs with '{present.commands}'; restart it "
            "with this model"
        )
    m, wheelbase = card.vehicle.constants.m, card.vehicle.constants.wheelbase
    own = present.vehicle.constants.m, present.vehicle.constants.wheelbase
    for what, value, expected, tolerance in (
        ("T_s = {:g} s", card.sampling_time, present.sampling_time, 1e-6),
        ("m = {:g} kg", m, own[0], _MASS),
        ("wheelbase {:g} m", wheelbase, own[1], _WHEELBASE),
    ):
        if abs(value - expected) > tolerance * expected:
            raise ArtifactError(
                f"{path}: {what.format(value)} is another car's, of vehicle {card.vehicle.name}; the node runs with "
                f"{expected:g}; restart it with this model"
            )


def judge(model: OnnxModel, present: ModelCard, rows: Vector) -> bool:
    """Compares what ``model`` predicts of ``rows`` ``(N, 7)`` with what was measured and with the calibrated car.

    Before a car has driven for long enough, only whether its predictions are plausible is looked at.

    Returns:
        whether it has driven for long enough.

    Raises:
        ArtifactError: errors many times as large as those of the physics, implausible predictions, or later than T_s.
    """
    seconds = _seconds(model)
    if seconds > model.T_s:
        raise ArtifactError(f"{model.artifact.path}: takes {seconds:.3g} s for a prediction; expected less than T_s")
    rows = rows[-model.H - max(_FEWEST, min(_MOST, int(_PREDICTING_S / seconds))) :]
    windows = np.moveaxis(np.lib.stride_tricks.sliding_window_view(rows, model.H, axis=0), -1, 1) if (
        len(rows) >= model.H
    ) else np.empty((0, model.H, len(WINDOW_COLUMNS)))  # fmt: skip
    measured, windows = rows[model.H :, :3], windows[:-1]
    fast = np.abs(windows[:, :, 0]).min(axis=1, initial=np.inf) >= present.vehicle.minimum_speed
    compared = int(fast.sum()) >= _FEWEST
    if not compared:
        windows = _steady_windows(model)
    physics = SingleTrack(present.vehicle, present.integrator, present.substeps)
    scale = np.array(present.normalisation.increment_scale)
    learners = [None] if model.online is None else [None, OnlineLearner(model, model.online, judges=False)]
    for learner in learners:  # without the layer too: slow cars and some nodes are predicted so
        predicted = _predicted(model, learner, windows)
        _require_plausible(model, windows, predicted)
        if not compared:
            continue
        followed = np.array([each.state[0] for each in predicted])
        own, calibrated, unchanged = (
            np.sqrt(np.mean((states - measured)[fast] ** 2, axis=0))
            for states in (followed, physics.predict(windows).state, windows[:, -1, :3])
        )
        ratio = own / np.maximum(calibrated, _USUAL_ERROR * scale)
        worst = int(np.argmax(ratio))
        if ratio[worst] > _MANY and own[worst] > unchanged[worst]:
            raise ArtifactError(
                f"{model.artifact.path}: its error of {STATE_SIGNALS[worst]} over the last {len(windows) * model.T_s:.1f} s "
                f"is {own[worst]:.3g}, that of the calibrated car {calibrated[worst]:.3g}; restart the node with this model "
                "to use it all the same"
            )
    return compared


def _steady_windows(model: OnnxModel) -> Vector:
    """Straight drives at constant speeds ``(3, H, 7)``."""
    windows = np.zeros((len(_STEADY_SPEEDS), model.H, len(WINDOW_COLUMNS)))
    windows[:, :, 0] = model.vehicle.minimum_speed + np.array(_STEADY_SPEEDS)[:, None] * Plausibility(model.vehicle).top
    windows[:, :, WINDOW_COLUMNS.index("r_fb")] = model.vehicle.inputs.coasting(windows[:, :, 0])
    return windows


def _predicted(model: OnnxModel, learner: OnlineLearner | None, windows: Vector) -> list[WindowPrediction]:
    """What the model says of successive windows ``(N, H, 7)``, corrected by what is learned from them."""
    return [model.predict(window[None]) if learner is None else learner.predict(window)[0] for window in windows]


def _seconds(model: OnnxModel) -> float:
    """How long a prediction takes (s), the shortest of three."""
    taken, window = [], _steady_windows(model)[:1]
    for _ in range(3):
        begin = time.perf_counter()
        model.predict(window)
        taken.append(time.perf_counter() - begin)
    return min(taken)


def _require_plausible(model: OnnxModel, windows: Vector, predicted: list[WindowPrediction]) -> None:
    plausibility, reasons = Plausibility(model.vehicle), []
    for window, each in zip(windows, predicted, strict=True):
        state, theta, variance = each.numbers()
        if not all(map(math.isfinite, (*state, *theta, *variance))):
            raise ArtifactError(f"{model.artifact.path}: what it predicts is not finite; expected numbers")
        now = window[-1, :3].tolist()
        reasons.append(plausibility.of_prediction(now, state, model.T_s, variance=variance, theta=theta))
    wrong = [reason for reason in reasons if reason]
    if len(wrong) > _TOLERATED * len(reasons):
        raise ArtifactError(f"{model.artifact.path}: {wrong[0]}; {len(wrong)} of {len(reasons)} predictions are so")


def _try(path: Path, files: Mapping[str, bytes], present: ModelCard, rows: Vector) -> None:
    model = OnnxModel(parse_artifact(path, files))
    require_same_use(model, present)
    judge(model, present, rows)


if __name__ == "__main__":
    answer(_try, load_plugins)
