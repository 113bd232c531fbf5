"""The online layer: a Bayesian linear last layer that keeps learning over the whole drive.

For each channel the next increment is a linear function of features of the window: what the physics and the network predict,
what was measured lately, how the inputs change. Its weights follow an Ornstein-Uhlenbeck process whose stationary
distribution is the prior that training found; a Kalman filter estimates them from one measured increment after the other.
This is recursive least squares that forgets towards the prior. It learns in the same way as the last layers of ALPaCA
(Harrison et al. 2018) and Neural-Fly (O'Connell et al. 2022).

Beside the layer, the physics' coefficients are followed (:mod:`dynssm_ros.runtime.coefficients`). They are published, and do
not enter the prediction: the layer takes the same errors off, and more of them.

The features are stateless (:mod:`dynssm_ros.runtime.features`). What is learned is one small :class:`OnlineState`.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from pydantic import Field

from dynssm_ros import compiled
from dynssm_ros.arrays import Indices, Mask, Vector
from dynssm_ros.compiled import address
from dynssm_ros.configuration import StrictModel
from dynssm_ros.errors import ArtifactError
from dynssm_ros.files import replacing
from dynssm_ros.runtime.coefficients import BlockErrors, CoefficientEstimator
from dynssm_ros.runtime.tensors import as_tensors, read_tensors
from dynssm_ros.signals.signal_map import STATE_SIGNALS
from dynssm_ros.vehicle import Vehicle
from dynssm_ros.vehicle.integrators import Integrator
from dynssm_ros.vehicle.kinematics import PATH_HORIZON_S

CHANNELS = 3
MEAN_ERROR = "mean error of the physics"
_OUTLIER = 4.0  # errors beyond this many standard deviations weigh less (Huber)
_LARGEST = 10.0  # no innovation moves the noise estimate by more than this many standard deviations
_NOISE_MEMORY_S = 8.0  # over which the noise and the physics' errors are averaged
_COVERED, _QUANTILE = 0.9, 1.6448536  # stated intervals are to cover this share of errors
_WIDTH_RATE, _WIDEST = 0.02, 5.0  # of the stated interval's adaptation: per step, and the largest factor
_RECENT_S = 1.0  # over which errors are compared with what was stated
_ROLLOUT_LIMIT = 3.0  # correction in a rollout, in root mean squares of the physics' recent errors
_SMALLEST = 1e-9  # noise, in units of s_delta


class OnlineLayerCard(StrictModel):
    """What ``model.yaml`` says of the online layer."""

    features: tuple[str, ...] = Field(min_length=1, description="names of the features of a channel, in order")
    error_rows: int | None = Field(
        default=None,
        ge=1,
        description="rows over which the physics' error is averaged; null: the graph computes the features (0.4 and before)",
    )
    memory: float = Field(gt=0, description="time constant with which weights return to the prior (s)")
    prior_rows: float = Field(gt=0, description="rows of driving that the prior is worth")
    spread: dict[str, float] = Field(
        description="how far coefficients change, as in an OnlineConfig; empty: not at all"
    )


class Seen(NamedTuple):
    """What the layer sees of ``N`` windows."""

    features: Vector
    """``(N, 3, n)``, in units that make one the usual size."""
    physics: Vector
    """Increments of the physics with nominal coefficients, ``(N, 3)`` (m/s, m/s, rad/s)."""

    def at(self, rows: Indices | slice) -> Seen:
        """What it sees of some of them."""
        return Seen(self.features[rows], self.physics[rows])


class Learned(NamedTuple):
    """What an :class:`OnlineState` knows at each of ``N`` rows: all that a prediction from there needs."""

    weights: Vector
    """``(N, 3, n)``, in units of s_delta."""
    variance: Vector
    """Of the error of the next prediction, ``(N, 3)``, in units of s_delta squared."""
    limit: Vector
    """Largest correction of the physics in a rollout, ``(N, 3)``, in units of s_delta."""
    theta: Vector
    """Coefficients, ``(N, 17)``."""
    trusted: Vector
    """Whether the layer's paths are believed, ``(N,)``; see :mod:`dynssm_ros.runtime.path_judge`."""

    def at(self, rows: Indices) -> Learned:
        """What was known at ``rows``."""
        return Learned(*(part[rows] for part in self))

    @classmethod
    def joined(cls, parts: Sequence[Learned]) -> Learned:
        """What was known at the rows of several, one after the other; not empty."""
        return cls(*(np.concatenate(each) for each in zip(*parts, strict=True)))


