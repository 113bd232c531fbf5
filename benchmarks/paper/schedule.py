"""A plan as steps: each once, however many studies ask for it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from benchmarks.paper.plan import AS_THEY_ARE, FIXED, Car, Plan, Race, Search, Split, Sweep
from benchmarks.paper.racing import DriveLaps
from benchmarks.paper.steps import (
    Calibrate,
    Evaluate,
    Extract,
    Simulate,
    Step,
    Take,
    TimeModels,
    Train,
    recording_key,
)
from dynssm_ros.signals.signal_map import Commands


def steps_of(plan: Plan, data: Path | None, given: Mapping[str, Path]) -> list[Step]:
    """The steps of a plan, in the order in which it asks for them; ``data``: folder with logs and tracks, ``given``:
    recordings that the user gives, by name.
    """
    wanted = dict.fromkeys(
        (split, study.commands) for study in plan.studies.values() for split in study.splits if plan.splits[split].test
    )
    sites = [Site(plan, *each) for each in wanted]
    recordings = dict.fromkeys(name for site in sites for name in site.recordings)
    steps: list[Step] = [_recording_step(plan, name, data, given) for name in recordings]
    made: dict[str, Step] = {}
    for step in (step for site in sites for step in site.steps()):
        made.setdefault(step.key, step)  # what splits share is made once
    steps += made.values()
    trained: dict[str, list[str]] = {}
    for step in steps:
        if isinstance(step, Train):
            trained.setdefault(step.model, []).append(step.key)
    for sweep in plan.sweeps.values():
        steps += Site(plan, sweep.split, sweep.commands).rates(sweep)
    for search in plan.searches.values():
        steps += Site(plan, search.split, search.commands).tries(search)
    for name, race in plan.races.items():
        steps.append(_race_step(name, race, Site(plan, race.split, race.commands), data))
    timing = TimeModels(  # last, while nothing else computes
        key=COSTS, title="time the models", uses=tuple(step.key for step in steps), trained=trained, calls=plan.calls,
        vehicle=next(iter(plan.cars.values())).vehicle,
    )  # fmt: skip
    return [*steps, timing]


COSTS = "costs.json"  # key of the step that times the models


def race_key(name: str) -> str:
    """Where the outcome of a race lies."""
    return f"races/{name}"


def _race_step(name: str, race: Race, site: Site, data: Path | None) -> DriveLaps:
    models = {model: site.model(model, 0) for model in race.models if model not in FIXED}
    return DriveLaps(
        key=race_key(name), title=f"race {name}", needs=(site.vehicle,), uses=tuple(models.values()), race=race,
        trained=models, calibrated=site.vehicle, data=data,
    )  # fmt: skip


def _recording_step(plan: Plan, name: str, data: Path | None, given: Mapping[str, Path]) -> Step:
    key = recording_key(name)
    if name in plan.logs:
        return Extract(key=key, title=f"extract {name}", log=plan.logs[name], data=data)
    if name in plan.drives:
        return Simulate(key=key, title=f"simulate {name}", drive=plan.drives[name], data=data)
    return Take(key=key, title=f"take {name}", path=given[name])


@dataclass(frozen=True)
class Site:
    """A split under a command protocol."""

    plan: Plan
    name: str
    commands: Commands

    def __str__(self) -> str:
        return f"{self.name}.{self.commands}"

    @property
    def home(self) -> str:
        """Under which name its trainings lie."""
        return f"{self.plan.home(self.name)}.{self.commands}"

    @property
    def car(self) -> Car:
        return self.plan.cars[self.split.car]

    @property
    def split(self) -> Split:
        return self.plan.splits[self.name]

    @property
    def shown(self) -> str:
        return f"{self.name}, commands {self.commands}"

    @property
    def recordings(self) -> list[str]:
        return [part.recording for part in (self.split.train, *self.split.test.values())]

    @property
    def vehicle(self) -> str:
        """Where the car lies that is calibrated on the training part."""
        return f"vehicles/{self.home}.yaml"

    @property
    def scores(self) -> str:
        return f"scores/{self}.json"

    def model(self, name: str, seed: int) -> str:
        return f"models/{self.home}/{name}.{seed}"

    def rate(self, sweep: Sweep, rate: float, seed: int) -> str:
        """Where the training of a sweep with a learning rate and a seed lies."""
        return f"rates/{self.home}/{sweep.model}.{rate:g}.{seed}"

    def attempt(self, search: Search, name: str, seed: int) -> str:
        """Where the training of a search with a try and a seed lies."""
        return f"searches/{self.home}/{search.model}.{name}.{seed}"

    @property
    def models(self) -> dict[str, range]:
        """Models with their seeds that any study wants here; no seeds for those without training."""
        wanted: dict[str, range] = {}
        for study in self.plan.studies.values():
            if self.name in study.splits and study.commands == self.commands:
                for name in study.models:
                    seeds = range(0) if name in AS_THEY_ARE else self.plan.seeds(study, name)
                    wanted[name] = max(wanted.get(name, seeds), seeds, key=len)
        return wanted

    def steps(self) -> Iterator[Step]:
        """All but those that make the recordings."""
        yield Calibrate(
            key=self.vehicle, title=f"calibrate on {self.shown}", needs=(recording_key(self.split.train.recording),),
            car=self.car, part=self.split.train, commands=self.commands,
        )  # fmt: skip
        models = self.models
        for name, seeds in models.items():
            for seed in seeds:
                yield self._training(name, seed, models)
        trained = {self.model(name, seed): name for name, seeds in models.items() for seed in seeds}
        tested = dict.fromkeys(recording_key(part.recording) for part in self.split.test.values())
        yield Evaluate(
            key=self.scores, title=f"evaluate on {self.shown}", needs=(*tested, self.vehicle),
            uses=tuple(trained), vehicle=self.vehicle, untrained=tuple(name for name in models if name in AS_THEY_ARE),
            nominal=self.plan.nominal(self.car), trained=trained, tests=self.split.test, commands=self.commands,
            horizon=self.car.horizon, stride=self.plan.stride,
        )  # fmt: skip

    def _training(self, name: str, seed: int, others: Mapping[str, range]) -> Train:
        """A training; one that fine-tunes goes on from a training of ``others`` where that is the same."""
        own_vehicle = self.plan.models[name].vehicle
        config = self.plan.configured(name)
        first = config.start.name if config.start else ""
        same = seed in others.get(first, ()) and self.plan.models[first].vehicle == own_vehicle
        start = self.model(first, seed) if same else None
        return Train(
            key=self.model(name, seed),
            title=f"train {name}, seed {seed}, on {self.shown}",
            needs=(recording_key(self.split.train.recording), *(() if own_vehicle else (self.vehicle,))),
            uses=(start,) if start else (),
            model=name,
            config=config,
            seed=seed,
            epochs=self.plan.epochs,
            part=self.split.train,
            commands=self.commands,
            vehicle=own_vehicle or self.vehicle,
            start=start,
        )

    def rates(self, sweep: Sweep) -> Iterator[Train]:
        for seed in range(sweep.seeds):
            plain = self._training(sweep.model, seed, {})
            for rate in sweep.rates:
                config = plain.config.with_training(learning_rate=rate, restarts=0)
                title = f"train {sweep.model} at the rate {rate:g}, seed {seed}, on {self.shown}"
                yield replace(plain, key=self.rate(sweep, rate, seed), title=title, config=config)

    def tries(self, search: Search) -> Iterator[Train]:
        for seed in range(search.seeds):
            plain = self._training(search.model, seed, {})
            for name, other in search.tries.items():
                config = self.plan.configured(search.model, other)
                title = f"train {search.model} with {name}, seed {seed}, on {self.shown}"
                yield replace(plain, key=self.attempt(search, name, seed), title=title, config=config)
