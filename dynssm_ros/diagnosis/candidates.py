"""What may be wrong: every effect of the library in every variant, and how well each would explain what is left.

All of them are tried at once on linearised errors, with the nominal values free to move as far as is known of them.
What an effect does somewhere on the lap is what it does everywhere, weighed with where it is, so that one simulation
serves for all places.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product

import numpy as np
import numpy.typing as npt

from dynssm_ros.diagnosis.car import Car, Values
from dynssm_ros.diagnosis.noise import weights
from dynssm_ros.diagnosis.study import Fit, Study, unit
from dynssm_ros.vehicle.effects import EFFECTS
from dynssm_ros.vehicle.effects.base import LAP, section

Vector = npt.NDArray[np.float64]

_SHAPES: dict[str, tuple[float, ...]] = {
    "centre": tuple(np.linspace(0.0, 1.0, 32, endpoint=False).tolist()),
    "length": (0.03, 0.06, 0.12, 0.25),
    "balance": (0.2, 0.45, 0.7),
    "side": (1.0, 3.0, 10.0, 30.0),
    "arm": (-0.4, 0.4),
}  # tried for the parameters that say where or how an effect acts
_SMALL = 0.05  # of a unit, for slopes
_LEAST = 1e-6  # share of a column that the nominal values must leave for the effect to be seen


@dataclass(frozen=True)
class Candidate:
    """An effect with the parameters to fit.

    Attributes:
        effect: its name.
        parameters: to be fitted together.
    """

    effect: str
    parameters: tuple[str, ...]

    @property
    def amplitudes(self) -> tuple[str, ...]:
        """The parameters that say how much."""
        return tuple(p for p in self.parameters if not EFFECTS[self.effect].PARAMETERS[p].shape)

    @property
    def shapes(self) -> tuple[str, ...]:
        """The parameters that say where or how."""
        return tuple(p for p in self.parameters if EFFECTS[self.effect].PARAMETERS[p].shape)

    @property
    def free(self) -> tuple[tuple[str, str], ...]:
        """For a fit."""
        return tuple((self.effect, p) for p in self.parameters)


@dataclass(frozen=True)
class Prospect:
    """How much a candidate would gain, by linearised errors.

    Attributes:
        candidate: what was tried.
        values: with which parameters.
        gain: decrease of the squared error in units of the noise.
        seen: share of what the effect does that the nominal values cannot take up, 0 to 1.
        direction: what is left of its (whitened) derivative, of unit length, shape ``(W * 3 K,)``.
    """

    candidate: Candidate
    values: Values
    gain: float
    seen: float
    direction: Vector


def candidates(study: Study, car: Car) -> tuple[list[Candidate], dict[str, str]]:
    """The effects that can be tried, and for those that cannot, why."""
    found, left = [], {}
    have = set(study.windows.data.context)
    for name, effect in EFFECTS.items():
        reason = effect.unusable(car.vehicle.constants)
        if reason is not None:
            left[name] = reason
            continue
        if effect.MEMORY and any(entry.name == name for entry in car.vehicle.effects):
            left[name] = "the vehicle file has it already"
            continue
        usable = [v for v in effect.variants() if set(effect.signals(v)) <= have]
        found += [Candidate(name, variant) for variant in usable]
        if not usable:
            left[name] = f"the recording has no {', '.join(s for s in effect.signals() if s not in have)}"
    return found, left


class Responses:
    """What each parameter of the library does to the errors, simulated once for a car and reused."""

    def __init__(self, study: Study, car: Car, errors: Vector) -> None:
        self._study, self._car, self._errors = study, car, errors
        self._known: dict[tuple[str, str, tuple[tuple[str, float], ...]], Vector] = {}
        windows = study.windows
        if "s" in windows.data.context:
            lap = np.stack([windows.context(k)["s"] for k in range(windows.steps)])
            self._lap = lap / windows.context(0)["lap_length"]

    def column(self, effect: str, parameter: str, shape: Values) -> tuple[Vector, Vector | None]:
        """Errors per unit of ``parameter``, shape ``(W, 3 K)``, and the share of it that each window sees, if not all."""
        place = {k: v for k, v in shape.items() if k in ("centre", "length")}
        form = {k: v for k, v in shape.items() if k not in place}
        about = EFFECTS[effect].PARAMETERS[parameter]
        local = bool(place) and about.context == LAP and parameter in ("factor", "section")
        key = (effect, parameter, tuple(sorted(form.items())))
        if key not in self._known:
            everywhere = {"s": 0.5, "lap_length": 1.0} if local else None
            slope, secant = (self._difference(effect, parameter, form, part, everywhere) for part in (_SMALL, 1.0))
            # what grows faster than its size, as combined slip does, has no slope where it begins
            steep = np.linalg.norm(secant) > 2 * np.linalg.norm(slope)
            self._known[key] = secant if steep else slope
        share = np.asarray(section(np, self._lap, **place)).mean(axis=0) if local else None
        return self._known[key], share

    def _difference(
        self, effect: str, parameter: str, form: Values, part: float, everywhere: dict[str, float] | None
    ) -> Vector:
        """Change of the errors by ``part`` of a unit of ``parameter``, per unit."""
        about = EFFECTS[effect].PARAMETERS[parameter]
        step = part * unit(effect, parameter) * (1 if about.upper > about.neutral else -1)
        values = dict(self._car.effects.get(effect, {})) | form | {parameter: about.neutral + step}
        change = self._study.errors(self._car.with_effect(effect, values), everywhere) - self._errors
        return np.asarray(change * unit(effect, parameter) / step)


class Scan:
    """Tries candidates on what a fit leaves.

    Args:
        study: the windows.
        fit: of the car so far, with its derivatives.
        responses: of the library, which may be those of a car nearby.
    """

    def __init__(self, study: Study, fit: Fit, responses: Responses) -> None:
        self._fit, self._responses = fit, responses
        self._white: dict[int, Vector] = {}
        white = fit.noise.whiten(fit.errors)
        self._root = np.sqrt(weights(white))
        J = (fit.noise.whiten(fit.jacobian) * self._root[:, None, None]).reshape(-1, fit.jacobian.shape[2])
        known = study.known_before(fit.position)
        # what is known of the values as further rows, so that projecting is plain least squares
        tall = np.concatenate([J, np.diag(np.sqrt(known))])
        self._basis = np.linalg.qr(tall)[0]
        self._rows = len(J)
        self._left = self._project(
            np.concatenate([(white * self._root[:, None]).ravel(), np.sqrt(known) * fit.position])[:, None]
        )[:, 0]

    def try_all(self, found: list[Candidate]) -> Iterator[Prospect]:
        """The best place and form of each candidate that shows at all."""
        for candidate in found:
            best = None
            for combination in product(*(_SHAPES[p] for p in candidate.shapes)):
                prospect = self._try(candidate, dict(zip(candidate.shapes, combination, strict=True)))
                if prospect is not None and (best is None or prospect.gain > best.gain):
                    best = prospect
            if best is not None:
                yield best

    def _try(self, candidate: Candidate, shape: Values) -> Prospect | None:
        columns = np.zeros((len(self._basis), len(candidate.amplitudes)))
        for k, parameter in enumerate(candidate.amplitudes):
            columns[: self._rows, k] = self._column(candidate.effect, parameter, shape)
        size = np.linalg.norm(columns, axis=0)
        if not (size > 0.3).all():  # a tenth of its range changes nothing that could be measured
            return None
        apart = self._project(columns)
        seen = np.linalg.norm(apart, axis=0) / size
        if seen.max() < _LEAST:
            return None
        amounts, *_ = np.linalg.lstsq(apart, -self._left, rcond=1e-6)
        change = apart @ amounts
        gain = float(self._left @ self._left - (self._left + change) @ (self._left + change))
        values = dict(shape)
        for parameter, amount in zip(candidate.amplitudes, amounts, strict=True):
            about = EFFECTS[candidate.effect].PARAMETERS[parameter]
            wanted = about.neutral + float(amount) * unit(candidate.effect, parameter)
            margin = 0.02 * (about.upper - about.lower)
            values[parameter] = float(
                np.clip(wanted, about.lower + margin * (about.lower < about.neutral), about.upper)
            )
        length = float(np.linalg.norm(change))
        return Prospect(candidate, values, gain, float(seen.max()), change / max(length, 1e-300))

    def _column(self, effect: str, parameter: str, shape: Values) -> Vector:
        """What a parameter does, whitened, shape ``(W * 3 K,)``."""
        raw, share = self._responses.column(effect, parameter, shape)
        if id(raw) not in self._white:
            self._white[id(raw)] = self._fit.noise.whiten(raw) * self._root[:, None]
        white = self._white[id(raw)]
        return (white if share is None else white * share[:, None]).ravel()

    def _project(self, columns: Vector) -> Vector:
        """What the fitted values cannot take up."""
        return columns - self._basis @ (self._basis.T @ columns)
