"""Fitting a car to windows of a recording: nominal values under what is known of them, effects within their bounds."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from dynssm_ros.diagnosis.car import Car
from dynssm_ros.diagnosis.noise import Noise, Spread, fit_noise, weights
from dynssm_ros.diagnosis.windows import Windows
from dynssm_ros.vehicle.effects import EFFECTS

Vector = npt.NDArray[np.float64]
Free = tuple[tuple[str, str], ...]
"""Effect and parameter of each value that is fitted beside the nominal ones."""

BLOCK = 3.0  # s; errors farther apart count as independent
_UNIT = 0.1  # of the way from neutral to the upper bound: in this unit effects are fitted
_FREE = 10.0  # of these units an effect's parameter may be, as one standard deviation
_ROUNDS = 10
_DAMPING = (0.0, 0.03, 0.3, 3.0, 30.0)
_CONVERGED = 0.3  # of the squared error


def unit(effect: str, parameter: str) -> float:
    """The unit in which a parameter is fitted."""
    about = EFFECTS[effect].PARAMETERS[parameter]
    return _UNIT * max(about.upper - about.neutral, about.neutral - about.lower)


@dataclass(frozen=True)
class Fit:
    """A car fitted to windows.

    Attributes:
        car: as fitted.
        free: the effects' parameters that were fitted.
        errors: its errors, shape ``(W, 3 K)``.
        jacobian: their derivatives by the 18 nominal values (in standard deviations) and by ``free`` (in units), shape
            ``(W, 3 K, 18 + len(free))``.
        noise: under which it was fitted.
        objective: twice the negative logarithm of likelihood and knowledge.
    """

    car: Car
    free: Free
    errors: Vector
    jacobian: Vector
    noise: Noise
    objective: float

    @property
    def position(self) -> Vector:
        """The fitted values: 18 of the nominal car and those of ``free``."""
        return position(self.car, self.free)


def position(car: Car, free: Free) -> Vector:
    """The values of a car in the units of a fit."""
    values = [
        (car.effects[effect][name] - EFFECTS[effect].PARAMETERS[name].neutral) / unit(effect, name)
        for effect, name in free
    ]
    return np.concatenate([car.moved, values])


def placed(car: Car, free: Free, p: Vector) -> Car:
    """The car at other values, within the bounds of the effects."""
    n = len(car.moved)
    effects = {name: dict(values) for name, values in car.effects.items()}
    for (effect, name), value in zip(free, p[n:], strict=True):
        about = EFFECTS[effect].PARAMETERS[name]
        wanted = about.neutral + value * unit(effect, name)
        effects[effect][name] = float(np.clip(wanted, about.lower, about.upper))
    return replace(car, moved=p[:n], effects=effects)


class Study:
    """Windows with their noise, and fits to them.

    Args:
        windows: the simulations that are compared with the measurement.
        car: gives the derivatives along which noise spreads.
    """

    def __init__(self, windows: Windows, car: Car) -> None:
        self.windows = windows
        speed = windows.target[:, :, 0].mean(axis=1)
        self.spread = Spread.of(windows.transitions(car), speed)
        block = (windows.time // BLOCK).astype(np.intp)
        self.block: npt.NDArray[np.intp] = np.unique(block, return_inverse=True)[1]
        rate = np.tile(windows.spread**2, 2)
        self.floor = 1e-12 * rate

    def errors(self, car: Car, context: dict[str, float] | None = None) -> Vector:
        """Errors of a car, shape ``(W, 3 K)``."""
        return self.windows.errors(car, context).reshape(len(self.windows), -1)

    def first_noise(self, errors: Vector) -> Noise:
        """The noise under which ``errors`` are most likely."""
        rate = np.tile(self.windows.spread**2, 2)
        return fit_noise(self.spread, errors, 1e-4 * rate, self.floor)

    def refit_noise(self, noise: Noise, errors: Vector) -> Noise:
        """The same from what is known already.

        Variances that had vanished begin a little above: their logarithm is what is fitted, and that has no slope there.
        """
        return fit_noise(self.spread, errors, np.maximum(noise.v, 1e6 * self.floor), self.floor)

    def columns(self, car: Car, errors: Vector, free: Free) -> Vector:
        """Derivatives of ``errors`` by the 18 nominal values and by ``free``; shape ``(W, 3 K, P)``."""
        at, n = position(car, free), len(car.moved)
        out = np.empty((*errors.shape, len(at)))
        for k in range(len(at)):
            step = 0.05 if k < n else 0.02
            moved = at.copy()
            moved[k] += step
            other = placed(car, free, moved)
            if k >= n and position(other, free)[k] - at[k] < 0.5 * step:  # on the upper bound
                moved[k] -= 2 * step
                other = placed(car, free, moved)
            done = position(other, free)[k] - at[k]
            out[..., k] = (self.errors(other) - errors) / done
        return out

    def objective(self, errors: Vector, p: Vector, noise: Noise) -> float:
        """Twice the negative logarithm of likelihood and knowledge."""
        white = noise.whiten(errors)
        size, limit = (white**2).sum(axis=1), 4.0 * white.shape[1]
        far = np.maximum(size / limit, 1.0)
        return float(
            (np.minimum(size, limit) + limit * np.log(far)).sum() + noise.log_det + (p * self.known_before(p)) @ p
        )

    @staticmethod
    def known_before(p: Vector) -> Vector:
        """Inverse variance of what is known of each value beforehand."""
        known = np.full(len(p), _FREE**-2)
        known[:18] = 1.0
        return known

    def fit(self, car: Car, free: Free, noise: Noise | None = None, rounds: int = _ROUNDS) -> Fit:
        """Levenberg-Marquardt from ``car``; the noise is fitted along.

        Args:
            car: where to start; has the effects of ``free``.
            free: which of their parameters are fitted.
            noise: to begin with.
            rounds: of linearising anew, at most.
        """
        errors = self.errors(car)
        noise = self.refit_noise(noise, errors) if noise is not None else self.first_noise(errors)
        p = position(car, free)
        best = self.objective(errors, p, noise)
        jacobian = np.empty(0)
        for _ in range(rounds):
            jacobian = self.columns(car, errors, free)
            H, g = self._normal(errors, jacobian, p, noise)
            before = best
            for damping in _DAMPING:
                other = placed(car, free, p - np.linalg.solve(H + damping * np.diag(np.diag(H)), g))
                there = self.errors(other)
                value = self.objective(there, position(other, free), noise)
                if value < best:
                    car, errors, p = other, there, position(other, free)
                    noise = self.refit_noise(noise, errors)
                    best = self.objective(errors, p, noise)
                    break
            if before - best < _CONVERGED:
                break
        return Fit(car, free, errors, jacobian, noise, best)

    def _normal(self, errors: Vector, jacobian: Vector, p: Vector, noise: Noise) -> tuple[Vector, Vector]:
        """Second and first derivatives of half the objective, as Gauss and Newton approximate them."""
        white = noise.whiten(errors)
        root = np.sqrt(weights(white))[:, None]
        J = (noise.whiten(jacobian) * root[..., None]).reshape(-1, len(p))
        known = self.known_before(p)
        H = J.T @ J + np.diag(known)
        g = J.T @ (white * root).ravel() + known * p
        return H, g

    def covariance(self, fit: Fit) -> tuple[Vector, float]:
        """Covariance of the fitted values, robust against errors that hang together within blocks, and its inflation.

        Returns:
            Covariance in the units of the fit, shape ``(P, P)``, and how many times larger the variance of the scores
            is than independent errors would make it, at least 1.
        """
        white = fit.noise.whiten(fit.errors)
        root = np.sqrt(weights(white))
        J = fit.noise.whiten(fit.jacobian) * root[:, None, None]
        scores = np.einsum("wnp,wn->wp", J, white * root[:, None])
        flat = J.reshape(-1, J.shape[2])
        information = flat.T @ flat
        blocks = np.zeros((self.block.max() + 1, len(information)))
        np.add.at(blocks, self.block, scores)
        blocks -= blocks.mean(axis=0)
        meat = blocks.T @ blocks * len(blocks) / max(1, len(blocks) - 1)
        known = np.diag(self.known_before(fit.position))
        bread = np.linalg.inv(information + known)
        values, vectors = np.linalg.eigh(information)
        told = values > 1.0
        ratio = np.einsum("pi,pq,qi->i", vectors[:, told], meat, vectors[:, told]) / values[told]
        inflation = max(1.0, float(ratio.mean())) if told.any() else 1.0
        return bread @ (inflation * information + known) @ bread, inflation
