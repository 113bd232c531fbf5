"""What may be wrong: every effect of the library in every variant, and how well each would explain what is left.

All of them are tried at once on linearised errors, with the nominal values free to move as far as is known of them.
A local effect's response is the global response times a window over the lap, so that one simulation serves all positions.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import numpy as np

from dynssm_ros.arrays import Vector
from dynssm_ros.identification import tuning
from dynssm_ros.identification.problem.car import CarEstimate, Values
from dynssm_ros.identification.problem.fit import Fit, IdentificationProblem, unit
from dynssm_ros.identification.problem.levels import ONE_RECORDING, Levels
from dynssm_ros.identification.problem.windows import step_errors
from dynssm_ros.vehicle.effects import EFFECTS, LOCATION
from dynssm_ros.vehicle.effects.base import LAP, Parameter, section
from dynssm_ros.vehicle.effects.step_errors import StepErrors

_MIDDLE, _SMALL = tuning.SIZE_GRID[1], tuning.SIZE_GRID[3]


@dataclass(frozen=True)
class Candidate:
    """An effect with the parameters to fit.

    Attributes:
        effect: its name.
        parameters: to be fitted together.
        only_in: numbers of the recordings in which it acts; empty: in all.
        held: parameters that were read off the errors of single steps, with their values; no fit moves them.
    """

    effect: str
    parameters: tuple[str, ...]
    only_in: tuple[int, ...] = ()
    held: tuple[tuple[str, float], ...] = ()

    @property
    def about(self) -> Mapping[str, Parameter]:
        """All parameters of the effect."""
        return EFFECTS[self.effect].PARAMETERS

    @property
    def amplitudes(self) -> tuple[str, ...]:
        """The parameters that say how much."""
        return tuple(p for p in self.parameters if not self.about[p].shape)

    @property
    def shapes(self) -> tuple[str, ...]:
        """The parameters that say where or how."""
        return tuple(p for p in self.parameters if self.about[p].shape)

    @property
    def local(self) -> bool:
        """Whether it acts on a section of the lap only."""
        return any(self.about[p].local for p in self.parameters)

    @property
    def by_place(self) -> bool:
        """Whether it depends on the place on the lap."""
        return EFFECTS[self.effect].acts_by_place(self.parameters)

    @property
    def free(self) -> tuple[tuple[str, str], ...]:
        """For a fit."""
        return tuple((self.effect, p) for p in self.parameters)

    @property
    def cost(self) -> int:
        """How many parameters it has to pay for: those that are fitted or searched for in the errors."""
        return len(self.parameters) + len(self.held) - len(EFFECTS[self.effect].GIVEN)


@dataclass(frozen=True)
class ScoredCandidate:
    """How much a candidate with some values would improve the fit: decrease of the squared error in units of the noise."""

    candidate: Candidate
    values: Values
    improvement: float


def candidates(
    problem: IdentificationProblem,
    car: CarEstimate,
    excluded: Collection[str] = (),
    levels: Levels = ONE_RECORDING,
) -> tuple[list[Candidate], dict[str, str]]:
    """The effects that can be tried, and for those that cannot, why.

    Args:
        problem: the windows.
        car: as the vehicle file has it.
        excluded: effects that are not tried.
        levels: which recordings may have an effect that the others do not have. What acts at a place acts on one road alone.
    """
    found, left = [], {}
    have = set(problem.windows.data.context)
    steps: StepErrors | None = None
    for name, effect in EFFECTS.items():
        if name in excluded:
            continue
        reason = effect.unusable(car.vehicle.constants)
        if reason is not None:
            left[name] = reason
            continue
        if effect.EFFECT_STATES and any(entry.name == name for entry in car.vehicle.effects):
            left[name] = "the vehicle file has it already"
            continue
        usable = [v for v in effect.variants() if set(effect.signals(v)) <= have]
        if set(LAP) <= have:
            usable = [v for v in usable if v not in effect.OPEN_ROAD]
        held: dict[str, float] | None = {}
        if effect.READ_OFF and usable:
            steps = steps or step_errors(problem.windows, car)
            held = effect.read_off(steps)
        if held is None:
            continue  # nothing asks for it
        at = tuple(held.items())
        tried = [Candidate(name, variant, group, at) for group in ((), *levels.groups) for variant in usable]
        found += [one for one in tried if levels.has_one_road(one.only_in) or not one.by_place]
        if not usable:
            left[name] = f"the recording has no {', '.join(s for s in effect.signals() if s not in have)}"
    return found, left


class Response(NamedTuple):
    """What a parameter does to the errors, per unit, when it is as large as ``size`` (units, signed)."""

    size: float
    errors: Vector


class Responses:
    """What each parameter of the library does to the errors, simulated once for a car and reused.

    Many effects do not grow like their size: a lag, say, has hardly any slope where it begins. Their responses are those
    to several sizes.
    """

    def __init__(self, problem: IdentificationProblem, car: CarEstimate, errors: Vector) -> None:
        self._problem, self._car, self._errors = problem, car, errors
        self._known: dict[tuple[str, str, bool, tuple[tuple[str, float], ...]], list[Response]] = {}
        windows = problem.windows
        if "s" in windows.data.context:
            lap = np.stack([windows.context(k)["s"] for k in range(windows.steps)])
            self._lap = lap / windows.context(0)["lap_length"]

    def of(self, candidate: Candidate, parameter: str, shape: Values) -> tuple[list[Response], Vector | None]:
        """The responses, and the share of them that each window sees, if not all, shape ``(W,)``.

        A response to one size alone serves for all.
        """
        place = {k: v for k, v in shape.items() if k in LOCATION}
        form = {k: v for k, v in shape.items() if k not in place}
        local = bool(place) and candidate.about[parameter].local
        key = (candidate.effect, parameter, local, tuple(sorted(form.items())))
        if key not in self._known:
            self._known[key] = self._simulated(candidate, parameter, form, local)
        share = np.asarray(section(np, self._lap, **place)).mean(axis=0) if local else None
        if candidate.only_in:
            acts = np.isin(self._problem.windows.number, candidate.only_in)
            share = acts if share is None else acts * share
        return self._known[key], share

    def _simulated(self, candidate: Candidate, parameter: str, form: Values, local: bool) -> list[Response]:
        """To a size on either side where it acts at a place; else to one size, or to all if it is not linear."""
        if candidate.local:
            return self._at(candidate.effect, parameter, form, (_MIDDLE, -_MIDDLE), local)
        found = self._at(candidate.effect, parameter, form, (_MIDDLE, _SMALL), local)
        largest = max(np.linalg.norm(response.errors) for response in found)
        apart = max(np.linalg.norm(response.errors - found[0].errors) for response in found)
        if apart > tuning.NONLINEARITY * largest:
            return self._at(candidate.effect, parameter, form, tuning.BOTH_SIDES, local)
        return found[:1]

    def _at(self, effect: str, parameter: str, form: Values, sizes: Sequence[float], local: bool) -> list[Response]:
        """To those sizes that the parameter can have; at least one."""
        about, one = EFFECTS[effect].PARAMETERS[parameter], unit(effect, parameter)
        start = dict(self._car.effects.get(effect, {})) | form
        steps = steps_off(effect, parameter, sizes) or [-sizes[0] * one]
        cars = [self._car.with_effect(effect, start | {parameter: about.neutral + step}) for step in steps]
        everywhere = {"s": 0.5, "lap_length": 1.0} if local else None
        changes = self._problem.errors_of(cars, everywhere) - self._errors
        return [Response(step / one, change * one / step) for step, change in zip(steps, changes, strict=True)]


def steps_off(effect: str, parameter: str, sizes: Sequence[float]) -> list[float]:
    """How far off neutral a parameter is at ``sizes`` (units, signed), within its bounds and without those at neutral."""
    about, one = EFFECTS[effect].PARAMETERS[parameter], unit(effect, parameter)
    wanted = (float(np.clip(about.neutral + size * one, about.lower, about.upper)) - about.neutral for size in sizes)
    return sorted({step for step in wanted if step != 0.0})


class _Whitened(NamedTuple):
    """A response as the errors see it, window by window."""

    white: Vector
    """Whitened, ``(W, 3 K)``."""
    taken: Vector
    """Products with the basis of what the fitted values can take up, ``(W, P)``."""
    along: Vector
    """Products with the errors, ``(W,)``."""


class ScoreTest:
    """Tries candidates on what a fit leaves.

    Args:
        problem: the windows.
        fit: of the car so far, with its derivatives.
        responses: of the library, which may be those of a car nearby.
    """

    def __init__(self, problem: IdentificationProblem, fit: Fit, responses: Responses) -> None:
        self._fit, self._responses = fit, responses
        self._columns: dict[int, _Whitened] = {}
        self._products: dict[tuple[int, int], Vector] = {}
        weighed, J, self._root = fit.noise.robust(fit.errors, fit.white_jacobian)
        # what is known of the values as further rows, so that projecting is plain least squares
        known = np.sqrt(problem.tempering) * np.linalg.cholesky(problem.prior_precision(fit.position)).T
        tall = np.concatenate([J.reshape(-1, J.shape[2]), known])
        basis = np.linalg.qr(tall)[0]
        left = np.concatenate([weighed.ravel(), known @ fit.position])
        left = left - basis @ (basis.T @ left)
        rows = J.shape[0] * J.shape[1]
        self._basis = basis[:rows].reshape(*J.shape[:2], -1)
        self._left = left[:rows].reshape(J.shape[:2])

    def try_all(self, found: list[Candidate]) -> Iterator[ScoredCandidate]:
        """The best place, form and size of each candidate that shows at all."""
        for candidate in found:
            tried = [candidate.about[p].tried for p in candidate.shapes]
            scored = (
                self._try(candidate, dict(candidate.held) | dict(zip(candidate.shapes, shape, strict=True)))
                for shape in product(*tried)
            )
            best = max(filter(None, scored), key=lambda one: one.improvement, default=None)
            if best is not None:
                yield best

    def _try(self, candidate: Candidate, shape: Values) -> ScoredCandidate | None:
        """The best size of a candidate whose shape is given; ``None`` where nothing of it shows."""
        responses = [self._responses.of(candidate, p, shape) for p in candidate.amplitudes]
        nonlinear = np.array([len(known) > 1 for known, _ in responses]) & (not candidate.local)
        sizes = sorted({abs(r.size) for (known, _), b in zip(responses, nonlinear, strict=True) if b for r in known})
        best: tuple[float, Vector] | None = None
        for size in sizes or [_MIDDLE]:
            signs = np.ones(len(responses))
            for _ in range(2):
                gram, along, seen = self._normal(
                    [_nearest(known, sign * size).errors for (known, _), sign in zip(responses, signs, strict=True)],
                    [share for _, share in responses],
                )
                if not seen:
                    break
                amounts = np.linalg.lstsq(gram, along, rcond=1e-10)[0]
                if (np.sign(amounts) == signs).all():
                    break
                signs = np.where(amounts < 0, -1.0, 1.0)
            if not seen:
                continue
            # the slope serves for all: with nominal values that make up for it, it goes on
            if sizes and size > sizes[0]:
                lower, upper = tuning.SIZE_REACH
                limited = np.sign(amounts) * np.clip(np.abs(amounts), size * lower, size * upper)
                amounts = np.where(nonlinear, limited, amounts)
            improvement = float(2 * along @ amounts - amounts @ gram @ amounts)
            if best is None or improvement > best[0]:
                best = improvement, np.asarray(amounts, dtype=np.float64)
        if best is None:
            return None
        values = dict(shape)
        for parameter, amount in zip(candidate.amplitudes, best[1], strict=True):
            about = candidate.about[parameter]
            wanted = about.neutral + float(amount) * unit(candidate.effect, parameter)
            margin = tuning.BOUND_MARGIN * (about.upper - about.lower)
            lowest = about.lower + margin * (about.lower < about.neutral)
            values[parameter] = float(np.clip(wanted, lowest, about.upper - margin))
        return ScoredCandidate(candidate, values, best[0])

    def _normal(self, raw: list[Vector], shares: list[Vector | None]) -> tuple[Vector, Vector, bool]:
        """Normal equations of the amounts, with what the fitted values can take up projected out.

        And whether there is anything to be seen: a unit of each, if they all went on like this, changes what was
        measured, and not only as they do.
        """
        columns = [self._column(r) for r in raw]
        weight = [np.ones(len(self._left)) if s is None else s for s in shares]
        pairs = list(zip(raw, weight, strict=True))
        taken = np.stack([w @ c.taken for c, w in zip(columns, weight, strict=True)])
        whole = np.array([[(w * v) @ self._product(a, b) for b, v in pairs] for a, w in pairs])
        gram = whole - taken @ taken.T
        along = -np.array([w @ c.along for c, w in zip(columns, weight, strict=True)])
        size, left = np.diag(whole), np.diag(gram)
        visible = (size > tuning.VISIBLE_NOISE_SHARE**2).all() and (left > tuning.COLUMN_LEFT**2 * size).any()
        return gram, along, bool(visible)

    def _column(self, raw: Vector) -> _Whitened:
        if id(raw) not in self._columns:
            white = self._fit.noise.whiten(raw) * self._root
            taken = np.einsum("wn,wnp->wp", white, self._basis)
            self._columns[id(raw)] = _Whitened(white, taken, np.einsum("wn,wn->w", white, self._left))
        return self._columns[id(raw)]

    def _product(self, a: Vector, b: Vector) -> Vector:
        """Products of two responses, shape ``(W,)``."""
        key = (min(id(a), id(b)), max(id(a), id(b)))
        if key not in self._products:
            self._products[key] = np.einsum("wn,wn->w", self._column(a).white, self._column(b).white)
        return self._products[key]


def _nearest(known: list[Response], size: float) -> Response:
    """The response to the size nearest to ``size``; to the other sign where there is none."""
    alike = [r for r in known if r.size * size > 0] or known
    return min(alike, key=lambda r: abs(np.log(abs(r.size / size))))
