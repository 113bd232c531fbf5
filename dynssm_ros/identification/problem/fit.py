"""Fitting a car to windows of a recording: nominal values under what is known of them, effects within their bounds."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeVar

import numpy as np
from scipy.optimize import lsq_linear

from dynssm_ros.arrays import Indices, Mask, Vector, normal_equations, sums_by
from dynssm_ros.identification import tuning
from dynssm_ros.identification.problem.car import CarEstimate
from dynssm_ros.identification.problem.noise import Noise, NoiseResponse, fit_noise
from dynssm_ros.identification.problem.windows import SimulationWindows
from dynssm_ros.vehicle.effects import EFFECTS

Free = tuple[tuple[str, str], ...]
"""Effect and parameter of each value that is fitted beside the nominal ones."""

_ROUNDING = 1e-12  # of second derivatives, that keeps them positive where nothing was excited
Option = TypeVar("Option")


def unit(effect: str, parameter: str) -> float:
    """The unit in which a parameter is fitted."""
    return tuning.EFFECT_UNIT * EFFECTS[effect].PARAMETERS[parameter].span


def _in_units(effect: str, parameter: str, value: float) -> float:
    """A parameter's value as a fit has it: 0 where it is neutral."""
    about = EFFECTS[effect].PARAMETERS[parameter]
    off = np.log(value) if about.scales else value - about.neutral
    return float(off / unit(effect, parameter))


def _value(effect: str, parameter: str, in_units: float) -> float:
    """The inverse of :func:`_in_units`, within the bounds."""
    about, off = EFFECTS[effect].PARAMETERS[parameter], in_units * unit(effect, parameter)
    value = np.exp(off) if about.scales else about.neutral + off
    return float(np.clip(value, about.lower, about.upper))