@dataclass(frozen=True)
class OnlineLayer:
    """The layer as it was trained.

    Attributes:
        card: names and time constants.
        mean: prior mean of the weights ``(3, n)``.
        covariance: prior covariance of the weights, ``(3, n, n)``.
        noise: variance of one-step errors on the training laps, ``(3,)``, in units of s_delta squared.
        physics: mean square of the physics' one-step errors there, ``(3,)``, in the same units.
        block_noise: variance of the physics' mean errors over blocks of rows, ``(3,)``, in the same units.
        block_slow: the part of it that a block shares with the one before.
        scale: s_delta (m/s, m/s, rad/s), ``(3,)``.
        vehicle: the calibrated car. Below its minimum speed the layer neither learns nor corrects.
        integrator: of the physics.
        substeps: integration steps per sampling time.
        least: ``v_x`` (m/s) below which it does neither: standing or backwards, unless it was trained on that.
    """

    card: OnlineLayerCard
    mean: Vector
    covariance: Vector
    noise: Vector
    physics: Vector
    block_noise: Vector
    block_slow: Vector
    scale: Vector
    vehicle: Vehicle
    integrator: Integrator = "euler"
    substeps: int = 1
    least: float = -math.inf

    def acts(self, v_x: Vector) -> Mask:
        """Whether it learns and corrects at speeds ``v_x`` (m/s); not where that is not known."""
        if self.least >= 0.0:
            return v_x >= self._slowest
        return (np.abs(v_x) >= self.minimum_speed) & (v_x >= self.least)

    @property
    def T_s(self) -> float:
        """Length of a step (s)."""
        return self.vehicle.sampling_time

    @property
    def minimum_speed(self) -> float:
        """Below it the layer neither learns nor corrects (m/s)."""
        return self.vehicle.minimum_speed

    @cached_property
    def _slowest(self) -> float:
        """Forwards, from which on it learns and corrects (m/s)."""
        return max(self.minimum_speed, self.least)

    def estimator(self) -> CoefficientEstimator:
        """What follows the coefficients, as it begins."""
        errors = BlockErrors(self.block_noise, self.block_slow)
        return CoefficientEstimator(
            self.vehicle, self.scale, errors, self.integrator, self.substeps, spread=self.card.spread
        )

    def start(self) -> OnlineState:
        """The state at the beginning of a drive: the prior."""
        return OnlineState(self)

    def increments(self, features: Vector, weights: Vector) -> Vector:
        """Increments ``(N, 3)`` (m/s, m/s, rad/s) of features ``(N, 3, n)`` with weights ``(N, 3, n)``."""
        predicted: Vector = (features[..., None, :] @ weights[..., None])[..., 0, 0] * self.scale
        return predicted

    def bounded(self, increments: Vector, physics: Vector, limit: Vector) -> Vector:
        """Increments within ``limit`` (units of s_delta) of the physics' ones, so that rollouts stay bounded as those do."""
        return physics + np.clip(increments - physics, -limit * self.scale, limit * self.scale)

    def mean_error(self, features: Vector) -> Vector:
        """The physics' mean error ``(N, 3)`` (m/s, m/s, rad/s) over the window that features ``(N, 3, n)`` are from."""
        error: Vector = features[:, :, self.card.features.index(MEAN_ERROR)] * self.scale
        return error

    def in_rollout(self, seen: Seen, learned: Learned, mean_error: Vector, step: int) -> Vector:
        """Increments ``(N, 3)`` from rows of a rollout, after its first step.

        Where the layer's paths are believed they are the layer's, within its limit; else the physics' less its mean error.
        Paths are judged over ``PATH_HORIZON_S``; beyond it the correction fades, and after twice as long the physics
        is alone.

        Args:
            seen: of the rows.
            learned: at the start of the rollout.
            mean_error: of the physics at the start (m/s, m/s, rad/s), ``(N, 3)``.
            step: steps taken so far.
        """
        own = self.bounded(self.increments(seen.features, learned.weights), seen.physics, learned.limit)
        correction = np.where(learned.trusted[:, None] > 0, own - seen.physics, mean_error)
        kept = min(max(2.0 - step * self.T_s / PATH_HORIZON_S, 0.0), 1.0)
        moved: Vector = seen.physics + kept * correction
        return moved


