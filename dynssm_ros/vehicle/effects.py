"""Physics beyond the nominal model, one small class each.

An effect has named, bounded parameters with units and a neutral value at which it is absent. It acts after one or more
stages of :mod:`dynssm_ros.vehicle.single_track`: a method that carries a stage's name is called after that stage and
changes the :class:`~dynssm_ros.vehicle.single_track.Motion`. The vehicle file lists effects by name, and simulation,
calibration, training and control use them without knowing which they are.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any, ClassVar

from dynssm_ros.vehicle.single_track import STAGE_NAMES, Array, Motion


@dataclass(frozen=True)
class Parameter:
    """A parameter of an effect: its unit, bounds, and the value at which the effect vanishes."""

    unit: str
    lower: float
    upper: float
    neutral: float


@dataclass(frozen=True)
class Effect:
    """Base of all effects. The dataclass fields of a subclass are its parameters, described in ``PARAMETERS``."""

    NAME: ClassVar[str] = ""
    PARAMETERS: ClassVar[dict[str, Parameter]] = {}
    MEMORY: ClassVar[tuple[str, ...]] = ()

    def apply(self, stage: str, xp: Any, q: Motion) -> None:
        """Calls the method named like ``stage``, if the effect has one."""
        act = getattr(self, stage, None)
        if act is not None:
            act(xp, q)

    def initial_memory(self, r: Array, delta: Array) -> dict[str, Array]:
        """The effect's own states at rest under the applied inputs ``r`` and ``delta``."""
        return {}

    @property
    def parameters(self) -> dict[str, float]:
        """The values by name."""
        return {f.name: getattr(self, f.name) for f in fields(self)}


@dataclass(frozen=True)
class SteeringOffset(Effect):
    """The steering sensor's zero is off; a team would re-zero the rack."""

    NAME = "steering_offset"
    PARAMETERS = {"offset": Parameter("rad", -0.05, 0.05, 0.0)}
    offset: float = 0.0

    def inputs(self, xp: Any, q: Motion) -> None:
        """Shifts the steering that acts on the tyres."""
        q.delta = q.delta + self.offset


@dataclass(frozen=True)
class SteeringLag(Effect):
    """The wheels follow the measured steering with a first-order lag; a team would check the actuator and its play."""

    NAME = "steering_lag"
    PARAMETERS = {"time_constant": Parameter("s", 0.0, 0.5, 0.0)}
    MEMORY = ("steering_lag.delta",)
    time_constant: float = 0.0

    def initial_memory(self, r: Array, delta: Array) -> dict[str, Array]:
        """Starts settled."""
        return {self.MEMORY[0]: delta}

    def inputs(self, xp: Any, q: Motion) -> None:
        """Replaces the steering by its lagged value and says how that moves."""
        (name,) = self.MEMORY
        if self.time_constant == 0.0:
            q.memory_rate[name] = 0.0 * q.delta
            return
        q.memory_rate[name] = (q.delta - q.memory[name]) / self.time_constant
        q.delta = q.memory[name]


@dataclass(frozen=True)
class Drag(Effect):
    """Air drag beyond C_r2: a wing, a tow, wind along the straight."""

    NAME = "drag"
    PARAMETERS = {"coefficient": Parameter("N/(m/s)^2", -1.0, 2.0, 0.0)}
    coefficient: float = 0.0

    def drive(self, xp: Any, q: Motion) -> None:
        """Takes the extra drag off the longitudinal force."""
        q.F_rx = q.F_rx - self.coefficient * q.v_x * q.v_x


@dataclass(frozen=True)
class FrontGrip(Effect):
    """The front axle grips more or less than the nominal tyre: pressure, temperature, wear."""

    NAME = "front_grip"
    PARAMETERS = {"factor": Parameter("1", 0.3, 1.7, 1.0)}
    factor: float = 1.0

    def tyres(self, xp: Any, q: Motion) -> None:
        """Scales the front lateral force."""
        q.F_fy = q.F_fy * self.factor


@dataclass(frozen=True)
class RearGrip(Effect):
    """The rear axle grips more or less than the nominal tyre: pressure, temperature, wear."""

    NAME = "rear_grip"
    PARAMETERS = {"factor": Parameter("1", 0.3, 1.7, 1.0)}
    factor: float = 1.0

    def tyres(self, xp: Any, q: Motion) -> None:
        """Scales the rear lateral force."""
        q.F_ry = q.F_ry * self.factor


EFFECTS: dict[str, type[Effect]] = {
    effect.NAME: effect for effect in (SteeringOffset, SteeringLag, Drag, FrontGrip, RearGrip)
}


def build_effect(name: str, parameters: dict[str, float]) -> Effect:
    """Builds an effect from its name and parameters as a vehicle file gives them.

    Raises:
        ValueError: unknown name or parameter, or a value outside its bounds.
    """
    if name not in EFFECTS:
        raise ValueError(f"unknown effect '{name}'; known: {', '.join(sorted(EFFECTS))}")
    effect = EFFECTS[name]
    for key, value in parameters.items():
        if key not in effect.PARAMETERS:
            raise ValueError(f"effect {name} has no parameter '{key}'; it has {', '.join(effect.PARAMETERS)}")
        about = effect.PARAMETERS[key]
        if not about.lower <= value <= about.upper:
            raise ValueError(
                f"effect {name}: {key} = {value:g} {about.unit} is outside [{about.lower:g}, {about.upper:g}]"
            )
    return effect(**parameters)


def initial_memory(effects: tuple[Effect, ...], r: Array, delta: Array) -> dict[str, Array]:
    """The settled own states of ``effects``, by name."""
    memory: dict[str, Array] = {}
    for effect in effects:
        memory |= effect.initial_memory(r, delta)
    return memory


assert all(any(hasattr(effect, stage) for stage in STAGE_NAMES) for effect in EFFECTS.values()), (
    "every effect acts at a stage"
)
