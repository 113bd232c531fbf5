"""How far off a right model may be: noise at the start, noise at each predicted row, disturbances on the way.

An error after ``k`` steps is what the error of the start has become by then, minus the noise of the predicted row, plus
the disturbances in between. With variances ``P`` of the start, ``R`` of the measurement and ``Q`` of a disturbance per
step, the ``3 K`` errors of a window have the covariance ``G diag(P, Q, ..., Q) G' + I R``, where ``G`` follows from the
derivatives of the steps. Errors that are divided by its root are independent of unit variance, so that sums of squares
are likelihoods. Windows of like speed share their ``G``.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import lapack

from dynssm_ros.arrays import Indices, Vector
from dynssm_ros.identification import tuning

_ROUNDING = 1e-10  # of each variance, that keeps covariances positive


@dataclass(frozen=True)
class NoiseResponse:
    """Where noise goes: groups of windows and their response matrices.

    Attributes:
        group: number of each window's group, shape ``(W,)``.
        G: response of the ``3 K`` errors to the noise of the start and of each step, shape ``(M, 3 K, 3 + 3 K)``.
    """

    group: Indices
    G: Vector

    @cached_property
    def members(self) -> list[Indices]:
        """The windows of each group."""
        return [np.flatnonzero(self.group == m) for m in range(len(self.G))]

    @classmethod
    def of(cls, transitions: Vector, speed: Vector) -> NoiseResponse:
        """Groups windows by speed (m/s), shape ``(W,)``, and follows noise along ``transitions`` ``(W, K, 3, 3)``."""
        count = int(np.clip(len(speed) // tuning.GROUP_WINDOWS, 1, tuning.SPEED_GROUPS))
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
    """Variances of measurement, disturbance and start, ``v = (R, Q, P)``, shape ``(9,)``, and what they make of errors."""

    spread: NoiseResponse
    v: Vector

    @cached_property
    def roots(self) -> Vector:
        """Cholesky factors of the covariances, shape ``(M, 3 K, 3 K)``."""
        return np.asarray(np.linalg.cholesky(_covariance(self.spread.G, self.v)), dtype=np.float64)

    @cached_property
    def _inverse_roots(self) -> Vector:
        return np.asarray(np.linalg.inv(self.roots), dtype=np.float64)

    @cached_property
    def log_dets(self) -> Vector:
        """Logarithm of the covariance's determinant of each window, ``(W,)``."""
        per_group = 2 * np.log(np.diagonal(self.roots, axis1=1, axis2=2)).sum(axis=1)
        return np.asarray(per_group[self.spread.group])

    def whiten(self, errors: Vector) -> Vector:
        """Errors or their derivatives ``(W, 3 K, ...)`` as independent ones of unit variance."""
        flat = errors.reshape(len(errors), errors.shape[1], -1)
        out = np.empty_like(flat)
        for inverse, member in zip(self._inverse_roots, self.spread.members, strict=True):
            if flat.shape[2] == 1:  # a product for all windows is quicker than one for each
                out[member, :, 0] = flat[member, :, 0] @ inverse.T
            else:
                out[member] = inverse @ flat[member]
        return out.reshape(errors.shape)

    def robust(self, errors: Vector, white_jacobian: Vector) -> tuple[Vector, Vector, Vector]:
        """Whitened errors and derivatives with outliers weighed down, and the roots of the weights, ``(W, 1)``."""
        white = self.whiten(errors)
        root = np.sqrt(weights(white))[:, None]
        return white * root, white_jacobian * root[..., None], root


def weights(white: Vector) -> Vector:
    """Weight of each window, 1 unless its whitened errors ``(W, 3 K)`` are far out."""
    size = (white**2).sum(axis=1)
    return np.asarray(np.minimum(1.0, tuning.OUTLIER_FACTOR * white.shape[1] / np.maximum(size, 1e-300)))