class OnlineState:
    """Weights, their covariance and the noise, as estimated so far."""

    def __init__(self, layer: OnlineLayer) -> None:
        self.layer = layer
        self.coefficients = layer.estimator()
        self.retained = math.exp(-layer.T_s / layer.card.memory)
        self._forget, self._recently = (min(1.0, layer.T_s / memory) for memory in (_NOISE_MEMORY_S, _RECENT_S))
        self._returning = (1 - self.retained) * layer.mean
        self._widening = (1 - self.retained**2) * layer.covariance
        self.reset()

    def reset(self) -> None:
        """Returns to the prior."""
        layer = self.layer
        self.mean = layer.mean.copy()
        self.covariance = layer.covariance.copy()
        self.noise = layer.noise.copy()
        self.physics = layer.physics.copy()
        self.recent = np.ones(CHANNELS)
        self.width = np.ones(CHANNELS)
        self.coefficients.reset()
        self.steps = 0
        self._compiled: compiled.LayerStructure | None = None

    def interrupt(self) -> None:
        """The next step does not follow on the last one."""
        self.coefficients.interrupt()

    def learned(self, features: Vector, trusted: bool = True) -> Learned:
        """What is known now, for a prediction from one window with features ``(3, n)``."""
        if compiled.LIBRARY is not None:
            size, features = self.mean.size, np.ascontiguousarray(features)
            known = np.empty((1, size + 2 * CHANNELS))
            compiled.LIBRARY.dynssm_known(self.structure().address, address(features), address(known))
            weights = known[:, :size].reshape(1, *self.mean.shape)
            variance, limit = known[:, size:-CHANNELS], known[:, -CHANNELS:]
        else:
            weights, variance, limit = self.mean[None].copy(), self.variance(features)[None], self.limit[None]
        return Learned(weights, variance, limit, self.coefficients.theta[None], np.array([float(trusted)]))

    @property
    def limit(self) -> Vector:
        """See :attr:`Learned.limit`."""
        limit: Vector = _ROLLOUT_LIMIT * np.sqrt(self.physics)
        return limit

    def variance(self, features: Vector) -> Vector:
        """Variance of the prediction's error ``(3,)``, in units of s_delta squared.

        That of weights and noise, times the square of the latest errors in its units, times what makes 90 % of them fit in.
        """
        spread = (self.covariance @ features[:, :, None])[:, :, 0]
        stated: Vector = self.width**2 * self.recent * (self.noise + (spread * features).sum(axis=1))
        return stated

    def update(self, seen: Seen, row: Vector, increment: Vector) -> None:
        """Learns from a step; one that is not finite teaches nothing.

        Args:
            seen: before it, features ``(3, n)`` and physics ``(3,)``.
            row: measured, before it, ``(7,)``.
            increment: measured (m/s, m/s, rad/s), ``(3,)``.
        """
        scale, (features, physics) = self.layer.scale, seen
        if compiled.LIBRARY is not None:
            arrays = map(address, map(np.ascontiguousarray, (features, physics, increment)))
            if compiled.LIBRARY.dynssm_update(self.structure().address, *arrays):
                self.taught(row, increment)
            return
        target = increment / scale
        if not math.isfinite(float(target.sum() + features.sum())):
            return
        P = self.covariance
        spread = (P @ features[:, :, None])[:, :, 0]
        error = target - (self.mean * features).sum(axis=1)
        predicted = (spread * features).sum(axis=1)
        size = np.abs(error) / np.sqrt(self.noise + predicted)
        inflation = np.maximum(1.0, size / _OUTLIER)
        gain = spread / (predicted + self.noise * inflation)[:, None]
        self.mean[...] = self.retained * (self.mean + gain * error[:, None]) + self._returning
        P[...] = self.retained**2 * (P - gain[:, :, None] * spread[:, None, :]) + self._widening
        # stochastic approximation of the 90 % quantile (adaptive conformal inference, Gibbs and Candes 2021)
        missed = size > _QUANTILE * self.width * np.sqrt(self.recent)
        self.width[...] = np.clip(self.width * np.exp(_WIDTH_RATE * (missed - (1.0 - _COVERED))), 1 / _WIDEST, _WIDEST)
        surprise = np.minimum(size * size, _LARGEST**2 * self.recent)
        self.recent[...] = np.maximum(self.recent + self._recently * (surprise - self.recent), _SMALLEST**2)
        square = np.minimum(error * error * self.noise / (self.noise + predicted), _LARGEST**2 * self.noise)
        self.noise[...] = np.maximum(self.noise + self._forget * (square - self.noise), _SMALLEST**2)
        of_physics = ((increment - physics) / scale) ** 2
        self.physics += self._forget * (of_physics - self.physics)
        self.taught(row, increment)

    def taught(self, row: Vector, increment: Vector) -> None:
        """The layer has learned the ``increment`` ``(3,)`` from a measured ``row`` ``(7,)``."""
        self.coefficients.step(row, increment)
        self.steps += 1

    def along(self, seen: Seen, increments: Vector, follows: Mask) -> tuple[Vector, Vector, Vector, Mask]:
        """Learns along rows by the compiled loop, each from the one before it where it ``follows``; not the coefficients.

        Returns:
            Weights, variance and limit as in :class:`Learned` at each row, and whether the row taught something.
        """
        count, n = len(follows), self.mean.shape[1]
        weights, taught = np.empty((count, CHANNELS, n)), np.zeros(count, dtype=np.uint8)
        stated, limits = np.empty((2, count, CHANNELS))
        inputs = [np.ascontiguousarray(each) for each in (seen.features, seen.physics, increments)]
        assert compiled.LIBRARY is not None
        others: list[npt.NDArray[Any]] = [follows.astype(np.uint8), taught, weights, stated, limits]
        compiled.LIBRARY.dynssm_along(self.structure().address, *map(address, inputs), count, *map(address, others))
        self.steps += int(taught.sum())
        return weights, stated, limits, taught.astype(np.bool_)

    def structure(self) -> compiled.LayerStructure:
        """Where the compiled loop finds what it learns; it works in these arrays."""
        if self._compiled is None:
            self._compiled = compiled.LayerStructure()
            self._compiled.fill(
                n=self.mean.shape[1], **{name: getattr(self, name) for name in _SAVED}, spread=np.zeros_like(self.mean[0]),
                returning=self._returning, widening=self._widening, scale=self.layer.scale, retained=self.retained,
                forget=self._forget, recently=self._recently, outlier=_OUTLIER, quantile=_QUANTILE,
                missed_grows=math.exp(_WIDTH_RATE * _COVERED), hit_shrinks=math.exp(_WIDTH_RATE * (_COVERED - 1.0)),
                widest=_WIDEST, largest=_LARGEST**2, smallest_recent=_SMALLEST**2, smallest_noise=_SMALLEST**2,
                limit=_ROLLOUT_LIMIT,
            )  # fmt: skip
        return self._compiled

    def writer(self, path: Path, owner: str) -> Callable[[], None]:
        """Writes what is known now to ``path``, atomically, once it is called; another thread may do so.

        ``owner`` names the prior that it belongs to.
        """
        arrays = {name: getattr(self, name) for name in _SAVED}
        arrays |= {f"coefficients.{name}": value for name, value in self.coefficients.kept().items()}
        content = as_tensors(arrays, {"prior": owner, "steps": str(self.steps)})

        def write() -> None:
            with replacing(path) as aside:
                aside.write_bytes(content)

        return write

    def load(self, path: Path, owner: str) -> None:
        """Goes on from what a :meth:`writer` wrote.

        Raises:
            ArtifactError: unreadable, not finite, or learned by another model.
        """
        coefficients = self.coefficients.kept()
        expected = {name: getattr(self, name) for name in _SAVED}
        expected |= {f"coefficients.{name}": value for name, value in coefficients.items()}
        shapes = {name: value.shape for name, value in expected.items()}
        arrays, about = _parsed(_state_in(path), path, "online state", shapes, owner)
        for name in _SAVED:
            getattr(self, name)[...] = arrays[name]
        self.coefficients.restore({name: arrays[f"coefficients.{name}"] for name in coefficients})
        self.steps = int(about.get("steps", "0"))


