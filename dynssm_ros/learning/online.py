"""The online layer's features as a torch module, and its prior from training laps.

The features of a channel are linear in what it may learn: the physics' increments, the network's, what was measured lately,
how the inputs change, where the car is. All are in units that make one the usual size.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import accumulate
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from dynssm_ros.arrays import Indices, Vector
from dynssm_ros.errors import ConfigurationError, RecordingError
from dynssm_ros.learning.losses import Output
from dynssm_ros.learning.models.base import OnlineConfig, scale_buffers, steps_of
from dynssm_ros.learning.models.physics import PhysicsConfig, PhysicsLayer
from dynssm_ros.runtime.artifact import Normalisation
from dynssm_ros.runtime.coefficients import BlockErrors, CoefficientEstimator
from dynssm_ros.runtime.online import CHANNELS, MEAN_ERROR, Along, Learned, OnlineLayer, OnlineLayerCard, Seen
from dynssm_ros.signals.recording import Recording
from dynssm_ros.signals.signal_map import STATE_SIGNALS
from dynssm_ros.vehicle import Vehicle

_BLOCK = 4096  # rows that are worked on at once
_PRIOR_ROWS = (10.0, 40.0, 160.0)
_TOLERANCE = 0.01  # of the RMSE on left-out parts
_RIDGE = 1e-4  # of a feature's mean square: draws weights that the laps leave open to the physics alone
_SMALLEST = 1e-12  # of a mean square
_LARGEST_CHANGE = 1.0  # standard deviation of a weight of which the laps say nothing
_LEAST_NOISE = 1e-4  # variance, in squared s_delta: no car is known better than to a hundredth of an increment


class OnlineFeatures(nn.Module):
    """Maps raw windows and a model's output to features ``(B, 3, n)``, in the order of :attr:`names`."""

    mean: Tensor
    std: Tensor
    increment_scale: Tensor
    input_scale: Tensor
    nominal: Tensor
    one: Tensor
    places: Tensor

    def __init__(
        self,
        config: OnlineConfig,
        vehicle: Vehicle,
        physics: PhysicsConfig,
        scale: Normalisation,
        H: int,
        *,
        network: bool,
    ) -> None:
        super().__init__()
        if H < 3:
            raise ConfigurationError(f"online: a window of {H} rows; expected at least 3 to see how it changes")
        self.physics = PhysicsLayer(vehicle, physics)
        self.register_buffer("nominal", physics.theta_0(vehicle))
        scale_buffers(self, scale)
        self.register_buffer("input_scale", 0.1 * self.std[3:5])  # what an input changes in a step, about
        self.network = network
        self.lags = min(config.lags, H - 1)
        self.other_lags = min(config.other_lags, H - 1)
        self.input_lags = min(config.input_lags, H - 1)
        self.errors = min(steps_of(config.error_average, vehicle.sampling_time), H - 1)
        self.recent = max(self.lags, self.other_lags)
        self.names = self._names()
        self.register_buffer("one", torch.ones(1, 1))
        self.register_buffer("places", self._places())

    def _names(self) -> tuple[str, ...]:
        lags, others = range(self.lags), range(self.other_lags)
        changes = [f"change of {name}, {k} steps ago" for k in range(self.input_lags) for name in ("r", "delta")]
        return (
            "physics", "physics, next channel", "physics, channel after",
            *(["network"] if self.network else []),
            *(f"increment, {k + 1} steps ago" for k in lags),
            *(f"increment of the {which}, {k + 1} steps ago" for k in others for which in ("next", "one after")),
            *changes, *STATE_SIGNALS, "r_fb", "delta_fb", MEAN_ERROR, "one",
        )  # fmt: skip

    def forward(self, window: Tensor, output: Output) -> tuple[Tensor, Tensor]:
        """Windows ``(B, H, 7)`` to features ``(B, 3, n)`` and the physics' increments ``(B, 3)`` (m/s, m/s, rad/s)."""
        increments = (window[:, 1:, :CHANNELS] - window[:, :-1, :CHANNELS]) / self.increment_scale
        over = self.physics.over(window, self.nominal, self.errors + 1) if output.nominal is None else output.nominal
        over = over[:, -self.errors - 1 :]
        mean_error = increments[:, -self.errors :].mean(1) - (over[:, :-1].mean(1)) / self.increment_scale
        inputs = window[:, -self.input_lags - 1 :, 3:7]
        applied = inputs[..., :2] + inputs[..., 2:]
        changes = (applied[:, 1:] - applied[:, :-1]) / self.input_scale
        level = (window[:, -1, :5] - self.mean[:5]) / self.std[:5]
        physics = over[:, -1]
        parts = [physics / self.increment_scale, increments[:, -self.recent :].flatten(1), changes.flatten(1), level]
        parts += [mean_error, *([output.increment / self.increment_scale] if self.network else [])]
        found = torch.cat([*parts, self.one.expand(window.shape[0], -1)], -1)
        return found[:, self.places], physics

    def _places(self) -> Tensor:
        """Where the features of each channel stand among those of all, ``(3, n)``."""
        names = ("physics", "increments", "changes", "level", "error", "network", "one")
        sizes = (CHANNELS, CHANNELS * self.recent, 2 * self.input_lags, 5, CHANNELS, CHANNELS * self.network)
        at = dict(zip(names, accumulate(sizes, initial=0), strict=True))
        rows = []
        for c in range(CHANNELS):
            following = [(c + k) % CHANNELS for k in range(CHANNELS)]  # the channel itself, the next, the one after
            back = [at["increments"] + CHANNELS * (self.recent - 1 - k) for k in range(self.recent)]
            rows.append([
                *(at["physics"] + k for k in following),
                *([at["network"] + c] if self.network else []),
                *(back[k] + c for k in range(self.lags)),
                *(back[k] + which for k in range(self.other_lags) for which in following[1:]),
                *(at["changes"] + 2 * (self.input_lags - 1 - k) + u for k in range(self.input_lags) for u in range(2)),
                *(at["level"] + k for k in range(5)),
                at["error"] + c, at["one"],
            ])  # fmt: skip
        return torch.tensor(rows)


