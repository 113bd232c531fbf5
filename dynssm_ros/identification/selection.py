"""Which effects the data ask for: forward, exchanged, backward; and which of them the data cannot tell apart."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from dynssm_ros.identification.candidates import Candidate, Responses, ScoredCandidate, ScoreTest
from dynssm_ros.identification.car import CarEstimate
from dynssm_ros.identification.noise import weights
from dynssm_ros.identification.problem import Fit, IdentificationProblem, position
from dynssm_ros.progress import OnProgress
from dynssm_ros.vehicle.effects import EFFECTS

DECISIVE_DELTA_BIC = 10.0  # difference in the information criterion that counts as very strong (Kass and Raftery 1995)
AMBIGUITY_DELTA_BIC = 6.0  # candidates within this delta BIC are reported as alternatives
_SHORTLIST = 9  # candidates of which several sizes are tried in each round
_SHORTLIST_WINDOWS = 150  # windows on which they are tried
_REFINED = 4  # of them are fitted in full
_SHORTLIST_SHARE = 0.15  # of the best scored, that another one must reach to be fitted in full
_NEAR_BEST_SHARE = 0.9  # of the best evidence, near which others are fitted to the end as well
_MAX_CAUSES = 4  # effects
_FOLDS = 5
_WARM_STARTS = 3  # times that nominal values make room for an effect before it is fitted
_SHARES = (1.6, 1.0, 0.6, 0.3)  # of what linearised errors promise


@dataclass(frozen=True)
class Refined:
    """A candidate fitted together with everything else.

    Attributes:
        candidate: what was added.
        fit: with it.
        improvement: decrease of twice the negative logarithm of likelihood and prior, by the errors' true freedom.
        delta_bic: what is left of it when its parameters are paid for.
        crossed: decrease of the squared error on parts of the data that the fit did not see.
    """

    candidate: Candidate
    fit: Fit
    improvement: float
    delta_bic: float
    crossed: float


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
    """

    base: Fit
    fit: Fit
    chosen: list[Refined] = field(default_factory=list)
    alternatives: dict[str, list[str]] = field(default_factory=dict)
    tried: dict[str, float] = field(default_factory=dict)
    inflation: float = 1.0


class _CandidateStart(NamedTuple):
    """Where to fit a candidate from, and roughly what it is worth."""

    candidate: Candidate
    car: CarEstimate
    expected_delta_bic: float