_FROM_PRIOR = ("mean", "covariance", "noise", "physics")
_SAVED = (*_FROM_PRIOR, "recent", "width")
_PRIOR = (*_FROM_PRIOR, "block_noise", "block_slow")
_VARIANCES = ("noise", "recent", "width", "block_noise", "block_slow")
_ABSURD = 1e6  # no number of a layer is larger: it is in units that make one the usual size
_LARGEST_STATE = 10 << 20  # bytes
_ROUNDING = 1e-9  # of eigenvalues


def _state_in(path: Path) -> bytes:
    """The content of a file of what was learned; without waiting where it is none."""
    try:
        if not os.path.isfile(path) or path.stat().st_size > _LARGEST_STATE:
            raise ArtifactError(
                f"{path}: not a readable online state (expected a file of at most {_LARGEST_STATE} bytes)"
            )
        return path.read_bytes()
    except OSError as error:
        raise ArtifactError(f"{path}: not a readable online state ({error})") from error


def save_layer(layer: OnlineLayer, path: Path) -> None:
    """Writes the numbers of a layer; names and time constants are in the card."""
    path.write_bytes(as_tensors({name: getattr(layer, name) for name in _PRIOR}))


def load_layer(
    data: bytes,
    path: Path,
    card: OnlineLayerCard,
    *,
    scale: Vector,
    vehicle: Vehicle,
    integrator: Integrator,
    substeps: int,
    least: float = -math.inf,
) -> OnlineLayer:
    """The layer in ``data``, which :func:`save_layer` wrote to ``path``.

    Raises:
        ArtifactError: unreadable, of other sizes than the card says, or a variance that is not positive.
    """
    n = len(card.features)
    shapes = dict.fromkeys(_PRIOR, (CHANNELS,)) | {"mean": (CHANNELS, n), "covariance": (CHANNELS, n, n)}
    prior, _ = _parsed(data, path, "online layer", shapes)
    return OnlineLayer(
        card, **prior, scale=scale, vehicle=vehicle, integrator=integrator, substeps=substeps, least=least
    )


