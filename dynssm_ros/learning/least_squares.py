"""Bounded robust least squares on the unit cube by scipy, and how much each residual has to say at the solution."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, NamedTuple

import numpy as np
from scipy import optimize

from dynssm_ros.arrays import Vector

Residuals = Callable[[Vector], Vector]
Loss = Literal["linear", "soft_l1", "huber", "cauchy"]

_INSIDE = 1e-6  # scipy starts off the bounds
_DIFFERENCE = 1e-7  # step of the forward differences


class Fit(NamedTuple):
    """The outcome of a fit of ``n`` parameters."""

    p: Vector
    """Parameters in [0, 1], shape ``(n,)``."""
    cost: float
    """Half the sum of ``rho(f^2)``."""


class Influence(NamedTuple):
    """What ``M`` residuals ``f`` say at a point; ``psi = rho'(f^2) f`` is half the derivative of ``rho(f^2)``.

    scipy hands back a Jacobian scaled by the loss; standard errors need the plain one with the loss's slopes.
    """

    jacobian: Vector
    """Derivatives of the residuals, shape ``(n, M)``."""
    psi: Vector
    """Influence of each residual on the estimate, shape ``(M,)``."""
    slope: Vector
    """Derivative of ``psi`` by the residual, at least 0, shape ``(M,)``."""


def least_squares(residuals: Residuals, start: Vector, loss: Loss, tolerance: float, iterations: int) -> Fit:
    """Minimises half the sum of ``rho(f^2)`` over [0, 1]^n.

    Args:
        residuals: ``(n,)`` to ``(M,)``, finite.
        start: where to start, shape ``(n,)``.
        loss: ``rho`` by the names and definitions of scipy's ``least_squares``.
        tolerance: relative change of cost, parameters or gradient below which it ends.
        iterations: steps at most.
    """
    found = optimize.least_squares(
        residuals,
        np.clip(start, _INSIDE, 1.0 - _INSIDE),
        bounds=(0.0, 1.0),
        loss=loss,
        x_scale="jac",
        ftol=tolerance,
        xtol=tolerance,
        gtol=tolerance,
        max_nfev=iterations,
    )
    return Fit(found.x, float(found.cost))


def influence(residuals: Residuals, p: Vector, loss: Loss) -> Influence:
    """Jacobian, influence and its slope at ``p``, by forward differences that stay inside the bounds."""
    f = residuals(p)
    jacobian = np.empty((len(p), len(f)))
    for k in range(len(p)):
        moved = p.copy()
        moved[k] += _DIFFERENCE if p[k] < 0.5 else -_DIFFERENCE
        jacobian[k] = (residuals(moved) - f) / (moved[k] - p[k])
    return Influence(jacobian, *_psi_and_slope(loss, f))


def _psi_and_slope(loss: Loss, f: Vector) -> tuple[Vector, Vector]:
    z = f * f
    if loss == "soft_l1":
        root = np.sqrt(1.0 + z)
        return f / root, root**-3
    if loss == "huber":
        return np.clip(f, -1.0, 1.0), (z <= 1.0).astype(np.float64)
    if loss == "cauchy":
        return f / (1.0 + z), np.maximum(1.0 - z, 0.0) / (1.0 + z) ** 2
    return f, np.ones_like(f)
