"""Which effects the data ask for: forward, exchanged, backward; and which of them the data cannot tell apart.

An information criterion finds what is worth a look. What is named has to predict parts of the drive that it was not fitted to
(:mod:`dynssm_ros.identification.search.confirmation`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TypeVar

import numpy as np

from dynssm_ros.identification import tuning
from dynssm_ros.identification.problem.car import CarEstimate, Values
from dynssm_ros.identification.problem.fit import Fit, IdentificationProblem
from dynssm_ros.identification.problem.recordings import CrossValidation
from dynssm_ros.identification.search.candidates import Candidate, Responses, ScoredCandidate, ScoreTest
from dynssm_ros.identification.search.confirmation import Confirmation, LeaveOneOut
from dynssm_ros.identification.search.size_search import CandidateStart, SizeSearch
from dynssm_ros.parallel import IN_TURN, Pool
from dynssm_ros.progress import OnProgress
from dynssm_ros.vehicle.effects import EFFECTS, LOCATION

Tried = TypeVar("Tried", bound=ScoredCandidate | CandidateStart)
Found = TypeVar("Found")


@dataclass(frozen=True)
class Refined:
    """A candidate fitted together with everything else.

    Attributes:
        candidate: what was added.
        fit: with it.
        improvement: decrease of twice the negative logarithm of likelihood and prior, by the errors' true freedom.
        delta_bic: what is left of it when its parameters are paid for.
        confirmation: what it improves on parts of the drive that were left out; ``None``: it was not worth a look.
        sure: by how many standard deviations one of its amplitudes is off neutral.
        least: how far off neutral it is in any car: one of another structure, or as the file has it.
        bounded: its amplitudes that are at a bound: the data ask for more than such a thing can be.
    """

    candidate: Candidate
    fit: Fit
    improvement: float
    delta_bic: float
    confirmation: Confirmation | None = None
    sure: float = 0.0
    least: float = 0.0
    bounded: tuple[str, ...] = ()

    @property
    def values(self) -> Values:
        """With which its effect was fitted."""
        return self.fit.car.effects[self.candidate.effect]

    @property
    def is_met(self) -> bool:
        """Whether it is on a side of neutral on which cars that can be driven have it; beside other recordings either."""
        name, directions = self.candidate.amplitudes[0], EFFECTS[self.candidate.effect].DIRECTIONS
        side = np.sign(self.values[name] - self.candidate.about[name].neutral)
        return bool(self.candidate.only_in) or not directions or float(side) in directions

    @property
    def strangeness(self) -> tuple[bool, bool, bool, bool]:
        """Whether it is at a bound, of single recordings, of places, on the side on which no car has it: in that order."""
        return bool(self.bounded), bool(self.candidate.only_in), self.candidate.by_place, not self.is_met

    @property
    def is_everywhere(self) -> bool:
        """Whether it is to act on a section of the lap and the section is as long as can be."""
        if not self.candidate.local:
            return False
        about, value = self.candidate.about[LOCATION[1]], self.values[LOCATION[1]]
        return about.at_bound(value) and value > about.neutral

    @property
    def beyond(self) -> float:
        """Share of its size that is more than any car has; below 0 where it is less."""
        if not self.least:
            return 1.0
        amplitudes = {name: self.values[name] for name in self.candidate.amplitudes}
        return 1.0 - self.least / max(EFFECTS[self.candidate.effect].amount(amplitudes), 1e-300)

    @property
    def is_asked_for(self) -> bool:
        """Whether the fitted laps ask for it: worth its parameters, sure, more than any car has, of a part of the lap."""
        sure = self.sure > tuning.SURE_STD and self.sure * self.beyond > tuning.BEYOND_STD
        return self.delta_bic > tuning.DECISIVE_DELTA_BIC and sure and not self.is_everywhere

    @property
    def pays(self) -> bool:
        """Whether it is asked for, and holds where it was not fitted."""
        return self.is_confirmed and self.is_asked_for

    @property
    def is_confirmed(self) -> bool:
        """Whether it holds on parts of the drive that were left out."""
        return self.confirmation is not None and self.confirmation.holds

    @property
    def confirmed_improvement(self) -> float:
        """Logarithm of the predictive likelihood by which it improves, nothing where it is not confirmed."""
        return self.confirmation.total if self.confirmation is not None and self.is_confirmed else 0.0


@dataclass
class Selection:
    """What was found.

    Attributes:
        base: the fit without effects.
        fit: the fit with all effects that the data ask for.
        chosen: those effects, the strongest first, each with its evidence against the fit without it.
        alternatives: for each of them, other effects that explain the data as well.
        tried: the best improvement of each effect on the first score test, by name.
        inflation: of the variance, by errors that hang together.
        unconfirmed: what would explain most of what is left and does not hold on parts that were left out; ``None``: nothing.
    """

    base: Fit
    fit: Fit
    chosen: list[Refined] = field(default_factory=list)
    alternatives: dict[str, list[str]] = field(default_factory=dict)
    tried: dict[str, float] = field(default_factory=dict)
    inflation: float = 1.0
    unconfirmed: Refined | None = None

    @property
    def candidates(self) -> tuple[Candidate, ...]:
        """What was chosen."""
        return tuple(one.candidate for one in self.chosen)


def _fitted_roughly(problem: IdentificationProblem, near: Fit, start: CandidateStart) -> Fit:
    """A candidate fitted together with all that ``near`` has."""
    return problem.fit(start.car, (*near.free, *start.candidate.free), near, rough=True)


@dataclass
class _Kept:
    """What was found with one weight of the data, so that it is fitted once, also where the search begins anew."""

    left_out: LeaveOneOut
    fits: dict[frozenset[Candidate], Fit]
    ranked: dict[frozenset[Candidate], list[Refined]] = field(default_factory=dict)
    starts: dict[tuple[object, ...], CandidateStart] = field(default_factory=dict)
    rough: dict[tuple[object, ...], Fit] = field(default_factory=dict)


class Search:
    """Selects effects by what they predict on parts of the data that were left out.

    Args:
        problem: the windows.
        car: where to start.
        found: the candidates.
        left_out, on_progress, pool: see :func:`~dynssm_ros.identification.search.integrator.search_causes`.
        base: the nominal car fitted to the windows, if that is known already.
    """

    def __init__(
        self,
        problem: IdentificationProblem,
        car: CarEstimate,
        found: Sequence[Candidate],
        left_out: CrossValidation,
        *,
        on_progress: OnProgress = lambda words: None,
        pool: Pool = IN_TURN,
        base: Fit | None = None,
    ) -> None:
        self._problem, self.found, self._report = problem, list(found), on_progress
        self._known, self._folds, self._pool = car.as_known, left_out, pool
        self._price = np.log(3.0 * problem.windows.steps * len(problem.windows))
        on_progress("recalibrating the nominal car")
        self.base = problem.temper(problem.recalibrated(car) if base is None else base)
        self._tempering = problem.tempering
        self._by_tempering: dict[float, _Kept] = {}
        self.responses = Responses(problem, self.base.car, self.base.errors)
        """Of the library, beside the recalibrated car."""
        self.tried: dict[str, float] = {}
        self._kept = self._weigh(self._tempering)

    def _weigh(self, tempering: float) -> _Kept:
        """Weighs the data; what was found with these weights before is at hand."""
        self._problem.tempering = tempering
        if tempering not in self._by_tempering:
            base = self.base if tempering == self._tempering else self._problem.refit(self.base)
            left_out = LeaveOneOut(self._problem, self._folds, self._pool)
            self._by_tempering[tempering] = _Kept(left_out, {frozenset(): base})
        return self._by_tempering[tempering]

    def run(self, start: Fit | None = None) -> Selection:
        """Forward while it pays; then each effect is exchanged against all others, or dropped.

        Args:
            start: a fit of a like problem, whose effects are taken as chosen.
        """
        chosen = self._taken_over(start)
        while len(chosen) < tuning.MAX_CAUSES:
            best = self._best(tuple(chosen))
            if best is None:
                break
            chosen.append(best.candidate)
            self._exchange(chosen)
            self._temper(tuple(chosen))
        self._prefer_ordinary(chosen)
        return self.eliminated(tuple(chosen))

    def reject(self, effect: str) -> Selection:
        """Selects anew without an effect."""
        self.found = [candidate for candidate in self.found if candidate.effect != effect]
        self._kept = self._weigh(self._tempering)
        for kept in self._by_tempering.values():
            kept.ranked.clear()  # another candidate may take the place
        return self.run()

    def eliminated(self, chosen: tuple[Candidate, ...]) -> Selection:
        """Backward elimination: the weakest of ``chosen`` is dropped while it does not pay beside the others."""
        while True:
            found = [self._confirm(self._without(chosen, c), self._against(chosen, c)) for c in chosen]
            weakest = min(found, key=lambda r: (r.confirmed_improvement, r.delta_bic), default=None)
            if weakest is None or weakest.pays:
                break
            chosen = tuple(c for c in chosen if c != weakest.candidate)
        fit = self.fit(chosen) if chosen else self.base
        found = sorted(found, key=lambda r: -r.confirmed_improvement)
        others = {r.candidate.effect: self._alternatives(chosen, r.candidate) for r in found}
        doubtful = self._unconfirmed(chosen, fit)
        return Selection(self.base, fit, found, others, self.tried, self._problem.inflation(fit), doubtful)

    def _unconfirmed(self, chosen: tuple[Candidate, ...], fit: Fit) -> Refined | None:
        """The best by the criterion of those that were tried beside ``chosen``, if it is large, sure, and not confirmed."""
        best = next(iter(self._kept.ranked.get(frozenset(chosen), [])), None)
        if best is None or best.delta_bic <= tuning.DECISIVE_DELTA_BIC:
            return None
        tried = self._confirm(fit, best)
        return tried if tried.is_asked_for and not tried.is_confirmed else None

    def leave_out(self, selection: Selection, one: Refined) -> Fit:
        """The fit of everything chosen but ``one``."""
        return self._without(selection.candidates, one.candidate)

    def fit(self, chosen: tuple[Candidate, ...]) -> Fit:
        """All of ``chosen`` together, linearised anew."""
        key = frozenset(chosen)
        if key not in self._kept.fits:
            starts = [r.fit for c in chosen for r in self._kept.ranked.get(key - {c}, []) if r.candidate == c]
            self._kept.fits[key] = self._problem.again(min(starts, key=lambda fit: fit.objective))
        return self._kept.fits[key]

    def ranked(self, before: tuple[Candidate, ...]) -> list[Refined]:
        """The most promising candidates beside ``before``, fitted, the best first."""
        key = frozenset(before)
        if key in self._kept.ranked:
            return self._kept.ranked[key]
        fit = self.fit(before)
        refined = self._refined(before, fit, self._starts(before, fit))
        share, apart = tuning.NEAR_BEST_SHARE, tuning.AMBIGUITY_DELTA_BIC
        close = max([-apart, *(share * r.delta_bic - 2 * apart for r in refined)])
        rough = [r for r in refined if r.delta_bic > close and key | {r.candidate} not in self._kept.fits]
        finished = self._pool.map(self._problem.again, [r.fit for r in rough])
        self._kept.fits |= {key | {r.candidate}: done for r, done in zip(rough, finished, strict=True)}
        refined = [self._against((*before, r.candidate), r.candidate) if r.delta_bic > close else r for r in refined]
        self._kept.ranked[key] = sorted(refined, key=lambda r: -r.delta_bic)
        return self._kept.ranked[key]

    def _starts(self, before: tuple[Candidate, ...], fit: Fit) -> list[CandidateStart]:
        """Where to fit the most promising candidates beside ``before`` from, by a score test and in several sizes."""
        taken = {c.effect for c in before}
        self._report("trying all effects" + (f" beside {', '.join(taken)}" if taken else ""))
        score_test = ScoreTest(self._problem, fit, self.responses)
        scored = list(score_test.try_all([c for c in self.found if c.effect not in taken]))
        best: dict[str, ScoredCandidate] = {}
        for each in sorted(scored, key=self._expected_delta_bic, reverse=True):
            best.setdefault(each.candidate.effect, each)
        if not before:
            self.tried = {name: each.improvement for name, each in best.items()}
        shortlist = [each for each in best.values() if self._expected_delta_bic(each) >= -self._price]
        some, near = self._problem.part(fit, max(1, len(self._problem.windows) // tuning.SHORTLIST_WINDOWS))
        trial = SizeSearch(some, near, self._known, self._price, self._problem.tempering)
        starts = self._once(self._kept.starts, before, shortlist[: tuning.SHORTLIST], trial.start)
        starts.sort(key=lambda start: start.expected_delta_bic, reverse=True)
        least = max([-self._price, *(tuning.SHORTLIST_SHARE * start.expected_delta_bic for start in starts[:1])])
        return [start for start in starts[: tuning.REFINED] if start.expected_delta_bic >= least]

    def _best(self, before: tuple[Candidate, ...]) -> Refined | None:
        """The candidate that improves most; of those that cannot be told from it the most ordinary one.

        That is one within its bounds, then one that all recordings have, then one that acts at all places, then one as it is
        met in real cars.
        """
        found = sorted(self._confirmed(before), key=lambda r: -r.confirmed_improvement)
        alike = [r for r in found if r is found[0] or self._kept.left_out.compare(r.fit, found[0].fit).alike]
        return min(alike, key=lambda r: r.strangeness, default=None)

    def _taken_over(self, start: Fit | None) -> list[Candidate]:
        """The candidates of another problem's fit, fitted here."""
        if start is None or not start.free:
            return []
        values = {effect: start.car.effects[effect] for effect, _ in start.free}
        chosen = [
            Candidate(
                name,
                tuple(p for effect, p in start.free if effect == name),
                start.car.only_in.get(name, ()),
                tuple((p, values[name][p]) for p in EFFECTS[name].READ_OFF),
            )
            for name in values
        ]
        self._kept.fits[frozenset(chosen)] = self._problem.fit(start.car, start.free)
        self._temper(tuple(chosen))
        return chosen

    def _confirmed(self, before: tuple[Candidate, ...]) -> list[Refined]:
        """The candidates beside ``before`` that hold where they were not fitted."""
        without = self.fit(before)
        ranked = self.ranked(before)
        least = max([tuning.DECISIVE_DELTA_BIC, *(tuning.LOOK_SHARE * r.delta_bic for r in ranked[:1])])
        return [r for r in (self._confirm(without, r) for r in ranked if r.delta_bic > least) if r.pays]

    def _confirm(self, without: Fit, refined: Refined) -> Refined:
        self._report(f"leaving parts out: {refined.candidate.effect}")
        confirmation = self._kept.left_out.compare(without, refined.fit)
        fit, candidate = refined.fit, refined.candidate
        bounded = tuple(name for name in candidate.amplitudes if candidate.about[name].at_bound(refined.values[name]))
        off = np.abs(fit.position) / np.sqrt(np.diag(self._problem.covariance(fit)))
        own = [off[len(fit.car.moved) + fit.free.index((candidate.effect, name))] for name in candidate.amplitudes]
        return replace(refined, confirmation=confirmation, sure=float(max(own)), bounded=bounded)

    def _temper(self, chosen: tuple[Candidate, ...]) -> None:
        """Weighs the data anew, as the errors hang together now that ``chosen`` are known."""
        fit = self.fit(chosen)
        inflation = self._problem.inflation(fit)
        if abs(np.log(inflation / self._problem.tempering)) >= tuning.TEMPERING_CHANGE:
            self._kept = self._weigh(inflation)
            if frozenset(chosen) not in self._kept.fits:
                self._kept.fits[frozenset(chosen)] = self._problem.refit(fit)

    def _expected_delta_bic(self, scored: ScoredCandidate) -> float:
        return float(scored.improvement / self._problem.tempering - self._price * scored.candidate.cost)

    def _refined(self, before: tuple[Candidate, ...], fit: Fit, starts: Sequence[CandidateStart]) -> list[Refined]:
        if starts:
            self._report(f"fitting {', '.join(start.candidate.effect for start in starts)}")
        fits = self._once(self._kept.rough, before, starts, partial(_fitted_roughly, self._problem, fit))
        return [self._judge(fit, found, start.candidate) for found, start in zip(fits, starts, strict=True)]

    def _once(
        self,
        known: dict[tuple[object, ...], Found],
        before: tuple[Candidate, ...],
        tried: Sequence[Tried],
        work: Callable[[Tried], Found],
    ) -> list[Found]:
        """What ``work`` makes of each candidate beside ``before``, made once."""
        keys = [(frozenset(before), one.candidate, *sorted(one.values.items())) for one in tried]
        new = {key: one for key, one in zip(keys, tried, strict=True) if key not in known}
        known.update(zip(new, self._pool.map(work, list(new.values())), strict=True))
        return [known[key] for key in keys]

    def _judge(self, without: Fit, fit: Fit, candidate: Candidate) -> Refined:
        own = self._problem.inflation(fit, len(fit.free) - len(without.free))
        improvement = (without.objective - fit.objective) * min(1.0, self._problem.tempering / own)
        delta = improvement - self._price * candidate.cost
        least = 0.0 if candidate.only_in else fit.car.least(candidate.effect, self._problem.windows.steered)
        return Refined(candidate, fit, improvement, delta, least=least)

    def _against(self, chosen: tuple[Candidate, ...], one: Candidate) -> Refined:
        """What ``one`` is worth among ``chosen``."""
        return self._judge(self._without(chosen, one), self.fit(chosen), one)

    def _without(self, chosen: tuple[Candidate, ...], one: Candidate) -> Fit:
        """The fit of ``chosen`` but ``one``, from that of all."""
        key = frozenset(chosen) - {one}
        if key not in self._kept.fits:
            fit = self.fit(chosen)
            free = tuple(pair for pair in fit.free if pair[0] != one.effect)
            self._kept.fits[key] = self._problem.fit(fit.car.without(one.effect), free, fit)
        return self._kept.fits[key]

    def _exchange(self, chosen: list[Candidate]) -> None:
        """Replaces earlier effects by others that go better with the later ones."""
        for one in chosen[:-1]:
            rest = tuple(c for c in chosen if c != one)
            self._without(tuple(chosen), one)
            ranked = self.ranked(rest)
            if ranked and ranked[0].candidate.effect != one.effect:
                here = next((r for r in ranked if r.candidate == one), None)
                if here is None or ranked[0].delta_bic > here.delta_bic + tuning.AMBIGUITY_DELTA_BIC:
                    chosen[:] = [*rest, ranked[0].candidate]
                    return

    def _prefer_ordinary(self, chosen: list[Candidate]) -> None:
        """Replaces what is strange by what cannot be told from it beside the others and is less so."""
        for k, one in enumerate(chosen):
            rest, all_of_them = (*chosen[:k], *chosen[k + 1 :]), tuple(chosen)
            here = self._confirm(self._without(all_of_them, one), self._against(all_of_them, one))
            best = self._best(rest) if any(here.strangeness) else None
            if best is not None and best.strangeness < here.strangeness:
                chosen[k] = best.candidate

    def _alternatives(self, chosen: tuple[Candidate, ...], one: Candidate) -> list[str]:
        rest = tuple(c for c in chosen if c != one)
        fit = self.fit(chosen)
        others = [r for r in self._confirmed(rest) if r.candidate.effect != one.effect]
        return [r.candidate.effect for r in others if self._kept.left_out.compare(r.fit, fit).alike]
