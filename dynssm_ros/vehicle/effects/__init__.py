"""Physics beyond the nominal model, one small class each.

An effect has named, bounded parameters with units and a neutral value at which it is absent. It overrides one or more
stages of :class:`~dynssm_ros.vehicle.single_track.StageEffect`, each called after the equations of that stage. Effects of
:mod:`measurement` change instead what is measured of the motion. The vehicle file lists effects by name. Simulation,
calibration, training and control use them without knowing which they are.
"""

from __future__ import annotations

from collections.abc import Mapping

from dynssm_ros.errors import ConfigurationError
from dynssm_ros.vehicle.effects import (
    actuators,
    drivetrain,
    environment,
    inertia,
    loads,
    longitudinal,
    measurement,
    tyres,
)
from dynssm_ros.vehicle.effects.base import (
    CONTEXT_UNITS,
    LOCATION,
    PLACE,
    Effect,
    Parameter,
    initial_effect_states,
    require_context,
)
from dynssm_ros.vehicle.single_track import StageEffect

__all__ = [
    "CONTEXT_UNITS",
    "EFFECTS",
    "LOCATION",
    "PLACE",
    "Effect",
    "Parameter",
    "build_effect",
    "initial_effect_states",
    "parse_effect",
    "register_effect",
    "require_context",
]

EFFECTS: dict[str, type[Effect]] = {}  # all effects by name: the library, and what register_effect adds


def register_effect(effect: type[Effect]) -> type[Effect]:
    """Makes an effect known by its name to vehicle files, simulation, diagnosis, training and control.

    Use it as a decorator of a class of your own.

    Raises:
        ValueError: without a name or parameters, a name that is taken, or nothing that it changes.
    """
    if not (effect.NAME and effect.PARAMETERS):
        raise ValueError(f"effect {effect.__name__}: expected NAME and PARAMETERS")
    if EFFECTS.get(effect.NAME, effect) is not effect:
        raise ValueError(f"effect {effect.NAME}: the name is taken by {EFFECTS[effect.NAME].__name__}")
    if all(getattr(effect, hook) is getattr(StageEffect, hook) for hook in StageEffect.HOOKS):
        raise ValueError(f"effect {effect.NAME}: overrides no stage and not measured; it would change nothing")
    EFFECTS[effect.NAME] = effect
    return effect


for _effect in (
    actuators.SteeringOffset, actuators.SteeringGain, actuators.SteeringCurve, actuators.SteeringLag,
    actuators.ThrottleDeadBand, actuators.ThrottleLag, longitudinal.Drag, longitudinal.RollingResistance,
    longitudinal.DriveGain, longitudinal.PowerLimit, longitudinal.DriveMap, inertia.Mass, inertia.YawInertia,
    tyres.Grip, tyres.FrontGrip, tyres.RearGrip, loads.Downforce, loads.LoadSensitivity, loads.LoadTransfer,
    tyres.TireRelaxation, tyres.CombinedSlip, environment.RoadBank, environment.RoadGrade, environment.Crosswind,
    tyres.GripDrift, tyres.GripPatch, drivetrain.FrontDrive, drivetrain.GearShift, drivetrain.LockedDifferential,
    measurement.OdometryLeverArm, measurement.OdometryMisalignment, measurement.OdometryDelay,
    measurement.OdometryCorrection, measurement.YawRateBias, measurement.YawRateLag,
):  # fmt: skip
    register_effect(_effect)


def build_effect(name: str, parameters: Mapping[str, float]) -> Effect:
    """Builds an effect from its name and parameters as a vehicle file gives them; those left out are neutral.

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


def parse_effect(text: str) -> tuple[str, dict[str, float]]:
    """``NAME[:k=v,...]`` to name and parameters.

    Raises:
        ConfigurationError: not of that form.
    """
    name, _, rest = text.partition(":")
    parameters: dict[str, float] = {}
    for pair in filter(None, rest.split(",")):
        key, _, value = pair.partition("=")
        try:
            parameters[key.strip()] = float(value)
        except ValueError as error:
            raise ConfigurationError(
                f"effect {text}: '{pair}'; expected NAME=NUMBER, as in drag:coefficient=0.3"
            ) from error
    return name.strip(), parameters
