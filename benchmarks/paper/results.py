"""What came out of a run, in the form in which tables and figures ask for it."""

from __future__ import annotations

import json
from collections.abc import Callable, Container, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.paper.plan import Car, Plan, Search, Study, Sweep
from benchmarks.paper.racing import NUMBERS
from benchmarks.paper.reference import load_reference
from benchmarks.paper.schedule import COSTS, Site, race_key
from benchmarks.paper.steps import Step
from benchmarks.tasks import output, split_available
from dynssm_ros.arrays import Vector
from dynssm_ros.evaluation.spread import SeedSpread, spreads
from dynssm_ros.runtime.artifact import METRICS, read_card
from dynssm_ros.signals.signal_map import STATE_SIGNALS

_NOT_MADE = "not made; `make paper` says why"

Entry = Mapping[str, Any]  # scores of one training of a model on one test, as to_json writes them


@dataclass(frozen=True)
class Results:
    """All results of a run."""

    plan: Plan  # as it was run
    reference: Entry  # the paper's numbers
    scores: Mapping[str, Entry]  # content of the steps that evaluate, by their keys, as far as they are done
    races: Mapping[str, Entry]
    """What was driven in closed loop, by the plan's names, as ``dynssm race`` writes it, as far as it is done."""
    rates: Mapping[str, Mapping[float, Sequence[Entry]]]
    """By the plan's names of sweeps, then by learning rate: what the trainings of all seeds say of themselves, as far
    as done."""
    tries: Mapping[str, Mapping[str, Sequence[Entry]]]
    """By the plan's names of searches, then by that of the try, the model as it is under an empty one first: likewise."""
    losses: Mapping[str, Entry]
    """What a training of the paper's model says of itself, by the model's name, as far as done."""
    networks: Mapping[str, tuple[int, int]]
    """Of a shipping model's trainings, by its name: how many kept the network, and how many there are."""
    costs: Mapping[str, Entry]  # of the models, by name: parameters, flops, latency_us, integrator
    missing: Mapping[str, str]  # why steps are not done, by their titles; steps that only lack others are left out
    reasons: Mapping[str, str]  # why scores are not there, by their keys
    made: str  # machine, versions, date
    quick: bool = False  # whether the plan was shortened to try things out

    @property
    def comparisons(self) -> list[Comparison]:
        return [Comparison(self, name) for name in self.plan.studies]


class Comparison:
    """The results of a study.

    A model appears if it has results on all tests. Where a study has several tests, one number for all of them is made
    of the errors on each: the root of the mean square for RMSE, the largest for maximum errors, else the mean.
    """

    def __init__(self, results: Results, name: str) -> None:
        self._plan = plan = results.plan
        self.name = name
        self.study: Study = plan.studies[name]
        self.car: Car = plan.car(self.study)
        self.planned = plan.tests(self.study)
        keys = [Site(plan, split, self.study.commands).scores for split in self.study.splits if plan.splits[split].test]
        self._tests: dict[str, Entry] = {}
        for key in keys:
            self._tests |= results.scores.get(key, {"tests": {}})["tests"]
        self.reasons = [results.reasons[key] for key in keys if key in results.reasons]
        wanted = {m: plan.seeds(self.study, m) if m in plan.models else (None,) for m in self.study.models}
        self._runs = {model: self._complete(model, seeds) for model, seeds in wanted.items()}

    @property
    def label(self) -> str:
        return f"{self.study.title}, {self.study.commands}"

    @property
    def tests(self) -> tuple[str, ...]:
        return tuple(test for test in self.planned if test in self._tests)

    @property
    def models(self) -> tuple[str, ...]:
        """Models with results, in the plan's order."""
        return tuple(model for model, runs in self._runs.items() if runs)

    def those(self, *models: str | None) -> list[str]:
        return [model for model in models if model in self.models]

    @property
    def bases(self) -> tuple[str, ...]:
        """The models with results that have ablations: the paper's, the one that ships."""
        return tuple(base for base in self.those(self.car.paper, self.car.full) if self.ablations(base))

    def ablations(self, base: str) -> dict[str, str]:
        """Models that are ``base`` less something, by what they lack."""
        others = [each for each in (self.car.paper, self.car.full) if each and each.startswith(f"{base}_")]
        own = [m for m in self.models if m.startswith(f"{base}_") and not any(m.startswith(each) for each in others)]
        return {model.removeprefix(f"{base}_"): model for model in own}

    def variants(self, base: str) -> dict[str, str]:
        """The ablations in words, by what they lack."""
        return {lacking: self._plan.models[m].variant or lacking for lacking, m in self.ablations(base).items()}

    @property
    def compared(self) -> tuple[str, ...]:
        """The models that are no ablations."""
        bases = [base for base in (self.car.paper, self.car.full) if base]
        left_out = [model for base in bases for model in self.ablations(base).values()]
        return tuple(model for model in self.models if model not in left_out)

    def seeds(self, model: str) -> int:
        return len(self._runs[model])

    def test(self, name: str) -> Entry:
        """About a test: rows, starts, duration_s, horizon_s ..."""
        return self._tests[name]

    def entries(self, model: str) -> list[Entry]:
        return [entry for run in self._runs[model] for entry in run]

    def rmse(self, model: str) -> list[SeedSpread]:
        return self._pooled(model, lambda entry: by_name(entry["rmse"]), lambda each: np.sqrt((each**2).mean(axis=0)))

    def max_error(self, model: str) -> list[SeedSpread]:
        return self._pooled(model, lambda entry: by_name(entry["max_error"]), lambda each: each.max(axis=0))

    def displacement(self, model: str) -> list[SeedSpread]:
        """ADE and FDE (m)."""
        return self._pooled(model, lambda entry: _numbers([entry["ade"], entry["fde"]]), lambda each: each.mean(axis=0))

    def coverage(self, model: str) -> list[SeedSpread] | None:
        """Share of errors inside the 90 % interval, for each state; ``None`` for a model that states none."""
        if any(entry["coverage_90"] is None for entry in self.entries(model)):
            return None
        return self._pooled(model, lambda entry: by_name(entry["coverage_90"]), lambda each: each.mean(axis=0))

    def relative(self, model: str, test: str) -> Vector:
        """One-step RMSE of each state as a multiple of persistence's, mean over the seeds, shape ``(3,)``."""
        k = self.tests.index(test)
        found = np.stack([by_name(run[k]["rmse"]) for run in self._runs[model]]).mean(axis=0)
        with np.errstate(divide="ignore", invalid="ignore"):
            multiple: Vector = found / by_name(self._tests[test]["persistence_rmse"])
        return multiple

    def _complete(self, model: str, seeds: Sequence[int | None]) -> list[list[Entry]]:
        """Trainings, each with its entries of all tests; those that lack one are left out."""
        runs = []
        for seed in seeds:
            scored = [entry for test in self.tests for entry in self._tests[test]["models"].get(model, [])]
            found = [entry for entry in scored if entry["seed"] == seed]
            if found and len(found) == len(self.tests):
                runs.append(found)
        return runs

    def _pooled(
        self, model: str, measure: Callable[[Entry], Vector], pool: Callable[[Vector], Vector]
    ) -> list[SeedSpread]:
        return spreads([pool(np.stack([measure(entry) for entry in run])) for run in self._runs[model]])


