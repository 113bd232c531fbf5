"""The online layer of a trained model: its prior, and whether steps of the throttle and the network earn a place in it.

The evidence are parts of the training laps, each predicted by a network that was trained without it and a layer whose prior
was fitted without it: one step ahead, and the path over the horizon of a controller.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import numpy as np
import torch

from dynssm_ros.arrays import Indices, Vector
from dynssm_ros.errors import ConfigurationError
from dynssm_ros.learning.models.base import OnlineConfig, TrainableModel, steps_of
from dynssm_ros.learning.models.physics import PhysicsConfig
from dynssm_ros.learning.online import FittedLayer, LayerDrive, LeftOut, fit_layer
from dynssm_ros.runtime.artifact import Normalisation
from dynssm_ros.runtime.features import FeatureLayout, LayerFeatures
from dynssm_ros.runtime.online import OnlineLayer, Seen
from dynssm_ros.runtime.rollout import RolloutCorrection, path_errors, roll_out
from dynssm_ros.signals.inputs import applied_inputs
from dynssm_ros.signals.recording import Recording
from dynssm_ros.vehicle import Vehicle
from dynssm_ros.vehicle.kinematics import PATH_HORIZON_S

GAIN_WANTED = 0.03
"""Network or steps of the throttle that take away less of the online layer's error are left out of it. On the development
cells of the generalisation matrix, gains of 1 to 2 % on left-out laps did not carry over to another track."""
_FEWEST_ROWS = 3  # of a window
_STRETCHES = 4  # of the laps, for a layer without a network, and for steps of the throttle
_STARTS = 400  # rollouts in a part, at most
_LEAST_UNDRIVEN = 0.03
"""Share of the rows without drive that steps of the throttle need: they are about zero throttle, which laps that never coast
do not show. With 0.9 % they took 6 % off left-out stretches of their log, and cost 6 % of the path on 15 other logs;
with 5.6 to 15 % they carried over."""

Part = tuple[TrainableModel, Recording]  # a part of the laps, and a model that does not know it


class LayerBase(NamedTuple):
    """What the layer stands on."""

    vehicle: Vehicle
    physics: PhysicsConfig
    normalisation: Normalisation
    H: int  # rows of the model's window
    config: OnlineConfig

    def features(self, network: bool) -> LayerFeatures:
        """What the layer sees, with a network's prediction or without.

        Raises:
            ConfigurationError: the window has too few rows, or the car has no throttle whose steps could be a feature.
        """
        config, scale, most = self.config, self.normalisation, self.H - 1
        if most < _FEWEST_ROWS - 1:
            raise ConfigurationError(
                f"online: a window of {self.H} rows; expected at least {_FEWEST_ROWS} to see how it changes"
            )
        if config.throttle_steps and (what := self.vehicle.inputs.set_point) != "throttle":
            raise ConfigurationError(
                f"online: throttle_steps: true, but vehicle {self.vehicle.name} has inputs.set_point: {what}; "
                "expected throttle"
            )
        errors = steps_of(config.error_average, self.vehicle.sampling_time)
        layout = FeatureLayout(
            min(config.lags, most),
            min(config.other_lags, most),
            min(config.input_lags, most),
            min(errors, most),
            network,
            bool(config.throttle_steps),
        )
        integrator, substeps = self.physics.stepping(self.vehicle)
        return LayerFeatures(
            layout, self.vehicle, mean=np.array(scale.input_mean), std=np.array(scale.input_std),
            increment_scale=np.array(scale.increment_scale), integrator=integrator, substeps=substeps,
        )  # fmt: skip

    @property
    def path_steps(self) -> int:
        """Steps of a controller's horizon."""
        return steps_of(PATH_HORIZON_S, self.vehicle.sampling_time)

    def starts(self, recording: Recording) -> Indices:
        """Rows from which paths are predicted: some of those that a whole path follows, ascending."""
        rows: Indices = recording.window_ends(self.H, self.path_steps, self.vehicle.minimum_speed)
        return rows[:: max(1, len(rows) // _STARTS)]

    def fitted(self, features: LayerFeatures, parts: list[Part]) -> FittedLayer:
        """The layer, its prior fitted to ``parts``."""
        drives = [_drive(features, model, part, self) for model, part in parts]
        return fit_layer(drives, features, self.normalisation, self.config)


class Earned(NamedTuple):
    """An online layer with what earned its place."""

    features: LayerFeatures
    layer: OnlineLayer
    throttle_gain: float | None = None
    """Share of the error that the throttle's steps take away; ``None`` if they were not tried."""
    network_gain: float | None = None
    """The same of the network; ``None`` if there is none, or no evidence."""


def earned_layer(base: LayerBase, model: TrainableModel, laps: Recording, left_out: list[Part]) -> Earned:
    """The online layer, with the throttle's steps and with the network where they earn their place.

    A gain is the share of the error that is taken away: the mean of one step and path, or of the path alone if that is
    less, since a controller needs the path. Without ``left_out`` parts of the laps there is no evidence of the network, and
    the layer rests on the physics alone.
    """
    base, alone, layer, throttle_gain = _with_steps(base, model, laps)
    if not model.LEARNS or not left_out:
        return Earned(alone, layer, throttle_gain)
    together = base.features(True)
    with_network = base.fitted(together, left_out)
    gain = _gain(base, left_out, (together, with_network), (alone, base.fitted(alone, left_out)))
    if gain >= GAIN_WANTED:
        return Earned(together, with_network.layer, throttle_gain, gain)
    return Earned(alone, layer, throttle_gain, gain)


def _with_steps(
    base: LayerBase, model: TrainableModel, laps: Recording
) -> tuple[LayerBase, LayerFeatures, OnlineLayer, float | None]:
    """The base with the throttle's steps decided, features and layer on its physics alone, and the steps' gain."""
    stretches = [(model, part) for part in map(laps.select, laps.stretches(_STRETCHES))]
    plain = base.features(False)
    without = base.fitted(plain, stretches)
    asked = base.config.throttle_steps is None and base.vehicle.inputs.set_point == "throttle"
    if not asked or _undriven(base, laps) < _LEAST_UNDRIVEN or not any(len(base.starts(part)) for _, part in stretches):
        return base, plain, without.layer, None
    bent = base._replace(config=base.config.model_copy(update={"throttle_steps": True}))
    steps = bent.features(False)
    with_steps = bent.fitted(steps, stretches)
    gain = _gain(base, stretches, (steps, with_steps), (plain, without))
    return (bent, steps, with_steps.layer, gain) if gain >= GAIN_WANTED else (base, plain, without.layer, gain)


def _undriven(base: LayerBase, laps: Recording) -> float:
    """Share of the rows at the vehicle's minimum speed or more without drive: coasting, or braking."""
    rows = laps.window_ends(1, min_speed=base.vehicle.minimum_speed)
    throttle = applied_inputs(laps.rows(rows).T).r
    return float(np.mean(throttle <= 0.0)) if len(rows) else 0.0


def _gain(
    base: LayerBase,
    parts: list[Part],
    now: tuple[LayerFeatures, FittedLayer],
    before: tuple[LayerFeatures, FittedLayer],
) -> float:
    """Share of the error on parts that are not known that one layer takes off another's; see :func:`earned_layer`."""
    step, path = _errors(base, *now, parts) / _errors(base, *before, parts)
    return float(1.0 - max(np.sqrt(step * path), path))


def _errors(base: LayerBase, features: LayerFeatures, fitted: FittedLayer, parts: list[Part]) -> Vector:
    """Geometric mean of the one-step errors, and mean distance of the path, on parts that are not known, ``(2,)``."""
    distances = [
        _path_error(base, features, left_out, model, recording)
        for left_out, (model, recording) in zip(fitted.left_out, parts, strict=True)
    ]
    return np.array([fitted.error, np.nanmean(np.concatenate(distances))])


def _drive(features: LayerFeatures, model: TrainableModel, recording: Recording, base: LayerBase) -> LayerDrive:
    """What the layer sees of the windows of a recording, with what ``model`` predicts from them."""
    ends = recording.window_ends(base.H, min_speed=base.vehicle.minimum_speed)
    see = partial(_seen, features, model.eval())
    starts = np.searchsorted(ends, base.starts(recording))
    return LayerDrive.of(recording, ends, base.H, see, starts=starts)


def _seen(features: LayerFeatures, model: TrainableModel, windows: Vector) -> Seen:
    """What the layer sees of windows ``(N, H, 7)``; the network is asked only if its prediction is among it."""
    if not features.layout.network:
        return features.seen(windows)
    with torch.no_grad():
        increment: Vector = model(torch.tensor(windows, dtype=torch.float32)).increment.double().numpy()
    return features.seen(windows, increment)


def _path_error(
    base: LayerBase, features: LayerFeatures, left_out: LeftOut, model: TrainableModel, recording: Recording
) -> Vector:
    """Mean distance (m) of predicted from measured paths, for each of some starts; NaN for what diverges."""
    H, steps, starts = base.H, base.path_steps, base.starts(recording)
    if len(starts) == 0:
        return np.empty(0)
    rows, correction = recording.windows(starts, H, steps), RolloutCorrection(left_out.layer, left_out.known)

    def step(windows: Vector) -> Vector:
        moved = correction.increments(_seen(features, model, windows))
        following: Vector = windows[:, -1, :3] + moved
        return following

    errors = path_errors(rows[:, H - 1 : H, :3], roll_out(step, rows, H), rows[:, H:, :3], left_out.layer.T_s)
    distance: Vector = errors.mean(axis=1)
    return distance