class Search:
    """Selects effects by the information criterion and by the improvement on parts of the data that were left out.

    Args:
        problem: the windows.
        car: where to start.
        found: the candidates.
        on_progress: told what is being done.
    """

    def __init__(
        self,
        problem: IdentificationProblem,
        car: CarEstimate,
        found: Sequence[Candidate],
        on_progress: OnProgress = lambda words: None,
    ) -> None:
        self._study, self.found, self._report = problem, list(found), on_progress
        self._price = np.log(3.0 * problem.windows.steps * len(problem.windows))
        on_progress("recalibrating the nominal car")
        self.base = problem.fit(car, ())
        self._responses = Responses(problem, self.base.car, self.base.errors)
        self._ranked: dict[frozenset[Candidate], list[Refined]] = {}
        self._fits: dict[frozenset[Candidate], Fit] = {frozenset(): self.base}
        self.tried: dict[str, float] = {}

    def run(self) -> Selection:
        """Forward while it pays; then each effect is exchanged against all others, or dropped."""
        chosen: list[Candidate] = []
        while len(chosen) < _MAX_CAUSES:
            best = next((r for r in self.ranked(tuple(chosen)) if _pays(r)), None)
            if best is None:
                break
            chosen.append(best.candidate)
            self._exchange(chosen)
        result: dict[Candidate, Refined] = {}
        dropped = True
        while dropped and chosen:
            result = {c: self._against(tuple(chosen), c) for c in chosen}
            weakest = min(chosen, key=lambda c: result[c].delta_bic)
            dropped = not _pays(result[weakest])
            if dropped:
                chosen.remove(weakest)
        fit = self.fit(tuple(chosen))
        ordered = sorted(chosen, key=lambda c: -result[c].delta_bic)
        return Selection(
            self.base,
            fit,
            [result[c] for c in ordered],
            {c.effect: self._alternatives(tuple(chosen), c) for c in ordered},
            self.tried,
            self._study.inflation(fit),
        )

    def leave_out(self, selection: Selection, one: Refined) -> Fit:
        """The fit of everything chosen but ``one``."""
        chosen = tuple(r.candidate for r in selection.chosen)
        return self._without(chosen, one.candidate)

    def fit(self, chosen: tuple[Candidate, ...]) -> Fit:
        """All of ``chosen`` together, linearised anew."""
        key = frozenset(chosen)
        if key not in self._fits:
            starts = [r.fit for c in chosen for r in self._ranked.get(key - {c}, []) if r.candidate == c]
            start = min(starts, key=lambda fit: fit.objective)
            self._fits[key] = self._study.fit(start.car, start.free, start)
        return self._fits[key]

    def ranked(self, before: tuple[Candidate, ...]) -> list[Refined]:
        """The most promising candidates beside ``before``, fitted, the best first."""
        key = frozenset(before)
        if key in self._ranked:
            return self._ranked[key]
        fit = self.fit(before)
        taken = {c.effect for c in before}
        self._report("trying all effects" + (f" beside {', '.join(taken)}" if taken else ""))
        score_test = ScoreTest(self._study, fit, self._responses)
        scored_candidates = list(score_test.try_all([c for c in self.found if c.effect not in taken]))
        best: dict[str, ScoredCandidate] = {}
        for scored in sorted(scored_candidates, key=self._expected_delta_bic, reverse=True):
            best.setdefault(scored.candidate.effect, scored)
        if not before:
            self.tried = {name: p.improvement for name, p in best.items()}
        shortlist = [p for p in best.values() if self._expected_delta_bic(p) >= -self._price][:_SHORTLIST]
        some, near = self._study.part(fit, max(1, len(self._study.windows) // _SHORTLIST_WINDOWS))
        starts = sorted(
            (self._start(some, near, p) for p in shortlist), key=lambda start: start.expected_delta_bic, reverse=True
        )
        least = max([-self._price, *(_SHORTLIST_SHARE * start.expected_delta_bic for start in starts[:1])])
        refined = [self._refine(fit, start) for start in starts[:_REFINED] if start.expected_delta_bic >= least]
        close = max(
            [-AMBIGUITY_DELTA_BIC, *(_NEAR_BEST_SHARE * r.delta_bic - 2 * AMBIGUITY_DELTA_BIC for r in refined)]
        )
        refined = [self._polish(key, fit, r) if r.delta_bic > close else r for r in refined]
        self._ranked[key] = sorted(refined, key=lambda r: -r.delta_bic)
        return self._ranked[key]

    def _polish(self, before: frozenset[Candidate], without: Fit, rough: Refined) -> Refined:
        """The same, fitted to the end."""
        key = before | {rough.candidate}
        if key not in self._fits:
            self._fits[key] = self._study.fit(rough.fit.car, rough.fit.free, rough.fit)
        return self._judge(without, self._fits[key], rough.candidate)

    def _expected_delta_bic(self, scored: ScoredCandidate) -> float:
        return float(scored.improvement - self._price * len(scored.candidate.parameters))

    def _refine(self, fit: Fit, start: _CandidateStart) -> Refined:
        candidate = start.candidate
        self._report(f"fitting {candidate.effect}")
        free = (*fit.free, *candidate.free)
        return self._judge(fit, self._study.fit(start.car, free, fit, rough=True), candidate)

    def _start(self, some: IdentificationProblem, near: Fit, scored: ScoredCandidate) -> _CandidateStart:
        """Where to fit from, and what is reached there.

        What linearised errors promise is too much where an effect grows faster than its size, and too little where the
        nominal values have hidden it: so several sizes are tried, as they are and with the nominal values moved along.
        """
        candidate, cars = scored.candidate, []
        for share in _SHARES:
            values = dict(scored.values)
            for name in candidate.amplitudes:
                about = EFFECTS[candidate.effect].PARAMETERS[name]
                wanted = about.neutral + share * (values[name] - about.neutral)
                values[name] = float(np.clip(wanted, about.lower, about.upper))
            cars.append(near.car.with_effect(candidate.effect, values))
        warm_started = cars
        for _ in range(_WARM_STARTS):
            warm_started = some.warm_started(warm_started, near)
        cars, free = cars + warm_started, (*near.free, *candidate.free)
        reached = [
            some.objective(errors, position(car, free), near.noise)
            for car, errors in zip(cars, some.errors_of(cars), strict=True)
        ]
        improvement = (near.objective - min(reached)) * len(self._study.windows) / len(some.windows)
        expected_delta_bic = improvement - self._price * len(candidate.parameters)
        return _CandidateStart(candidate, cars[int(np.argmin(reached))], expected_delta_bic)

    def _judge(self, without: Fit, fit: Fit, candidate: Candidate) -> Refined:
        inflation = self._study.inflation(fit, len(fit.free) - len(without.free))
        improvement = (without.objective - fit.objective) / inflation
        delta = improvement - self._price * (len(fit.free) - len(without.free))
        return Refined(candidate, fit, improvement, delta, self._crossed(without, fit))

    def _against(self, chosen: tuple[Candidate, ...], one: Candidate) -> Refined:
        """What ``one`` is worth among ``chosen``."""
        return self._judge(self._without(chosen, one), self.fit(chosen), one)

    def _without(self, chosen: tuple[Candidate, ...], one: Candidate) -> Fit:
        """The fit of ``chosen`` but ``one``, from that of all."""
        key = frozenset(chosen) - {one}
        if key not in self._fits:
            fit = self.fit(chosen)
            free = tuple(pair for pair in fit.free if pair[0] != one.effect)
            self._fits[key] = self._study.fit(fit.car.without(one.effect), free, fit)
        return self._fits[key]

    def _exchange(self, chosen: list[Candidate]) -> None:
        """Replaces earlier effects by others that go better with the later ones."""
        if len(chosen) < 2:
            return
        for one in chosen[:-1]:
            rest = tuple(c for c in chosen if c != one)
            self._without(tuple(chosen), one)
            ranked = self.ranked(rest)
            if ranked and ranked[0].candidate.effect != one.effect:
                here = next((r for r in ranked if r.candidate == one), None)
                if here is None or ranked[0].delta_bic > here.delta_bic + AMBIGUITY_DELTA_BIC:
                    chosen[:] = [*rest, ranked[0].candidate]
                    return

    def _alternatives(self, chosen: tuple[Candidate, ...], one: Candidate) -> list[str]:
        rest = tuple(c for c in chosen if c != one)
        self._without(chosen, one)
        own = self._against(chosen, one).delta_bic
        return [
            r.candidate.effect
            for r in self.ranked(rest)
            if r.candidate.effect != one.effect and r.delta_bic > own - AMBIGUITY_DELTA_BIC and _pays(r)
        ]

    def _crossed(self, without: Fit, fit: Fit) -> float:
        """How much less the squared error is where the parameters were not fitted: every n-th part of the time in turn.

        What is seen once, as one pass over a place, does not count: it has to repeat. The place itself stays where it was
        found: parts without it would move it anywhere. What is known of the nominal values counts as a measurement beside
        them: it is all that tells more drag from a badly known C_r2.
        """
        parts = self._study.block * _FOLDS // (self._study.block.max() + 1)
        return self._left_out(without, fit, parts) - self._left_out(fit, fit, parts)

    def _left_out(self, fit: Fit, noise_of: Fit, parts: npt.NDArray[np.intp]) -> float:
        white = noise_of.noise.whiten(fit.errors)
        root = np.sqrt(weights(noise_of.noise.whiten(noise_of.errors)))
        shapes = [EFFECTS[effect].PARAMETERS[name].shape for effect, name in fit.free]
        moving = np.flatnonzero(~np.array([False] * len(fit.car.moved) + shapes))
        J = noise_of.noise.whiten(fit.jacobian[..., moving]) * root[:, None, None]
        r = white * root[:, None]
        p = fit.position[moving]
        known = self._study.prior_precision(p)
        H = [np.tensordot(J[parts == f], J[parts == f], ([0, 1], [0, 1])) for f in range(_FOLDS)]
        g = [np.einsum("wnp,wn->p", J[parts == f], r[parts == f]) for f in range(_FOLDS)]
        total = 0.0
        for f in range(_FOLDS):
            step = -np.linalg.solve(sum(H) - H[f] + np.diag(known), sum(g) - g[f] + known * p)
            total += float(((r[parts == f] + J[parts == f] @ step) ** 2).sum())
        return total + float(known @ p**2)


def _pays(refined: Refined) -> bool:
    return refined.delta_bic > DECISIVE_DELTA_BIC and refined.crossed > 0
