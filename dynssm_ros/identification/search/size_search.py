"""Where to fit a candidate from: several sizes on some of the windows, and a short fit where none keeps what was promised."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from dynssm_ros.identification import tuning
from dynssm_ros.identification.problem.car import CarEstimate, Values
from dynssm_ros.identification.problem.fit import Fit, IdentificationProblem, position
from dynssm_ros.identification.search.candidates import Candidate, ScoredCandidate, steps_off


class CandidateStart(NamedTuple):
    """Where to fit a candidate from, and roughly what it is worth."""

    candidate: Candidate
    car: CarEstimate
    expected_delta_bic: float

    @property
    def values(self) -> Values:
        """With which its effect is to be fitted from."""
        return self.car.effects[self.candidate.effect]


@dataclass(frozen=True)
class SizeSearch:
    """Candidates in several sizes, on some of the windows.

    Attributes:
        some: those windows; ``near``: the fit without the candidate, there.
        given: the car as it was known.
        price: of a parameter.
        tempering: with all windows, of which a promise is made.
    """

    some: IdentificationProblem
    near: Fit
    given: CarEstimate
    price: float
    tempering: float

    def start(self, scored: ScoredCandidate) -> CandidateStart:
        """Where to fit from, and what is reached there.

        What linearised errors promise is too much where an effect grows faster than its size, and too little where the
        nominal values have hidden it: so several sizes are tried, as they are and with the nominal values moved along, from
        where they are and from where the vehicle file has them. Where none of these keeps the promise, a short fit follows.
        """
        some, near, candidate = self.some, self.near, scored.candidate
        cars = [self._sized(scored, share) for share in tuning.SIZE_SHARES]
        cars += self._from_the_file(candidate, scored.values)
        warm_started = cars
        for _ in range(tuning.WARM_STARTS):
            warm_started = some.warm_started(warm_started, near)
        cars, free = cars + warm_started, (*near.free, *candidate.free)
        reached = [
            some.objective(errors, position(car, free), near.noise)
            for car, errors in zip(cars, some.errors_of(cars), strict=True)
        ]
        best, objective = cars[int(np.argmin(reached))], min(reached)
        promised, paid = scored.improvement / self.tempering, self.price * candidate.cost
        if promised > paid and near.objective - objective < tuning.KEPT_PROMISE * promised:
            fit = some.fit(self._sized(scored, 0.0), free, near, rounds=tuning.TRIAL_ROUNDS, rough=True)
            if fit.objective < objective:
                best, objective = fit.car, fit.objective
        return CandidateStart(candidate, best, near.objective - objective - paid)

    def _sized(self, scored: ScoredCandidate, share: float) -> CarEstimate:
        """The car with a share of what is promised of the effect."""
        candidate, values = scored.candidate, dict(scored.values)
        for name in candidate.amplitudes:
            about = candidate.about[name]
            wanted = about.neutral + share * (values[name] - about.neutral)
            values[name] = float(np.clip(wanted, about.lower, about.upper))
        return self.near.car.with_effect(candidate.effect, values, candidate.only_in)

    def _from_the_file(self, candidate: Candidate, values: Values) -> list[CarEstimate]:
        """Cars with the nominal values of the file, and the effect in all sizes."""
        if candidate.local or len(candidate.amplitudes) > 1:
            return []
        (name,), effect = candidate.amplitudes, candidate.effect
        neutral = candidate.about[name].neutral
        given = replace(self.near.car, moved=self.given.moved)
        steps = steps_off(effect, name, tuning.BOTH_SIDES)
        return [given.with_effect(effect, values | {name: neutral + step}, candidate.only_in) for step in steps]
