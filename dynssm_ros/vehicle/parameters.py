"""The vehicle file: constants, coefficients with bounds and standard deviations, input limits, effects.

Names and units are the paper's (Table I); a file is checked completely when it is read, so inside the package a
:class:`Vehicle` is trusted.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from functools import reduce
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from pydantic import Field, field_validator, model_validator

from dynssm_ros import configuration
from dynssm_ros.arrays import Vector
from dynssm_ros.configuration import StrictModel
from dynssm_ros.files import replacing
from dynssm_ros.vehicle import ranges
from dynssm_ros.vehicle.effects import EFFECTS, Effect, build_effect
from dynssm_ros.vehicle.integrators import Integrator
from dynssm_ros.vehicle.single_track import Applied, Array, Coefficients, SetPoint, VehicleConstants

COEFFICIENT_UNITS: dict[str, str] = {
    "B_f": "1/rad", "C_f": "1", "D_f": "N", "E_f": "1",
    "B_r": "1/rad", "C_r": "1", "D_r": "N", "E_r": "1",
    "S_hf": "rad", "S_vf": "N", "S_hr": "rad", "S_vr": "N",
    "C_m1": "N", "C_m2": "N s/m", "C_r0": "N", "C_r2": "N s^2/m^2", "I_z": "kg m^2",
}  # fmt: skip
COEFFICIENTS: tuple[str, ...] = Coefficients._fields
assert tuple(COEFFICIENT_UNITS) == COEFFICIENTS
_LAPS = 1000  # fingerprints in a file, at most
_DRAWN = 1e-4  # share by which correlations are drawn to independence when they are written


class Coefficient(StrictModel):
    """One entry of theta: its nominal value, admissible range, and how well it is known."""

    nominal: float = Field(description="best known value")
    bounds: tuple[float, float] = Field(description="admissible range [min, max]")
    std: float | None = Field(
        default=None, ge=0, description="standard deviation of the nominal value; null: known by its bounds only"
    )

    @model_validator(mode="after")
    def _ordered(self) -> Coefficient:
        lower, upper = self.bounds
        if not lower < upper:
            raise ValueError(f"bounds [{lower:g}, {upper:g}] must be [min, max] with min < max")
        if not lower <= self.nominal <= upper:
            raise ValueError(f"nominal {self.nominal:g} is outside its bounds [{lower:g}, {upper:g}]")
        return self


class InputLimits(StrictModel):
    """What the actuators can do."""

    set_point: SetPoint = Field(
        default="throttle",
        description="what the first input asks for: throttle, a share of the drive force; speed (m/s), held by a controller "
        "in the car with gain C_m2 and largest force C_m1",
    )
    throttle: tuple[float, float] = Field(
        description="range of the signed throttle (fraction, negative brakes), or of the speed set-point (m/s)"
    )
    steering: tuple[float, float] = Field(description="range of the road-wheel angle (rad)")
    steering_rate: float = Field(gt=0, description="largest steering speed (rad/s)")

    def reached(self, wanted: Applied, previous: Applied, T_s: float) -> Applied:
        """What the actuators make of ``wanted`` within ``T_s`` (s) after ``previous``: in range, no faster than they can."""
        reach = self.steering_rate * T_s
        delta = min(max(wanted.delta, previous.delta - reach), previous.delta + reach)
        return self.clamped(Applied(wanted.r, delta))

    def clamped(self, wanted: Applied) -> Applied:
        """``wanted`` in the range of the actuators."""
        return Applied(
            float(min(max(wanted.r, self.throttle[0]), self.throttle[1])),
            float(min(max(wanted.delta, self.steering[0]), self.steering[1])),
        )

    @property
    def full_brakes(self) -> float:
        """The first input that stops the car: least throttle, or the speed set-point nearest to 0."""
        low, high = self.throttle
        return low if self.set_point == "throttle" else min(max(low, 0.0), high)

    def coasting(self, v_x: Array) -> Array:
        """The first input that neither drives nor brakes at speed ``v_x`` (m/s); the shape is kept."""
        return 0.0 * v_x if self.set_point == "throttle" else v_x

    @field_validator("throttle", "steering")
    @classmethod
    def _ordered(cls, value: tuple[float, float]) -> tuple[float, float]:
        if not value[0] < value[1]:
            raise ValueError(f"[{value[0]:g}, {value[1]:g}] must be [min, max] with min < max")
        return value


class EffectEntry(StrictModel):
    """An effect by name, with its parameters."""

    name: str
    parameters: dict[str, float] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _buildable(self) -> EffectEntry:
        build_effect(self.name, self.parameters)
        return self


class KnownBefore(StrictModel):
    """What was known of the coefficients before they were calibrated."""

    laps: tuple[str, ...] = Field(description="fingerprints of what they were calibrated on since")
    nominal: dict[str, float]
    std: dict[str, float | None]
    correlation: tuple[tuple[float, ...], ...] | None = None


class Vehicle(StrictModel):
    """A car as the whole package knows it."""

    name: str
    description: str = ""
    constants: VehicleConstants
    sampling_time: float = Field(gt=0, le=1, description="T_s (s)")
    minimum_speed: float = Field(
        default=0.0,
        ge=0,
        description="slower rows are not calibrated, trained, diagnosed or scored on (m/s): the car parks or creeps there",
    )
    inputs: InputLimits
    coefficients: dict[str, Coefficient]
    correlation: tuple[tuple[float, ...], ...] | None = Field(
        default=None,
        description="of what is known of the coefficients, in their order: row k has the correlations with the k before it. "
        "null: their standard deviations are independent",
    )
    integrator: Integrator | None = Field(
        default=None, description="of the steps that the coefficients were calibrated for; null: of any"
    )
    effects: tuple[EffectEntry, ...] = ()
    before: KnownBefore | None = Field(
        default=None,
        description="what was known before the calibration: laps that were calibrated on tell nothing new a second time",
    )
    held_out: dict[str, float] = Field(
        default_factory=dict,
        description="share at the end of a recording (fingerprint of its first rows) that calibration and training left out",
    )

    @property
    def model_integrator(self) -> Integrator:
        """Of models of this car: that of its calibration; else Euler steps of T_s, as in the paper."""
        return self.integrator or "euler"

    @field_validator("coefficients")
    @classmethod
    def _complete(cls, value: dict[str, Coefficient]) -> dict[str, Coefficient]:
        missing = [name for name in COEFFICIENTS if name not in value]
        unknown = [name for name in value if name not in COEFFICIENTS]
        if missing:
            raise ValueError(f"missing {', '.join(missing)}; all of {' '.join(COEFFICIENTS)} are needed")
        if unknown:
            raise ValueError(f"unknown {', '.join(unknown)}; expected {' '.join(COEFFICIENTS)}")
        return {name: value[name] for name in COEFFICIENTS}

    @field_validator("correlation")
    @classmethod
    def _correlations(cls, value: tuple[tuple[float, ...], ...] | None) -> tuple[tuple[float, ...], ...] | None:
        if value is not None:
            if [len(row) for row in value] != list(range(len(COEFFICIENTS))):
                raise ValueError(
                    f"{len(value)} rows; expected {len(COEFFICIENTS)}, of which row k has k numbers, from 0"
                )
            if np.linalg.eigvalsh(_symmetric(value)).min() <= 0:
                raise ValueError("not positive definite; expected correlations of the coefficients")
        return value

    @field_validator("effects")
    @classmethod
    def _one_memory_each(cls, value: tuple[EffectEntry, ...]) -> tuple[EffectEntry, ...]:
        names = [entry.name for entry in value if EFFECTS[entry.name].EFFECT_STATES]
        twice = [name for name in names if names.count(name) > 1]
        if twice:
            raise ValueError(f"effect {twice[0]} has a state of its own and can be listed only once")
        return value

    @model_validator(mode="after")
    def _can_be(self) -> Vehicle:
        inputs = self.inputs
        bounds = {name: each.bounds for name, each in self.coefficients.items()}
        nominal = {name: each.nominal for name, each in self.coefficients.items()}
        wrong = [
            *ranges.of_constants(self.constants),
            *ranges.of_inputs(inputs.set_point, inputs.throttle, inputs.steering, inputs.steering_rate),
            *ranges.of_coefficients(
                self.constants, nominal, bounds, calibrated=self.before is not None, set_point=inputs.set_point
            ),
        ]
        if wrong:
            raise ValueError(wrong[0] + (f"; {len(wrong) - 1} more" if wrong[1:] else ""))
        return self

    @model_validator(mode="after")
    def _effects_can_act(self) -> Vehicle:
        for effect in self.active_effects:
            reason = None if effect.is_neutral else effect.unusable(self.constants)
            if reason is not None:
                raise ValueError(f"effect {effect.NAME} cannot act: {reason}")
        return self

    @property
    def nominal(self) -> Vector:
        """theta_0, shape ``(17,)``, in the order of ``COEFFICIENTS``."""
        return np.array([self.coefficients[name].nominal for name in COEFFICIENTS])

    @property
    def input_unit(self) -> float:
        """Change of the first input from no drive force to all of it: 1 of a throttle, else a speed error (m/s)."""
        if self.inputs.set_point == "throttle":
            return 1.0
        return self.coefficients["C_m1"].nominal / self.coefficients["C_m2"].nominal

    @property
    def lower(self) -> Vector:
        """theta_min, shape ``(17,)``."""
        return np.array([self.coefficients[name].bounds[0] for name in COEFFICIENTS])

    @property
    def upper(self) -> Vector:
        """theta_max, shape ``(17,)``."""
        return np.array([self.coefficients[name].bounds[1] for name in COEFFICIENTS])

    @property
    def std(self) -> list[float | None]:
        """How well the nominal values are known, in that order; ``None``: by their bounds only."""
        return [self.coefficients[name].std for name in COEFFICIENTS]

    @property
    def active_effects(self) -> tuple[Effect, ...]:
        """The effects of the file, ready to act."""
        return tuple(build_effect(entry.name, entry.parameters) for entry in self.effects)

    @property
    def known_correlation(self) -> Vector:
        """Correlation of what is known of the coefficients, ``(17, 17)``."""
        return np.eye(len(COEFFICIENTS)) if self.correlation is None else _symmetric(self.correlation)

    @property
    def in_windows(self) -> Vehicle:
        """The same car without effects that read what rows of state and inputs do not tell, such as the place on the lap."""
        both = zip(self.effects, self.active_effects, strict=True)
        return self.model_copy(update={"effects": tuple(entry for entry, effect in both if not effect.needs)})

    def with_nominal(self, nominal: Vector, std: Vector | None = None, correlation: Vector | None = None) -> Vehicle:
        """The same car with other nominal values and, if given, what is known of them.

        Args:
            nominal: ``(17,)``.
            std: standard deviations ``(17,)``; ``None``: what was known before.
            correlation: ``(17, 17)``; ``None``: with ``std`` they are independent.
        """
        if std is None:
            return self._known(nominal, self.std)
        return self._known(nominal, std, correlation=None if correlation is None else _rows(correlation))

    def _known(self, nominal: Iterable[float], std: Iterable[float | None], **others: Any) -> Vehicle:
        """The same car with other values and standard deviations, in the order of ``COEFFICIENTS``, and other fields."""
        coefficients = {
            name: c.model_copy(update={"nominal": float(value), "std": None if known is None else float(known)})
            for (name, c), value, known in zip(self.coefficients.items(), nominal, std, strict=True)
        }
        return self.model_copy(update={"coefficients": coefficients, **others})

    def known_before(self, laps: Collection[str]) -> Vehicle:
        """The car as it was known before it was calibrated on ``laps`` (fingerprints).

        Itself if it was not. A third of the laps is enough, as the rest may have been held out.
        """
        before = self.before
        if before is None or 3 * len({*before.laps} & {*laps}) < len(laps):
            return self
        std = [before.std[name] for name in COEFFICIENTS]
        nominal = [before.nominal[name] for name in COEFFICIENTS]
        return self._known(nominal, std, correlation=before.correlation, before=None)

    def was_calibrated_on(self, laps: Collection[str]) -> bool:
        """Whether it was calibrated on ``laps`` (fingerprints), on all of them and nothing else."""
        return self.before is not None and {*self.before.laps} == {*laps}

    def calibrated_on(self, laps: Collection[str], given: Vehicle) -> Vehicle:
        """The same car, calibrated on ``laps`` (fingerprints) from the file ``given``."""
        before = given.before or KnownBefore(
            laps=(),
            nominal=dict(zip(COEFFICIENTS, given.nominal.tolist(), strict=True)),
            std=dict(zip(COEFFICIENTS, given.std, strict=True)),
            correlation=given.correlation,
        )
        known = before.model_copy(update={"laps": tuple(sorted({*before.laps, *laps})[:_LAPS])})
        return self.model_copy(update={"before": known})

    def with_held_out(self, shares: Mapping[str, float]) -> Vehicle:
        """The same car, of which the last ``shares`` of recordings (fingerprints of their first rows) were left out.

        Of a recording that is known the lesser share counts: what the car was fitted to it stays fitted to.
        """
        lesser = {name: min(share, self.held_out.get(name, share)) for name, share in shares.items()}
        kept = {name: share for name, share in (self.held_out | lesser).items() if share > 0}
        return self.model_copy(update={"held_out": kept})

    def unmeasured(self) -> Vehicle:
        """The same car of which nothing but the bounds is known: values in their middle, no standard deviations."""
        middle, unknown = (self.lower + self.upper) / 2, [None] * len(COEFFICIENTS)
        return self._known(middle, unknown, correlation=None, before=None)

    def with_effect(self, name: str, parameters: dict[str, float]) -> Vehicle:
        """The same car with one more effect.

        Raises:
            ConfigurationError: no such effect, a parameter outside its bounds, or an effect that the car already has.
        """
        content = self.model_dump()
        content["effects"] = [*content["effects"], {"name": name, "parameters": parameters}]
        return configuration.validate(Vehicle, content, f"vehicle {self.name} with {name}")

    def with_effects(self, effects: Iterable[tuple[str, dict[str, float]]]) -> Vehicle:
        """The same car with more effects, each a name and its parameters; see :meth:`with_effect`."""
        return reduce(lambda vehicle, effect: vehicle.with_effect(*effect), effects, self)


def load_vehicle(name_or_path: str | Path) -> Vehicle:
    """Reads a vehicle file by shipped name or path.

    Raises:
        ConfigurationError: not found, malformed, incomplete or out of bounds.
    """
    return configuration.load(Vehicle, "vehicles", name_or_path)


def _symmetric(rows: Sequence[Sequence[float]]) -> Vector:
    """The correlation matrix of which ``rows`` are below the diagonal."""
    matrix = np.eye(len(rows))
    for k, row in enumerate(rows):
        matrix[k, :k] = matrix[:k, k] = row
    return matrix


def _rows(correlation: Vector) -> tuple[tuple[float, ...], ...]:
    """What is below the diagonal, rounded, and drawn to independence by so much that it stays positive definite."""
    return tuple(
        tuple(round((1.0 - _DRAWN) * float(value), 6) for value in row[:k]) for k, row in enumerate(correlation)
    )


def save_vehicle(vehicle: Vehicle, path: str | Path, comment: str = "") -> None:
    """Writes a vehicle file, atomically; ``comment`` goes to its head."""
    content: dict[str, Any] = vehicle.model_dump(mode="json")
    head = "".join(f"# {line}\n" for line in comment.splitlines())
    text = yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=110)
    with replacing(path) as aside:
        aside.write_text(head + text, encoding="utf-8")