def _parsed(
    data: bytes, path: Path, what: str, shapes: Mapping[str, tuple[int, ...]], owner: str | None = None
) -> tuple[dict[str, Vector], dict[str, str]]:
    """Finite arrays of the expected shapes from a safetensors file of an ``owner``, and what it says of itself."""
    arrays, about = read_tensors(data, f"{path}: not a readable {what}")
    if owner is not None and about.get("prior") != owner:
        raise ArtifactError(f"{path}: was learned by another model; expected the {what} of prior {owner[:12]}")
    if "recent" in shapes:
        arrays.setdefault("recent", np.ones(CHANNELS))  # states of 0.3.0 have none
    for name, shape in shapes.items():
        value = arrays.get(name)
        if value is None or value.shape != shape or not np.isfinite(value).all():
            raise ArtifactError(f"{path}: {name} is missing, not finite or of another shape; expected {shape}")
        if (largest := float(np.abs(value).max(initial=0.0))) > _ABSURD:
            raise ArtifactError(f"{path}: {name} is as large as {largest:.3g}; expected at most {_ABSURD:g}")
        if name in _VARIANCES and value.min() <= 0:
            raise ArtifactError(f"{path}: {name} = {value.min():.3g}; expected variances above zero")
    eigenvalues = np.linalg.eigvalsh(arrays["covariance"])
    if (eigenvalues[:, 0] < -_ROUNDING * eigenvalues[:, -1]).any() or eigenvalues.max() <= 0:
        raise ArtifactError(f"{path}: covariance has the eigenvalue {eigenvalues.min():.3g}; expected none below zero")
    return {name: arrays[name] for name in shapes}, about


def expert_weights(layer: OnlineLayer, weights: Vector) -> dict[str, float]:
    """Weights ``(3, n)`` of what the physics and the network predict of a channel itself, by words."""
    names = layer.card.features
    return {
        f"{expert}, {channel}": float(weights[c, names.index(expert)])
        for expert in ("physics", "network")
        if expert in names
        for c, channel in enumerate(STATE_SIGNALS)
    }
