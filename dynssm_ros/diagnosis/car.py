"""The car as a fit moves it: nominal values that are known more or less well, and effects on top of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from dynssm_ros.vehicle import COEFFICIENTS, Coefficients, Vehicle
from dynssm_ros.vehicle.effects import EFFECTS, Effect
from dynssm_ros.vehicle.parameters import VehicleConstants

Vector = npt.NDArray[np.float64]
Values = dict[str, float]

MASS_STD = 0.01  # of the mass: vehicle files do not say how well it was weighed
_ON_BOUND = 1e-3  # of the range, that a nominal value keeps from its bounds


@dataclass(frozen=True)
class Car:
    """A vehicle with moved nominal values and effects.

    Attributes:
        vehicle: as the file has it; its own effects always act, before those of ``effects``.
        moved: how far each of the 17 coefficients, and then the mass, is off its nominal value, in standard
            deviations of what is known of it; shape ``(18,)``.
        effects: values by effect and parameter, in the order in which they act.
    """

    vehicle: Vehicle
    moved: Vector
    effects: Mapping[str, Values]

    @classmethod
    def of(cls, vehicle: Vehicle) -> Car:
        """The car as the vehicle file has it."""
        return cls(vehicle, np.zeros(len(COEFFICIENTS) + 1), {})

    @property
    def theta(self) -> Coefficients:
        """The coefficients, inside their bounds."""
        wanted = self.vehicle.nominal + self.moved[:-1] * knowledge(self.vehicle)
        margin = _ON_BOUND * (self.vehicle.upper - self.vehicle.lower)
        return Coefficients(*np.clip(wanted, self.vehicle.lower + margin, self.vehicle.upper - margin).tolist())

    @property
    def constants(self) -> VehicleConstants:
        """Mass and geometry."""
        factor = max(1.0 + MASS_STD * float(self.moved[-1]), 0.1)
        return self.vehicle.constants.model_copy(update={"m": self.vehicle.constants.m * factor})

    @property
    def active(self) -> tuple[Effect, ...]:
        """All effects, ready to act."""
        return (*self.vehicle.active_effects, *(EFFECTS[name](**values) for name, values in self.effects.items()))

    def with_effect(self, name: str, values: Values) -> Car:
        """The same car with an effect added or changed."""
        return replace(self, effects={**self.effects, name: dict(values)})

    def without(self, name: str) -> Car:
        """The same car without an effect."""
        return replace(self, effects={key: values for key, values in self.effects.items() if key != name})

    def extended(self, std: Vector) -> Vehicle:
        """The vehicle to write: refitted nominal values, what is now known of them, and the effects.

        Args:
            std: standard deviations of the 17 coefficients.
        """
        vehicle = self.vehicle.with_nominal(np.array(self.theta), std)
        vehicle = vehicle.model_copy(update={"constants": self.constants})
        for name, values in self.effects.items():
            vehicle = vehicle.with_effect(name, values)
        return vehicle


def knowledge(vehicle: Vehicle) -> Vector:
    """Standard deviations of the 17 nominal values; where the file has none, that of a uniform spread in the bounds."""
    uniform = (vehicle.upper - vehicle.lower) / np.sqrt(12.0)
    stated = [vehicle.coefficients[name].std for name in COEFFICIENTS]
    return np.array([u if s is None else max(s, 1e-6 * u) for s, u in zip(stated, uniform, strict=True)])