class LayerDrive(NamedTuple):
    """What the prior is fitted to: what the layer sees of a recording's windows, and what happened next."""

    see: Callable[[slice], Seen]
    """Of some of the windows; computed anew each time, so that memory does not grow with the laps."""
    recording: Recording  # the laps
    ends: Indices  # the last row of each window, (N,), ascending
    starts: Indices  # the windows from which paths are predicted, ascending

    def measured(self, block: slice) -> tuple[Vector, Vector]:
        """The last rows of some windows, ``(n, 7)``, and the increments to the next, ``(n, 3)`` (m/s, m/s, rad/s)."""
        ends = self.ends[block]
        rows = self.recording.rows(ends)
        return rows, self.recording.states(ends + 1) - rows[:, :CHANNELS]

    def blocks(self) -> Iterator[tuple[slice, Seen]]:
        """All windows in order, some at a time; an empty block if there are none."""
        for begin in range(0, max(len(self.ends), 1), _BLOCK):
            block = slice(begin, begin + _BLOCK)
            yield block, self.see(block)


class LeftOut(NamedTuple):
    """A layer along a part of the laps that its prior was fitted without."""

    layer: OnlineLayer
    squares: Vector  # sum of its squared one-step errors, (3,), in units of s_delta squared
    known: Learned  # what it knew at the drive's starts


class FittedLayer(NamedTuple):
    """The layer with its prior, and what says how good it is."""

    layer: OnlineLayer
    error: float  # geometric mean over the channels of the RMSE on the parts that are left out, in units of s_delta
    left_out: list[LeftOut]


