"""The online layer's prior from training laps."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from dynssm_ros.arrays import Indices, Vector
from dynssm_ros.errors import RecordingError
from dynssm_ros.learning.models.base import OnlineConfig
from dynssm_ros.runtime.along import Along
from dynssm_ros.runtime.artifact import Normalisation
from dynssm_ros.runtime.coefficients import BlockErrors, CoefficientEstimator
from dynssm_ros.runtime.features import LayerFeatures
from dynssm_ros.runtime.online import CHANNELS, Learned, OnlineLayer, OnlineLayerCard, Seen
from dynssm_ros.signals.recording import Recording

_BLOCK = 4096  # rows that are worked on at once
_PRIOR_ROWS = (10.0, 40.0, 160.0)
_TOLERANCE = 0.01  # of the RMSE on left-out parts
_RIDGE = 1e-4  # of a feature's mean square: draws weights that the laps leave open to the physics alone
_SMALLEST = 1e-12  # of a mean square
_LARGEST_CHANGE = 1.0  # standard deviation of a weight of which the laps say nothing
_LEAST_NOISE = 1e-4  # variance, in squared s_delta: no car is known better than to a hundredth of an increment


class LayerDrive(NamedTuple):
    """What the prior is fitted to: what the layer sees of a recording's windows, and what happened next."""

    see: Callable[[slice], Seen]
    """Of some of the windows; computed anew each time, so that memory does not grow with the laps."""
    recording: Recording  # the laps
    ends: Indices  # the last row of each window, (N,), ascending
    starts: Indices  # the windows from which paths are predicted, ascending

    @classmethod
    def of(
        cls,
        recording: Recording,
        ends: Indices,
        H: int,
        see: Callable[[Vector], Seen],
        *,
        starts: Indices | None = None,
    ) -> LayerDrive:
        """The windows of ``H`` rows of a recording that end at ``ends``, seen by ``see``; no paths without ``starts``."""
        return cls(
            lambda block: see(recording.windows(ends[block], H)),
            recording,
            ends,
            ends[:0] if starts is None else starts,
        )

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
    parts: list[LayerDrive], features: LayerFeatures, scale: Normalisation, config: OnlineConfig
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
    moments = [moments_of(part, s_delta) for part in parts]
    others = [[*moments[:k], *moments[k + 1 :]] if len(parts) > 1 else moments for k in range(len(parts))]

    vehicle, stepping = features.vehicle, features.stepping
    nothing = BlockErrors(np.ones(CHANNELS), np.ones(CHANNELS))
    estimator = CoefficientEstimator(vehicle, s_delta, nothing, *stepping, spread=config.spread)
    usual = estimator.usual_errors((part.ends, part.measured) for part in parts)

    def layer(prior: _Prior, rows: float, spread: dict[str, float]) -> OnlineLayer:
        card = OnlineLayerCard(
            features=features.names, error_rows=features.layout.errors, memory=config.memory, prior_rows=rows,
            spread=spread,
        )  # fmt: skip
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


class Moments(NamedTuple):
    """What least squares needs of a drive; sums over its rows, which add up over drives."""

    rows: int
    gram: Vector  # of the features, (3, n, n)
    moment: Vector  # of features with the physics' errors, (3, n)
    square: Vector  # of the physics' errors, (3,), in units of s_delta squared


def moments_of(drive: LayerDrive, s_delta: Vector) -> Moments:
    """Those of a drive; ``s_delta``: scale of increments (m/s, m/s, rad/s), ``(3,)``."""
    parts = []
    for block, (F, physics) in drive.blocks():
        error = (drive.measured(block)[1] - physics) / s_delta
        gram = np.einsum("kci,kcj->cij", F, F, optimize=True)
        parts.append(Moments(len(error), gram, np.einsum("kci,kc->ci", F, error), np.sum(error**2, axis=0)))
    return _added(parts)


def _added(parts: list[Moments]) -> Moments:
    rows, *sums = (sum(each) for each in zip(*parts, strict=True))
    return Moments(rows, *sums)


def _least_squares(parts: list[Moments]) -> _Prior:
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
