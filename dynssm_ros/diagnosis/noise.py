"""How far off a right model may be: noise at the start, noise at each predicted row, disturbances on the way.

An error after ``k`` steps is what the noise of the starting row has become by then, minus the noise of the predicted
row, plus the disturbances in between. With variances ``R`` of the measurement and ``Q`` of a disturbance per step, the
``3 K`` errors of a window have the covariance ``G diag(R, Q, ..., Q) G' + I R``, where ``G`` follows from the
derivatives of the steps. Errors that are divided by its root are independent of unit variance, so that sums of squares
are likelihoods. Windows of like speed share their ``G``.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
from scipy.optimize import minimize

Vector = npt.NDArray[np.float64]
Indices = npt.NDArray[np.intp]

_GROUPS = 10
_RANGE = 30.0  # of the logarithm of a variance above its floor
_ROUNDING = 1e-10  # of each variance, that keeps covariances positive
_FAR = 4.0  # a window whose squared error exceeds the expected one by this factor counts only as much as that


@dataclass(frozen=True)
class Spread:
    """Where noise goes: groups of windows and their response matrices.

    Attributes:
        group: number of each window's group, shape ``(W,)``.
        G: response of the ``3 K`` errors to the noise of the start and of each step, shape ``(M, 3 K, 3 + 3 K)``.
    """

    group: Indices
    G: Vector

    @classmethod
    def of(cls, transitions: Vector, speed: Vector) -> Spread:
        """Groups windows by speed (m/s), shape ``(W,)``, and follows noise along ``transitions`` ``(W, K, 3, 3)``."""
        count = int(np.clip(len(speed) // 6, 1, _GROUPS))
        edges = np.quantile(speed, np.linspace(0, 1, count + 1)[1:-1])
        group = np.searchsorted(edges, speed)
        steps = transitions.shape[1]
        G = np.zeros((count, steps, 3, 3 + 3 * steps))
        for m in range(count):
            member = group == m
            mean = transitions[member].mean(axis=0) if member.any() else np.broadcast_to(np.eye(3), (steps, 3, 3))
            state = np.zeros((3, 3 + 3 * steps))
            state[:, :3] = np.eye(3)
            for k in range(steps):
                state = mean[k] @ state
                state[:, 3 + 3 * k : 6 + 3 * k] += np.eye(3)
                G[m, k] = state
        return cls(group, G.reshape(count, 3 * steps, -1))


@dataclass(frozen=True)
class Noise:
    """Variances of measurement and disturbance, ``v = (R, Q)``, shape ``(6,)``, and what they make of errors."""

    spread: Spread
    v: Vector

    @cached_property
    def roots(self) -> Vector:
        """Cholesky factors of the covariances, shape ``(M, 3 K, 3 K)``."""
        return np.asarray(np.linalg.cholesky(_covariance(self.spread.G, self.v)), dtype=np.float64)

    @cached_property
    def _inverse_roots(self) -> Vector:
        return np.asarray(np.linalg.inv(self.roots), dtype=np.float64)

    @cached_property
    def log_det(self) -> float:
        """Sum over the windows of the logarithm of the covariance's determinant."""
        per_group = 2 * np.log(np.diagonal(self.roots, axis1=1, axis2=2)).sum(axis=1)
        return float(per_group[self.spread.group].sum())

    def whiten(self, errors: Vector) -> Vector:
        """Errors or their derivatives ``(W, 3 K, ...)`` as independent ones of unit variance."""
        flat = errors.reshape(*errors.shape[:2], -1)
        out = np.empty_like(flat)
        for m, inverse in enumerate(self._inverse_roots):
            member = np.flatnonzero(self.spread.group == m)
            out[member] = np.matmul(inverse, flat[member])
        return out.reshape(errors.shape)


def weights(white: Vector) -> Vector:
    """Weight of each window, 1 unless its whitened errors ``(W, 3 K)`` are far out."""
    size = (white**2).sum(axis=1)
    return np.asarray(np.minimum(1.0, _FAR * white.shape[1] / np.maximum(size, 1e-300)))


def fit_noise(spread: Spread, errors: Vector, start: Vector, floor: Vector) -> Noise:
    """The variances that make ``errors`` ``(W, 3 K)`` most likely.

    Args:
        spread: how noise spreads.
        errors: of a model, m/s and rad/s.
        start: variances to begin with, shape ``(6,)``.
        floor: the least that they may be, shape ``(6,)``.
    """
    noise = Noise(spread, np.maximum(start, floor))
    for _ in range(2):
        weight = weights(noise.whiten(errors))
        noise = Noise(spread, _most_likely(spread, errors * np.sqrt(weight)[:, None], noise.v, floor))
    return noise


def _most_likely(spread: Spread, errors: Vector, start: Vector, floor: Vector) -> Vector:
    count = np.bincount(spread.group, minlength=len(spread.G)).astype(float)
    moment = np.stack([errors[spread.group == m].T @ errors[spread.group == m] for m in range(len(spread.G))])
    size = spread.G.shape[1]
    bases = [_covariance(spread.G, np.eye(6)[i]) for i in range(6)]
    total = count.sum() * size

    def cost(log_v: Vector) -> tuple[float, Vector]:
        v = np.exp(log_v)
        C = sum(value * basis for value, basis in zip(v, bases, strict=True))
        root = np.linalg.cholesky(C)
        inverse = np.linalg.inv(C)
        fitted = inverse @ moment
        value = (
            2 * (count * np.log(np.diagonal(root, axis1=1, axis2=2)).sum(axis=1)).sum()
            + np.trace(fitted, axis1=1, axis2=2).sum()
        )
        slope_of = count[:, None, None] * inverse - fitted @ inverse
        slope = np.array([(slope_of * basis).sum() for basis in bases]) * v
        return value / total, slope / total

    bounds = [(np.log(low), np.log(low) + _RANGE) for low in floor]
    # a likelihood per error is flat, its sum is not: hence the tolerances
    found = minimize(
        cost,
        np.log(start),
        jac=True,
        method="L-BFGS-B",
        bounds=bounds,
        options={"maxiter": 300, "ftol": 1e-13, "gtol": 1e-8},
    )
    return np.asarray(np.exp(found.x))


def _covariance(G: Vector, v: Vector) -> Vector:
    size = G.shape[1]
    inside = np.concatenate([v[:3], np.tile(v[3:], size // 3)])
    C = (G * inside) @ np.swapaxes(G, 1, 2) + np.diag(np.tile(v[:3], size // 3))
    return np.asarray(C * (1.0 + _ROUNDING * np.eye(size)))