def fit_noise(spread: NoiseResponse, errors: Vector, start: Vector, floor: Vector) -> Noise:
    """The variances that make ``errors`` ``(W, 3 K)`` most likely.

    Args:
        spread: how noise spreads.
        errors: of a model, m/s and rad/s.
        start: variances to begin with, shape ``(9,)``. Where one is far too small the others may settle as if there were
            none of it: let them be too large.
        floor: the least that they may be, shape ``(9,)``.
    """
    noise = Noise(spread, np.maximum(start, floor))
    for _ in range(tuning.MAX_TRIES):
        weight = weights(noise.whiten(errors))
        before, noise = noise, Noise(spread, _most_likely(spread, errors * np.sqrt(weight)[:, None], noise.v, floor))
        if abs(noise.log_dets.sum() - before.log_dets.sum()) < tuning.NOISE_CONVERGED:
            break
    return noise


def _most_likely(spread: NoiseResponse, errors: Vector, start: Vector, floor: Vector) -> Vector:
    """Fisher scoring in the logarithms of the variances, within their bounds.

    With ``C = W diag(v_k of each column) W'``, ``W = (I, G)``, the traces of Fisher's information are sums of squares of
    ``W' C^-1 W``, so that no covariance of a single variance is formed.
    """
    G = spread.G
    count = np.array([len(member) for member in spread.members], dtype=float)
    moment = np.stack([errors[member].T @ errors[member] for member in spread.members])
    # which variance each column of W has, as an indicator (columns, 9)
    steps = G.shape[1] // 3
    of_column = np.eye(9)[[*(0, 1, 2) * steps, 6, 7, 8, *(3, 4, 5) * steps]]
    low = np.log(floor)
    high = low + tuning.NOISE_RANGE

    def likelihood(log_v: Vector) -> tuple[float, Vector]:
        """Twice the negative logarithm of the likelihood, and the covariances' inverses."""
        C = _covariance(G, np.exp(log_v))
        root = np.linalg.cholesky(C)
        inverse = np.stack([lapack.dpotri(each.T)[0] for each in root])  # its upper half
        inverse += np.swapaxes(np.triu(inverse, 1), 1, 2)
        log_det = 2 * np.log(np.diagonal(root, axis1=1, axis2=2)).sum(axis=1)
        return float(count @ log_det + np.einsum("mij,mij->", inverse, moment)), inverse

    log_v = np.clip(np.log(start), low, high)
    value, inverse = likelihood(log_v)
    for _ in range(tuning.MAX_ROUNDS):
        across = inverse @ G
        weighed = np.concatenate([inverse, across], axis=2)  # C^-1 W
        lower_part = np.concatenate([np.swapaxes(across, 1, 2), np.swapaxes(G, 1, 2) @ across], axis=2)
        inner = np.concatenate([weighed, lower_part], axis=1)  # W' C^-1 W
        explained = np.einsum("mic,mic->c", weighed, moment @ weighed)
        slope = of_column.T @ (count @ np.diagonal(inner, axis1=1, axis2=2) - explained)
        curvature = of_column.T @ np.einsum("m,mij,mij->ij", count, inner, inner) @ of_column
        v = np.exp(log_v)
        slope, curvature = v * slope, np.outer(v, v) * curvature
        free = ~((log_v <= low) & (slope > 0) | (log_v >= high) & (slope < 0))
        step = np.zeros(9)
        flat = 1e-3 * np.eye(free.sum())  # where a variance that vanishes has no curvature
        step[free] = -np.linalg.solve(curvature[np.ix_(free, free)] + flat, slope[free])
        step = np.clip(step, -tuning.NOISE_STRIDE, tuning.NOISE_STRIDE)
        if -slope @ step < tuning.NOISE_CONVERGED:
            break
        for _ in range(tuning.MAX_TRIES):
            there = np.clip(log_v + step, low, high)
            new, inverse_there = likelihood(there)
            if new < value:
                break
            step = step / 2
        else:
            break
        log_v, value, inverse = there, new, inverse_there
    return np.asarray(np.exp(log_v))


def _covariance(G: Vector, v: Vector) -> Vector:
    size = G.shape[1]
    R, Q, P = v.reshape(3, 3)
    inside = np.concatenate([P, np.tile(Q, size // 3)])
    C = (G * inside) @ np.swapaxes(G, 1, 2) + np.diag(np.tile(R, size // 3))
    return np.asarray(C * (1.0 + _ROUNDING * np.eye(size)))