def per_unit(effect: str, parameter: str, value: float) -> float:
    """How much a parameter that has ``value`` changes per unit of a fit."""
    return unit(effect, parameter) * (value if EFFECTS[effect].PARAMETERS[parameter].scales else 1.0)


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
        objective: twice the negative logarithm of likelihood and prior.
    """

    car: CarEstimate
    free: Free
    errors: Vector
    jacobian: Vector
    noise: Noise
    objective: float

    @property
    def position(self) -> Vector:
        """The fitted values: 18 of the nominal car and those of ``free``."""
        return position(self.car, self.free)

    @cached_property
    def white_jacobian(self) -> Vector:
        """The derivatives whitened; of the same shape."""
        return self.noise.whiten(self.jacobian)


def closest(fits: Mapping[Option, Fit]) -> Option:
    """What is closest to the data; not the first option only if that is clear."""
    first = next(iter(fits))
    best = min(fits, key=lambda one: fits[one].objective)
    return best if fits[best].objective < fits[first].objective - tuning.CLEARLY_CLOSER else first


def position(car: CarEstimate, free: Free) -> Vector:
    """The values of a car in the units of a fit."""
    return np.concatenate([car.moved, [_in_units(e, name, car.effects[e][name]) for e, name in free]])


def limits(car: CarEstimate, free: Free) -> tuple[Vector, Vector]:
    """The least and the largest values, in the units of a fit."""
    bounds = [(EFFECTS[e].PARAMETERS[name].lower, EFFECTS[e].PARAMETERS[name].upper) for e, name in free]
    inside = np.array([[_in_units(*pair, bound) for bound in b] for pair, b in zip(free, bounds, strict=True)])
    lower, upper = car.limits
    return np.concatenate([lower, inside.reshape(-1, 2)[:, 0]]), np.concatenate([upper, inside.reshape(-1, 2)[:, 1]])


def with_values(car: CarEstimate, free: Free, p: Vector) -> CarEstimate:
    """The car at other values, within their bounds."""
    n = len(car.moved)
    p = np.clip(p, *limits(car, free))
    effects = {name: dict(values) for name, values in car.effects.items()}
    for (effect, name), value in zip(free, p[n:], strict=True):
        effects[effect][name] = _value(effect, name, value)
    return replace(car, moved=p[:n], effects=effects)


class IdentificationProblem:
    """Simulations with their noise, and fits to them.

    Args:
        windows: the simulations that are compared with the measurement.
        car: gives the derivatives along which noise spreads, and what is known of the nominal values.
        tempering: by which the logarithm of the likelihood is divided: so many errors that hang together tell as much as
            one.
    """

    def __init__(self, windows: SimulationWindows, car: CarEstimate, tempering: float = 1.0) -> None:
        self.windows = windows
        speed = windows.target[:, :, 0].mean(axis=1)
        self.spread = NoiseResponse.of(windows.transitions(car), speed)
        self._regime = _regimes(windows)
        self._channels = np.tile(windows.spread**2, 3)
        self._known = car.prior_precision
        self.tempering = tempering

    def temper(self, fit: Fit) -> Fit:
        """Weighs the data as the errors of ``fit`` hang together, against what is known before, and fits anew."""
        self.tempering = self.inflation(fit)
        return self.refit(fit)

    def refit(self, fit: Fit) -> Fit:
        """The same values fitted anew, as the data are weighed now: from where they are and from what was known; the closer.

        Where the data counted for more, nominal values may lie in a valley that is no longer the deepest.
        """
        return min(self.again(fit), self.fit(fit.car.as_known, fit.free), key=lambda each: each.objective)

    def again(self, fit: Fit) -> Fit:
        """The same values, fitted to the end from where they are."""
        return self.fit(fit.car, fit.free, fit)

    def errors(self, car: CarEstimate, context: dict[str, float] | None = None) -> Vector:
        """Errors of a car, shape ``(W, 3 K)``."""
        return self.windows.errors(car, context).reshape(len(self.windows), -1)

    def errors_of(self, cars: Sequence[CarEstimate], context: dict[str, float] | None = None) -> Vector:
        """Errors of several cars that differ in values alone, shape ``(P, W, 3 K)``."""
        return self.windows.errors_of(cars, context).reshape(len(cars), len(self.windows), -1)

    def noise(self, errors: Vector) -> Noise:
        """The noise under which ``errors`` are most likely, whatever it was taken for before.

        That of an estimated ``v_y`` is no less than its recording states.
        """
        least, largest = tuning.NOISE_SHARES
        floor = least * self._channels
        floor[1] = max(floor[1], self.windows.data.v_y_variance)
        return fit_noise(self.spread, errors, largest * self._channels, floor)

    def columns(self, car: CarEstimate, errors: Vector, free: Free, first: int = 0) -> Vector:
        """Derivatives of ``errors`` by the 18 nominal values and by ``free``, from the ``first`` on.

        Shape ``(W, 3 K, P - first)``.
        """
        at, n = position(car, free), len(car.moved)
        upper = limits(car, free)[1]
        cars, done = [], np.empty(len(at) - first)
        for k in range(first, len(at)):
            step = tuning.NOMINAL_STEP if k < n else tuning.EFFECT_STEP
            moved = at.copy()
            moved[k] += step if at[k] + step <= upper[k] else -step
            done[k - first] = moved[k] - at[k]
            cars.append(with_values(car, free, moved))
        change = self.errors_of(cars) - errors
        return np.asarray(np.moveaxis(change, 0, -1) / done)

    def objective(self, errors: Vector, p: Vector, noise: Noise) -> float:
        """Twice the negative logarithm of likelihood and prior."""
        told = -2.0 * self.log_likelihood(errors, noise).sum() / self.tempering
        return float(told + p @ self.prior_precision(p) @ p)

    @staticmethod
    def log_likelihood(errors: Vector, noise: Noise) -> Vector:
        """Of each window, ``(W,)``, but for a constant; windows that are far out count less and less."""
        white = noise.whiten(errors)
        size, limit = (white**2).sum(axis=1), tuning.OUTLIER_FACTOR * white.shape[1]
        far = np.maximum(size / limit, 1.0)
        return np.asarray(-0.5 * (np.minimum(size, limit) + limit * np.log(far) + noise.log_dets))

    def prior_precision(self, p: Vector) -> Vector:
        """Inverse covariance of what is known of the values ``(P,)`` beforehand, ``(P, P)``."""
        known = np.diag(np.full(len(p), tuning.EFFECT_STD**-2))
        known[: len(self._known), : len(self._known)] = self._known
        return known

    def surprise(self, fit: Fit) -> float:
        """How far the nominal values of a fit are off what was known: squared, in standard deviations."""
        return float(fit.car.moved @ self._known @ fit.car.moved)

    def fit(
        self,
        car: CarEstimate,
        free: Free,
        near: Fit | None = None,
        *,
        rounds: int = tuning.MAX_ROUNDS,
        rough: bool = False,
        noise: Noise | None = None,
    ) -> Fit:
        """Levenberg-Marquardt from ``car``; the noise is fitted along, unless it is given.

        Derivatives by the nominal values hardly change, so they are those of a fit nearby while they keep what they promise
        and until it has settled with them.

        Args:
            car: where to start; has the effects of ``free``.
            free: which of their parameters are fitted.
            near: a fit of a like car, whose derivatives serve to begin with.
            rounds: of linearising anew, at most.
            rough: whether it may end with the derivatives of ``near``.
            noise: under which it is fitted.
        """
        car = with_values(car, free, position(car, free))
        errors, n, given = self.errors(car), len(car.moved), noise is not None
        noise = self.noise(errors) if noise is None else noise
        p = position(car, free)
        best = self.objective(errors, p, noise)
        nominal = None if near is None else near.jacobian[..., :n]
        jacobian = np.empty(0)
        for last in range(rounds, 0, -1):
            stale = nominal is not None
            if nominal is not None and last > 1:
                jacobian = np.concatenate([nominal, self.columns(car, errors, free, n)], axis=2) if free else nominal
            else:
                jacobian, stale = self.columns(car, errors, free), False
            H, g = self.normal(errors, noise.whiten(jacobian), p, noise)
            before, promised, kept = best, 0.0, 0.0
            for step, other, there in self._tried(car, free, p, H, g):
                value = self.objective(there, position(other, free), noise)
                if value < best:
                    promised = -float(2 * g @ step + step @ H @ step)
                    kept = best - value
                    car, errors, p = other, there, position(other, free)
                    if kept > tuning.CONVERGED and not given:
                        noise = self.noise(errors)
                    best = self.objective(errors, p, noise)
                    break
            settled = before - best < tuning.CONVERGED
            if settled and (rough or not stale):
                break
            if stale and (settled or kept < tuning.KEPT_PROMISE * promised):
                nominal = None
            elif not stale:
                nominal = jacobian[..., :n]
        return Fit(car, free, errors, jacobian, noise, best)

    def _tried(
        self, car: CarEstimate, free: Free, p: Vector, H: Vector, g: Vector
    ) -> Iterator[tuple[Vector, CarEstimate, Vector]]:
        """Steps from ``p``, less and less far, with the cars that they lead to and their errors.

        The first is simulated alone, as it mostly serves, and all others together, which takes little more than one.
        """
        lower, upper = limits(car, free)
        for dampings in (tuning.DAMPING[:1], tuning.DAMPING[1:]):
            steps = [_step(H + damping * np.diag(np.diag(H)), g, lower - p, upper - p) for damping in dampings]
            cars = [with_values(car, free, p + step) for step in steps]
            yield from zip(steps, cars, self.errors_of(cars), strict=True)

    def recalibrated(self, car: CarEstimate) -> Fit:
        """The nominal values alone, from where they were known to be; from where ``car`` has them if that is clearly closer.

        So what is found does not hang on a calibration that was made on the same laps before.
        """
        fits = {"known": self.fit(car.as_known, ())}
        if car.moved.any():
            fits["given"] = self.fit(car, ())
        return fits[closest(fits)]

    def select(self, chosen: Indices | Mask) -> IdentificationProblem:
        """Some of the windows, with the noise responses of all."""
        other = copy(self)
        other.windows = self.windows.select(chosen)
        other.spread = NoiseResponse(self.spread.group[chosen], self.spread.G)
        other._regime = self._regime[chosen]
        return other

    def part(self, fit: Fit, every: int) -> tuple[IdentificationProblem, Fit]:
        """One window of each ``every``, which count for all, and what ``fit`` is there."""
        other = self.select(np.arange(0, len(self.windows), every))
        other.tempering = self.tempering * len(other.windows) / len(self.windows)
        noise, errors = Noise(other.spread, fit.noise.v), fit.errors[::every]
        objective = other.objective(errors, fit.position, noise)
        return other, replace(fit, errors=errors, jacobian=fit.jacobian[::every], noise=noise, objective=objective)

    def warm_started(self, cars: Sequence[CarEstimate], near: Fit) -> list[CarEstimate]:
        """The same cars with the values of ``near`` moved to where its derivatives say that they fit best."""
        out = []
        for car, errors in zip(cars, self.errors_of(cars), strict=True):
            p = position(car, near.free)
            H, g = self.normal(errors, near.white_jacobian, p, near.noise)
            lower, upper = limits(car, near.free)
            out.append(with_values(car, near.free, p + _step(H, g, lower - p, upper - p)))
        return out

    def normal(self, errors: Vector, white_jacobian: Vector, p: Vector, noise: Noise) -> tuple[Vector, Vector]:
        """Second and first derivatives of half the objective, as Gauss and Newton approximate them."""
        weighed, J, _ = noise.robust(errors, white_jacobian)
        known, weight = self.prior_precision(p), self.tempering**-0.5
        H, g = normal_equations(weight * J.reshape(-1, len(p)), weight * weighed.ravel(), known)
        return H, g + known @ p

    def covariance(self, fit: Fit) -> Vector:
        """Covariance of the fitted values in the units of the fit, shape ``(P, P)``.

        It is robust against errors that hang together in time, and against those that go with how the car is driven, as a
        model makes them that lacks something: another drive would then ask for other values. In the directions in which
        such errors tell more than independent ones could, it is the cluster-robust covariance (Liang and Zeger 1986) with
        stretches of like speed and steering as clusters.
        """
        once, known = self.counted_once(fit), self.prior_precision(fit.position)
        information, meat = self._scores(fit, self._regime)
        root = np.linalg.cholesky(information + _ROUNDING * (np.diag(np.diag(information)) + np.eye(len(information))))
        white = np.linalg.solve(root, np.linalg.solve(root, meat).T) / once
        ratio, direction = np.linalg.eigh((white + white.T) / 2)
        spread = root @ direction
        told = (spread * np.maximum(ratio, 1.0)) @ spread.T / once
        inverse = np.linalg.inv(information / once + known)
        return np.asarray(inverse @ (told + known) @ inverse)

    def counted_once(self, fit: Fit) -> float:
        """How many errors that hang together count as one beside ``fit``."""
        return max(self.inflation(fit), self.tempering)

    def information(self, fit: Fit) -> Vector:
        """What the data alone say of the fitted values, ``(P, P)``: the inverse of their covariance."""
        return self._scores(fit, self.windows.block)[0]

    def inflation(self, fit: Fit, last: int = 0) -> float:
        """How many times larger the variance of the scores is than independent errors would make it, at least 1.

        The larger one of the mean over all that the data tell of and, with ``last``, what is sure of that of the last
        values, with what the others can take up projected out.
        """
        information, meat = self._scores(fit, self.windows.block)
        values, vectors = np.linalg.eigh(information)
        told = values > 1.0
        ratio = np.einsum("pi,pq,qi->i", vectors[:, told], meat, vectors[:, told]) / values[told]
        inflation = float(ratio.mean()) if told.any() else 1.0
        if last:
            known = self.prior_precision(fit.position)
            n = len(information) - last
            taken = np.linalg.solve((information + known)[:n, :n], information[:n, n:])
            left = np.concatenate([-taken, np.eye(last)])
            own = np.linalg.solve(left.T @ information @ left + 1e-9 * np.eye(last), left.T @ meat @ left)
            chance = 1.0 + 2.0 * np.sqrt(2.0 / (self.windows.block.max() + 1))
            inflation = max(inflation, float(np.trace(own)) / last / chance)
        return max(1.0, inflation)

    def _scores(self, fit: Fit, cluster: Indices) -> tuple[Vector, Vector]:
        """The information on the fitted values, and what clusters of errors make of it, both ``(P, P)``."""
        weighed, J, _ = fit.noise.robust(fit.errors, fit.white_jacobian)
        scores = np.einsum("wnp,wn->wp", J, weighed)
        flat = J.reshape(-1, J.shape[2])
        information = flat.T @ flat
        sums = sums_by(cluster, scores)
        sums -= sums.mean(axis=0)
        return information, sums.T @ sums * len(sums) / max(1, len(sums) - 1)


def _regimes(windows: SimulationWindows) -> Indices:
    """Number of the speed and steering with which each window is driven, ``(W,)``: bins with as many windows each."""
    rows, (speeds, steerings) = windows.driven, tuning.REGIME_BINS
    speed, steering = (
        np.searchsorted(np.quantile(value, np.linspace(0.0, 1.0, bins + 1)[1:-1]), value)
        for value, bins in ((rows[0], speeds), (rows[4] + rows[6], steerings))
    )
    return np.unique(speed * steerings + steering, return_inverse=True)[1]


def _step(H: Vector, g: Vector, lower: Vector, upper: Vector) -> Vector:
    """The step that a quadratic asks for within bounds: what would leave them stays on them, the others follow."""
    root = np.linalg.cholesky(H + _ROUNDING * np.diag(np.diag(H)))
    return np.asarray(lsq_linear(root.T, -np.linalg.solve(root, g), (lower, upper), "bvls").x)