def read_results(plan: Plan, root: Path, steps: Sequence[Step], made: str = "", quick: bool = False) -> Results:
    """Reads what the steps of ``plan`` left in ``root``."""
    done = {step.key for step in steps if output(step, root).exists()}
    _, reasons, causes = split_available(steps)
    titles = {step.key: step.title for step in steps}
    failed = {step.key: _NOT_MADE for step in steps if step.key not in done and step.key not in reasons}
    scores = {key: _read(root / key) for key in done if key.startswith("scores/")}
    return Results(
        plan=plan,
        reference=load_reference(),
        scores=scores,
        races={name: _read(root / race_key(name) / NUMBERS) for name in plan.races if race_key(name) in done},
        rates={name: _rates(plan, sweep, root, done) for name, sweep in plan.sweeps.items()},
        tries={name: _tries(plan, search, root, done) for name, search in plan.searches.items()},
        losses=_losses(plan, root, done),
        networks=_networks(plan, root, done),
        costs=_read(root / COSTS)["models"] if COSTS in done else {},
        missing={titles[key]: reasons[key] for key, cause in causes.items() if cause == key}
        | {titles[key]: reason for key, reason in failed.items()},
        reasons={key: f"{titles[causes[key]]}: {reason}" for key, reason in reasons.items()} | failed,
        made=made,
        quick=quick,
    )


def _losses(plan: Plan, root: Path, done: Container[str]) -> dict[str, Entry]:
    """Of the first training of the paper's model of each car, with seed 0."""
    found: dict[str, Entry] = {}
    for study in plan.studies.values():
        model = plan.car(study).paper
        for split in study.splits:
            if model and model in study.models and model not in found:
                key = Site(plan, split, study.commands).model(model, 0)
                found |= {model: _read(root / key / METRICS)} if key in done else {}
    return found


def _rates(plan: Plan, sweep: Sweep, root: Path, done: Container[str]) -> dict[float, list[Entry]]:
    """The trainings with each learning rate, one for each seed; rates without one are left out."""
    site = Site(plan, sweep.split, sweep.commands)
    keys = {rate: [site.rate(sweep, rate, seed) for seed in range(sweep.seeds)] for rate in sweep.rates}
    there = {rate: [key for key in each if key in done] for rate, each in keys.items()}
    return {rate: [_read(root / key / METRICS) for key in each] for rate, each in there.items() if each}


def _tries(plan: Plan, search: Search, root: Path, done: Container[str]) -> dict[str, list[Entry]]:
    """The trainings with each try, one for each seed; those without one are left out."""
    site, seeds = Site(plan, search.split, search.commands), range(search.seeds)
    keys = {"": [site.model(search.model, seed) for seed in seeds]}
    keys |= {name: [site.attempt(search, name, seed) for seed in seeds] for name in search.tries}
    there = {name: [key for key in each if key in done] for name, each in keys.items()}
    return {name: [_read(root / key / METRICS) for key in each] for name, each in there.items() if each}


def _networks(plan: Plan, root: Path, done: Container[str]) -> dict[str, tuple[int, int]]:
    """Whether the network of the model that ships earned its place, over all trainings with an online layer."""
    kept: dict[str, dict[str, bool]] = {}
    for study in plan.studies.values():
        model = plan.car(study).full
        seeds = plan.seeds(study, model) if model in study.models else ()
        sites = [Site(plan, split, study.commands) for split in study.splits]
        for key in (site.model(model, seed) for site in sites for seed in seeds):
            if key in done and (layer := read_card(root / key).online):
                kept.setdefault(model, {})[key] = "network" in layer.features
    return {model: (sum(each.values()), len(each)) for model, each in kept.items()}


def by_name(values: Entry) -> Vector:
    """The entries of a JSON mapping in the order of the states; what is null is NaN."""
    return _numbers([values[name] for name in STATE_SIGNALS])


def _numbers(values: Sequence[float | None]) -> Vector:
    return np.array(values, dtype=float)


def _read(path: Path) -> dict[str, Any]:
    content: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return content
