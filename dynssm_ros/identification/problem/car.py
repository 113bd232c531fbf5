"""The car as a fit moves it: nominal values that are known more or less well, and effects on top of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np

from dynssm_ros.arrays import Indices, Mask, Vector
from dynssm_ros.identification import tuning
from dynssm_ros.vehicle import COEFFICIENTS, Coefficients, Vehicle
from dynssm_ros.vehicle.effects import EFFECTS, Effect
from dynssm_ros.vehicle.single_track import SetPoint, VehicleConstants

Values = dict[str, float]
_KEPT = 64  # vehicles whose coefficients are kept at hand


@dataclass(frozen=True)
class CarEstimate:
    """A vehicle with moved nominal values and effects.

    Attributes:
        vehicle: as the file has it; its own effects always act, before those of ``effects``.
        moved: how far each of the 17 coefficients, and then the mass, is off its nominal value, in standard
            deviations of what is known of it; shape ``(18,)``. Those that are positive move as logarithms.
        effects: values by effect and parameter, in the order in which they act.
        mass_std: standard deviation of the mass, as a share of it; 0: the mass is known.
        only_in: numbers of the recordings in which an effect acts, by its name; those that are not there act in all.
    """

    vehicle: Vehicle
    moved: Vector
    effects: Mapping[str, Values]
    mass_std: float = tuning.MASS_STD
    only_in: Mapping[str, tuple[int, ...]] = field(default_factory=dict)

    @classmethod
    def of(cls, vehicle: Vehicle, mass_std: float | None = None) -> CarEstimate:
        """The car as the vehicle file has it, with the standard deviation of the mass that it states if not given."""
        if mass_std is None:
            weighed = vehicle.constants.m_std
            mass_std = tuning.MASS_STD if weighed is None else weighed / vehicle.constants.m
        return cls(vehicle, np.zeros(len(COEFFICIENTS) + 1), {}, mass_std)

    def at(self, theta: Vector) -> CarEstimate:
        """The same car with coefficients ``theta`` ``(17,)``."""
        return replace(self, moved=np.append(_about(self.vehicle).moved(theta), self.moved[-1]))

    @property
    def as_known(self) -> CarEstimate:
        """The same car with its nominal values where they were known to be."""
        return replace(self, moved=np.zeros_like(self.moved))

    @property
    def prior_precision(self) -> Vector:
        """Inverse covariance of what is known of :attr:`moved`, ``(18, 18)``."""
        precision = np.eye(len(COEFFICIENTS) + 1)
        precision[:-1, :-1] = np.linalg.inv(self.vehicle.known_correlation)
        return precision

    @cached_property
    def limits(self) -> tuple[Vector, Vector]:
        """The least and the largest of :attr:`moved`."""
        lower, upper = _about(self.vehicle).limits
        mass = np.log([1 / tuning.MASS_RANGE, tuning.MASS_RANGE]) / self.mass_std if self.mass_std else (-1.0, 1.0)
        return np.append(lower, mass[0]), np.append(upper, mass[1])

    @cached_property
    def theta(self) -> Coefficients:
        """The coefficients, inside their bounds."""
        about = _about(self.vehicle)
        step = np.clip(self.moved, *self.limits)[:-1] * about.std
        grown = about.nominal * np.exp(np.where(about.scales, step / about.base, 0.0))
        return Coefficients(*np.where(about.scales, grown, about.nominal + step).tolist())

    @cached_property
    def constants(self) -> VehicleConstants:
        """Mass and geometry."""
        factor = float(np.exp(self.mass_std * np.clip(self.moved, *self.limits)[-1]))
        return self.vehicle.constants.model_copy(update={"m": self.vehicle.constants.m * factor})

    def least(self, effect: str, steered: float) -> float:
        """How far off neutral an effect must be to be a cause: what the file has already is known no better than that.

        Args:
            effect: its name.
            steered: the largest steering angle that was driven (rad).
        """
        about = EFFECTS[effect]
        is_known = any(entry.name == effect for entry in self.vehicle.effects)
        return max(about.least(self.vehicle.constants, steered), about.TYPICAL[0] if is_known else 0.0)

    def with_effect(self, name: str, values: Values, only_in: tuple[int, ...] | None = None) -> CarEstimate:
        """The same car with an effect added or changed.

        Args:
            name: of the effect.
            values: of its parameters.
            only_in: recordings in which it acts; empty: in all; ``None``: as before.
        """
        where = self.only_in if only_in is None else {k: v for k, v in {**self.only_in, name: only_in}.items() if v}
        return replace(self, effects={**self.effects, name: dict(values)}, only_in=where)

    def without(self, name: str) -> CarEstimate:
        """The same car without an effect."""
        effects = {key: values for key, values in self.effects.items() if key != name}
        return replace(self, effects=effects, only_in={k: v for k, v in self.only_in.items() if k != name})

    def known(self, covariance: Vector) -> Vehicle:
        """The vehicle with refitted nominal values and what is now known of them, never less than before.

        Args:
            covariance: of :attr:`moved`, at least its first 17 rows and columns.
        """
        n, about = len(COEFFICIENTS), _about(self.vehicle)
        relative = np.sqrt(np.diag(covariance)[:n])
        correlation = covariance[:n, :n] / np.outer(relative, relative)
        grown = np.where(about.scales, np.array(self.theta) / about.base, 1.0)
        std = np.minimum(relative, 1.0) * about.std * grown
        return self.vehicle.with_nominal(np.array(self.theta), std, correlation)

    def extended(self, covariance: Vector, recording: int | None = None) -> Vehicle:
        """The vehicle to write: as :meth:`known`, with mass and effects.

        Args:
            covariance: of :attr:`moved`, at least its first 17 rows and columns.
            recording: number of the one in which the car is meant; ``None``: with what acts in all of them alone.
        """
        vehicle = self.known(covariance)
        vehicle = vehicle.model_copy(update={"constants": self.constants})
        return vehicle.with_effects(
            (name, values)
            for name, values in self.effects.items()
            if name not in self.only_in or recording in self.only_in[name]
        )


class CarBatch(NamedTuple):
    """``P`` cars as one: values are shape ``(P, 1)``, which broadcasts against ``W`` simulations, or equal numbers."""

    theta: Coefficients
    constants: Any
    effects: tuple[Effect, ...]
    set_point: SetPoint

    @classmethod
    def of(cls, cars: Sequence[CarEstimate], number: Indices) -> CarBatch:
        """Cars of one vehicle with the same effects in the same order.

        Args:
            cars: that differ in values alone.
            number: of the recording of each simulation, shape ``(W,)``.
        """
        first = cars[0]
        theta = Coefficients(*map(_together, zip(*(car.theta for car in cars), strict=True)))
        mass = _together([car.constants.m for car in cars])
        constants = first.constants if len(cars) == 1 else SimpleNamespace(**dict(first.constants) | {"m": mass})
        own = []
        for name, values in first.effects.items():
            columns = {key: _together([car.effects[name][key] for car in cars]) for key in values}
            if name in first.only_in:
                acts = np.isin(number, first.only_in[name])
                about = EFFECTS[name].PARAMETERS
                columns = {k: v if about[k].shape else np.where(acts, v, about[k].neutral) for k, v in columns.items()}
            own.append(EFFECTS[name](**columns))
        return cls(theta, constants, (*first.vehicle.active_effects, *own), first.vehicle.inputs.set_point)


def _together(values: Sequence[float]) -> Any:
    """The number that all are, or a column of them."""
    column = np.array(values)
    return float(column[0]) if (column == column[0]).all() else column[:, None]


@dataclass(frozen=True)
class _CoefficientScale:
    """How the coefficients of a vehicle move."""

    vehicle: Vehicle

    @cached_property
    def nominal(self) -> Vector:
        return self.vehicle.nominal

    @cached_property
    def std(self) -> Vector:
        """Of what is known of them."""
        return prior_std(self.vehicle)

    @cached_property
    def scales(self) -> Mask:
        """Those that move as logarithms, so that an effect that multiplies can make up for them exactly."""
        return np.asarray((self.vehicle.lower >= 0) & (self.nominal > 0))

    @cached_property
    def base(self) -> Vector:
        """What those are divided by; 1 for the others."""
        return np.where(self.scales, self.nominal, 1.0)

    @cached_property
    def limits(self) -> tuple[Vector, Vector]:
        """The least and the largest of :meth:`moved`."""
        lower, upper = self.vehicle.lower, self.vehicle.upper
        margin = tuning.INSIDE_BOUNDS * (upper - lower)
        return self.moved(lower + margin), self.moved(upper - margin)

    def moved(self, values: Vector) -> Vector:
        """How far values ``(17,)`` are off nominal, in standard deviations of what is known before."""
        grown = self.base * np.log(np.where(self.scales, values, 1.0) / self.base)
        return np.asarray(np.where(self.scales, grown, values - self.nominal) / self.std)


_KNOWN: dict[int, _CoefficientScale] = {}


def _about(vehicle: Vehicle) -> _CoefficientScale:
    """How the coefficients move: worked out once for the cars of a fit, which share the vehicle."""
    found = _KNOWN.get(id(vehicle))
    if found is None:  # the number is no other vehicle's while this one is kept
        if len(_KNOWN) > _KEPT:
            _KNOWN.clear()
        found = _KNOWN[id(vehicle)] = _CoefficientScale(vehicle)
    return found


def prior_std(vehicle: Vehicle) -> Vector:
    """Standard deviations of the 17 nominal values; where the file has none, that of a uniform spread in the bounds."""
    uniform = (vehicle.upper - vehicle.lower) / np.sqrt(12.0)
    stated = [vehicle.coefficients[name].std for name in COEFFICIENTS]
    return np.array([u if s is None else max(s, 1e-6 * u) for s, u in zip(stated, uniform, strict=True)])