def fit_layer(
    parts: list[LayerDrive], features: OnlineFeatures, scale: Normalisation, config: OnlineConfig
) -> FittedLayer:
    """The layer with its prior, judged on parts of the laps that the prior was fitted without.

    The prior's mean is the least-squares solution on the training laps. Its covariance is that of so many
    rows of them, and no weight is expected to change by more than one.
    The number of rows is the least of :data:`_PRIOR_ROWS` with which the layer predicts ``parts`` of the laps, each with a
    prior that was fitted without it, at most 1 % worse than with the best: another track asks for a weaker prior than
    another part of the same one. Their network features are of models that do not know them.

    Raises:
        RecordingError: there are no windows to fit it to.
    """
    if not any(len(part.ends) for part in parts):
        raise RecordingError(
            "online: no window at the vehicle's minimum speed or more; expected some to fit the prior to"
        )
    s_delta: Vector = np.array(scale.increment_scale)
    moments = [_moments(part, s_delta) for part in parts]
    others = [[*moments[:k], *moments[k + 1 :]] if len(parts) > 1 else moments for k in range(len(parts))]

    vehicle, stepping = features.physics.vehicle, features.physics.stepping
    nothing = BlockErrors(np.ones(CHANNELS), np.ones(CHANNELS))
    estimator = CoefficientEstimator(vehicle, s_delta, nothing, *stepping, spread=config.spread)
    usual = estimator.usual_errors((part.ends, part.measured) for part in parts)

    def layer(prior: _Prior, rows: float, spread: dict[str, float]) -> OnlineLayer:
        card = OnlineLayerCard(features=features.names, memory=config.memory, prior_rows=rows, spread=spread)
        precision = rows * prior.gram / prior.noise[:, None, None] + np.eye(len(features.names)) / _LARGEST_CHANGE**2
        covariance = np.linalg.inv(precision).astype(np.float64)
        return OnlineLayer(
            card, prior.mean, covariance, prior.noise, prior.physics, usual.noise, usual.slow, s_delta, vehicle, *stepping,
        )  # fmt: skip

    trials = [
        _along(part, [layer(_least_squares(rest), rows, {}) for rows in _PRIOR_ROWS])
        for part, rest in zip(parts, others, strict=True)
    ]
    count = sum(len(part.ends) for part in parts)
    mean_square = (
        np.array([np.sum([each.squares for each in trial], axis=0) for trial in zip(*trials, strict=True)]) / count
    )
    losses = 0.5 * np.log(mean_square + _SMALLEST).mean(axis=1)
    chosen = int(np.argmax(losses <= losses.min() + np.log1p(_TOLERANCE)))
    whole = layer(_least_squares(moments), _PRIOR_ROWS[chosen], config.spread)
    return FittedLayer(whole, float(np.exp(losses[chosen])), [trial[chosen] for trial in trials])


def _along(drive: LayerDrive, layers: list[OnlineLayer]) -> list[LeftOut]:
    """Drives layers along a part of the laps, each for itself."""
    learning = [Along(layer) for layer in layers]
    squares = np.zeros((len(layers), CHANNELS))
    known: list[list[Learned]] = [[] for _ in layers]
    for block, seen in drive.blocks():
        (rows, increments), ends = drive.measured(block), drive.ends[block]
        starts = drive.starts[(drive.starts >= block.start) & (drive.starts < block.stop)] - block.start
        for k, layer in enumerate(layers):
            learned = learning[k].over(seen, rows, increments, ends)
            errors = (layer.increments(seen.features, learned.weights) - increments) / layer.scale
            squares[k] += np.sum(errors**2, axis=0)
            known[k].append(learned.at(starts))
    return [
        LeftOut(layer, squares[k], Learned(*(np.concatenate(each) for each in zip(*known[k], strict=True))))
        for k, layer in enumerate(layers)
    ]


class _Prior(NamedTuple):
    mean: Vector
    gram: Vector
    noise: Vector
    physics: Vector


class _Moments(NamedTuple):
    """What least squares needs of a drive; sums over its rows, which add up over drives."""

    rows: int
    gram: Vector  # of the features, (3, n, n)
    moment: Vector  # of features with the physics' errors, (3, n)
    square: Vector  # of the physics' errors, (3,), in units of s_delta squared


def _moments(drive: LayerDrive, s_delta: Vector) -> _Moments:
    parts = []
    for block, (F, physics) in drive.blocks():
        error = (drive.measured(block)[1] - physics) / s_delta
        gram = np.einsum("kci,kcj->cij", F, F, optimize=True)
        parts.append(_Moments(len(error), gram, np.einsum("kci,kc->ci", F, error), np.sum(error**2, axis=0)))
    return _added(parts)


def _added(parts: list[_Moments]) -> _Moments:
    rows, *sums = (sum(each) for each in zip(*parts, strict=True))
    return _Moments(rows, *sums)


def _least_squares(parts: list[_Moments]) -> _Prior:
    """Weights by least squares, drawn to the physics alone; the mean Gram matrix, mean square errors."""
    rows, total, moment, square = _added(parts)
    n = total.shape[1]
    alone = np.zeros((CHANNELS, n))
    alone[:, 0] = 1.0
    if rows == 0:
        one = np.ones(CHANNELS)
        return _Prior(alone, np.tile(np.eye(n), (CHANNELS, 1, 1)), one, one)
    ridge = _RIDGE * np.einsum("cii->ci", total) / rows + _SMALLEST
    gram = total / rows + ridge[:, None, :] * np.eye(n)
    change = np.linalg.solve(gram, moment[..., None] / rows)[..., 0]
    noise = square + np.einsum("ci,ci->c", change, np.einsum("cij,cj->ci", total, change) - 2.0 * moment)
    return _Prior(alone + change, gram, *(np.maximum(each / rows, _LEAST_NOISE) for each in (noise, square)))
