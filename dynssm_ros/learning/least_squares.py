"""Bounded nonlinear least squares on the unit cube, for tall problems with few parameters.

Levenberg-Marquardt steps by the normal equations, among the parameters that are free to move. (scipy's bounded method
decomposes the whole Jacobian at each step and creeps where parameters lie on their bounds.)
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt

Vector = npt.NDArray[np.float64]
Residuals = Callable[[Vector], Vector]
Loss = Literal["linear", "soft_l1", "huber", "cauchy"]

_DIFFERENCE = 1e-7  # step of the forward differences
_DAMPING = (1e-12, 1e-3, 1e16)  # least, first, and that of a step so short that there is no descent


class Fit(NamedTuple):
    """The outcome of a fit of ``n`` parameters to ``M`` residuals ``f``; ``psi = rho'(f^2) f`` is the loss's slope."""

    p: Vector
    """Parameters in [0, 1], shape ``(n,)``."""
    cost: float
    """Half the sum of ``rho(f^2)``."""
    jacobian: Vector
    """Derivatives of the residuals, shape ``(n, M)``."""
    psi: Vector
    """Influence of each residual on the estimate, shape ``(M,)``."""
    slope: Vector
    """Derivative of ``psi`` by the residual, at least 0, shape ``(M,)``."""


class _Losses(NamedTuple):
    """``rho``, its first derivative, and the slope of ``psi`` at squared residuals."""

    rho: Vector
    weight: Vector
    slope: Vector


def least_squares(residuals: Residuals, start: Vector, loss: Loss, tolerance: float, iterations: int) -> Fit:
    """Minimises half the sum of ``rho(f^2)`` over [0, 1]^n.

    Args:
        residuals: ``(n,)`` to ``(M,)``, finite.
        start: where to start, shape ``(n,)``.
        loss: ``rho`` by the names and definitions of scipy's ``least_squares``.
        tolerance: relative fall of the cost below which it ends.
        iterations: steps at most.
    """
    p, damping = np.clip(start, 0.0, 1.0), _DAMPING[1]
    f = residuals(p)
    losses = _losses(loss, f)
    for _ in range(iterations):
        jacobian = _jacobian(residuals, p, f)
        normal, gradient = (jacobian * losses.weight) @ jacobian.T, jacobian @ (losses.weight * f)
        before = losses.rho.sum()
        while damping < _DAMPING[2]:
            trial = np.clip(p + _step(normal, gradient, p, damping), 0.0, 1.0)
            f_trial = residuals(trial)
            trial_losses = _losses(loss, f_trial)
            if trial_losses.rho.sum() < before:
                break
            damping *= 4.0
        else:
            break
        p, f, losses = trial, f_trial, trial_losses
        damping = max(damping / 5.0, _DAMPING[0])
        if losses.rho.sum() > (1.0 - tolerance) * before:
            break
    return Fit(p, float(losses.rho.sum()) / 2, _jacobian(residuals, p, f), losses.weight * f, losses.slope)


def _step(normal: Vector, gradient: Vector, p: Vector, damping: float) -> Vector:
    """The damped Gauss-Newton step; parameters that it would push over a bound stay where they are."""
    scale = np.diag(normal)
    damped = normal + damping * np.diag(scale + 1e-12 * scale.max() + 1e-300)
    free = np.ones(len(p), dtype=bool)
    step = np.zeros(len(p))
    while free.any():
        step[~free] = 0.0
        step[free] = np.linalg.solve(damped[np.ix_(free, free)], -gradient[free])
        blocked = free & (((p <= 0.0) & (step < 0.0)) | ((p >= 1.0) & (step > 0.0)))
        if not blocked.any():
            return step
        free &= ~blocked
    return np.zeros(len(p))


def _jacobian(residuals: Residuals, p: Vector, f: Vector) -> Vector:
    """Forward differences that stay inside the bounds, ``(n, M)``."""
    jacobian = np.empty((len(p), len(f)))
    for k in range(len(p)):
        moved = p.copy()
        moved[k] += _DIFFERENCE if p[k] < 0.5 else -_DIFFERENCE
        jacobian[k] = (residuals(moved) - f) / (moved[k] - p[k])
    return jacobian


def _losses(loss: Loss, f: Vector) -> _Losses:
    z = f * f
    if loss == "soft_l1":
        root = np.sqrt(1.0 + z)
        return _Losses(2.0 * z / (1.0 + root), 1.0 / root, root**-3)
    if loss == "huber":
        inside = z <= 1.0
        size = np.sqrt(np.maximum(z, 1.0))
        return _Losses(np.where(inside, z, 2.0 * size - 1.0), 1.0 / size, inside.astype(np.float64))
    if loss == "cauchy":
        return _Losses(np.log1p(z), 1.0 / (1.0 + z), np.maximum(1.0 - z, 0.0) / (1.0 + z) ** 2)
    return _Losses(z, np.ones_like(z), np.ones_like(z))
