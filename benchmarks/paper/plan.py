"""The plan (``benchmarks/paper/plan.yaml``): recordings, how they are split, models, and which are compared on what."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field, model_validator

import benchmarks.rivals  # noqa: F401 - registers them
from dynssm_ros import configuration
from dynssm_ros.configuration import StrictModel
from dynssm_ros.control.race_models import TRUE
from dynssm_ros.control.settings import Objective
from dynssm_ros.errors import ConfigurationError
from dynssm_ros.learning.models.base import ModelConfig
from dynssm_ros.learning.models.registry import load_model_config, merge
from dynssm_ros.runtime.registry import UNTRAINED
from dynssm_ros.signals.signal_map import Commands
from dynssm_ros.simulation.plant import PlantKind
from dynssm_ros.track.racing_line import LineKind
from dynssm_ros.vehicle import load_vehicle
from dynssm_ros.vehicle.parameters import EffectEntry

Quantity = Literal["time", "speed", "yaw_rate", "lateral_acceleration"]
MID_RANGE = "mid_range"
AS_THEY_ARE = (MID_RANGE, *UNTRAINED)
"""Models that need no training: the single-track model with the middle of the bounds, and those on the calibrated car."""
FIXED = (TRUE, *AS_THEY_ARE)
"""The same of a race, with the plant's own."""
_SAME_TIME = 1e-3  # share by which sampling times may differ


def _of_the_repository(vehicle: str) -> str:
    """A vehicle by its name as it is, one by its file with the path to this repository before."""
    return str(Path(__file__).parents[2] / vehicle) if "/" in vehicle else vehicle


def _no_results(text: str) -> str:
    """Refuses numbers: what was measured is filled in where the document is written, and never typed."""
    found = re.search(r"\d", re.sub(r"\d{4}-\d\d-\d\d", "", text))
    if found:
        raise ValueError(f"'{text[max(0, found.start() - 20) :]:.40}': a number; expected words and the date alone")
    return text


VehicleName = Annotated[str, AfterValidator(_of_the_repository)]


class Log(StrictModel):
    """A race log."""

    bag: str  # rosbag2 folder or file, relative to the data folder
    signals: str  # signal map, by name
    rate: float = Field(gt=0)  # of the recording (Hz)
    commands: Commands | None = None  # source of the command inputs; null: the signal map's


class Drive(StrictModel):
    """A simulated drive; fields as the options of ``dynssm simulate``."""

    vehicle: str
    effects: tuple[EffectEntry, ...] = ()  # physics that the models do not know of
    track: str  # built-in name, or file relative to the data folder
    duration: float = Field(gt=0)  # (s)
    plant: PlantKind
    line: LineKind = "centre"
    seed: int = 0
    aggressiveness: float = Field(default=0.95, gt=0)
    variation: float = Field(default=0.5, ge=0, le=1)
    noise: tuple[float, float, float] = (0.0, 0.0, 0.0)  # on v_x, v_y, omega (m/s, m/s, rad/s)


class Range(StrictModel):
    """Rows of a recording by one quantity: all limits that are given must hold."""

    quantity: Quantity = Field(
        description="time since the first row (s); speed v_x (m/s), yaw_rate omega (rad/s) and lateral_acceleration "
        "|v_x omega| (m/s^2), of means over a second"
    )
    at_least: float | None = None
    below: float | None = None
    outside: tuple[float, float] | None = None  # not from the first value to below the second

    @model_validator(mode="after")
    def _limited(self) -> Range:
        if self.at_least is None and self.below is None and self.outside is None:
            raise ValueError(f"{self.quantity}: no limit; expected at_least, below or outside")
        return self


class Part(StrictModel):
    """Rows of a recording that lie in all of some ranges."""

    recording: str
    where: tuple[Range, ...] = ()


class Split(StrictModel):
    """What is trained on, and what is predicted then."""

    car: str
    train: Part
    test: dict[str, Part] = Field(
        default_factory=dict,
        description="by the name to show; empty: those recordings that the user gives which have the car's sampling time",
    )


class Car(StrictModel):
    """A car, and the models whose names have a meaning in the tables."""

    vehicle: VehicleName  # vehicle that is calibrated on each training part: name, or file relative to the repository
    start: Literal["vehicle", "mid_range"] = Field(
        default="vehicle", description="where calibration starts: the file's nominal values, or mid-range"
    )
    min_speed: float = Field(ge=0)  # rows that are slower are not calibrated on (m/s)
    reference: Literal["real", "sim", "other"]  # which of the paper's data sets is comparable, if any
    horizon: float = Field(gt=0)  # of rollouts (s); for the paper's cars the paper's
    full: str  # the model that ships; models named after it, with an underscore and more, are its ablations
    paper: str | None = None  # the paper's model; its ablations are named likewise
    ddm: str
    fthd: str | None = None
    coefficients: str  # study that the coefficient table is about


class Model(StrictModel):
    """A model: a shipped model file, or changes of one or of another model of the plan; and how it is trained."""

    base: str | None = None  # model of the plan, else shipped file; null: the file of its name
    change: dict[str, Any] = Field(default_factory=dict)  # fields instead of the base's, block by block
    variant: str = ""  # of an ablation: what it is, as the table shows it; empty: its name
    vehicle: VehicleName | None = None  # vehicle as it is, name or file; null: the calibrated car
    seeds: int | None = Field(default=None, ge=1)  # at most so many, also where a study wants more


class Study(StrictModel):
    """Models that are compared on some splits."""

    title: str
    text: str  # what is asked, in a sentence or two
    given: str = Field(default="", description="of splits whose tests the user gives: what to give, and how to get it")
    remark: Annotated[str, AfterValidator(_no_results)] = Field(
        default="", description="what its authors make of the outcome in words, with the date"
    )
    wanted: dict[Literal["v_x", "v_y", "omega", "ADE", "FDE"], float] = Field(
        default_factory=dict, description="errors that the paper's model should not exceed (m/s, m/s, rad/s, m, m)"
    )
    data: Literal["development", "test"] = Field(
        default="development", description="whether decisions on models were taken with these data in sight"
    )
    splits: tuple[str, ...] = Field(min_length=1)
    commands: Commands
    models: tuple[str, ...] = Field(min_length=1)
    seeds: int = Field(ge=1)


class Sweep(StrictModel):
    """A model that is trained with several learning rates, without restarts; which is best, validation windows say."""

    split: str  # on whose training part
    commands: Commands
    model: str
    rates: tuple[float, ...] = Field(min_length=2)  # learning rates, in order
    seeds: int = Field(default=1, ge=1)  # trainings with each; more than one where one would mislead


class Search(StrictModel):
    """A model with other settings than its own, each with all else as it is; which is best, validation windows say."""

    split: str  # on whose training part
    commands: Commands
    model: str
    tries: dict[Annotated[str, Field(pattern=r"^\w+$")], dict[str, Any]] = Field(
        min_length=1, description="by name: fields instead of the model's, block by block"
    )
    seeds: int = Field(default=1, ge=1)  # trainings with each


class Race(StrictModel):
    """Laps in closed loop; fields as the options of ``dynssm race``."""

    title: str
    text: str  # what is asked, in a sentence or two
    vehicle: str
    effects: tuple[EffectEntry, ...] = ()  # physics that only the model true knows of
    track: str  # built-in name, or file relative to the data folder
    lap_length: float | None = Field(default=None, gt=0)  # that it is scaled to (m)
    plant: PlantKind = "euler"
    objective: Objective = "tracking"
    line: str = "racing"  # centre, racing, or file relative to the data folder
    speed_scale: float = Field(default=1.0, gt=0)
    horizon: int | None = Field(default=None, ge=2)  # null: as the car needs
    offset_free: bool = False  # whether what a model mispredicts is added to it
    laps: int = Field(default=1, ge=1)
    speed: float | None = Field(default=None, ge=0)  # at the start (m/s); null: the line's own
    split: str  # on whose training part the models were trained, with seed 0
    commands: Commands = "topics"
    models: tuple[str, ...] = Field(min_length=1)
    paper: str | None = None  # the paper's closed-loop table to set beside: a track
    ablation: bool = False  # whether it is the paper's closed-loop ablation
    figures: tuple[Literal["trajectories", "profiles", "forces", "coefficients"], ...] = ()


class Quick(StrictModel):
    """What a run to try things out leaves out."""

    epochs: int = Field(ge=1)
    seeds: int = Field(ge=1)
    stride: int = Field(ge=1)
    duration: float = Field(gt=0)  # longest drive (s)


class Plan(StrictModel):
    """The whole plan; everything is referred to by its name here."""

    logs: dict[str, Log]
    drives: dict[str, Drive]
    cars: dict[str, Car]
    splits: dict[str, Split]
    models: dict[str, Model]
    studies: dict[str, Study]
    sweeps: dict[str, Sweep] = Field(default_factory=dict)
    searches: dict[str, Search] = Field(default_factory=dict)
    races: dict[str, Race] = Field(default_factory=dict)
    stride: int = Field(ge=1)  # rollouts start at every stride-th row
    calls: int = Field(ge=1)  # predictions of each model that are timed
    epochs: int | None = Field(default=None, ge=1)  # in each stage, instead of the model files'
    quick: Quick

    @model_validator(mode="after")
    def _names_exist(self) -> Plan:
        recordings = [*self.logs, *self.drives]
        for name, split in self.splits.items():
            _check(f"splits.{name}.car", [split.car], self.cars)
            _check(f"splits.{name}", [part.recording for part in (split.train, *split.test.values())], recordings)
        for name, car in self.cars.items():
            roles = [role for role in (car.full, car.paper, car.ddm, car.fthd) if role]
            _check(f"cars.{name}", roles, self.models)
            _check(f"cars.{name}.coefficients", [car.coefficients], self.studies)
        for name, study in self.studies.items():
            _check(f"studies.{name}.splits", study.splits, self.splits)
            _check(f"studies.{name}.models", study.models, [*AS_THEY_ARE, *self.models])
            if len({self.splits[split].car for split in study.splits}) > 1:
                raise ValueError(f"studies.{name}.splits: of several cars; expected the same")
            tests = self.tests(study)
            if len(set(tests)) < len(tests):
                raise ValueError(f"studies.{name}.splits: tests of the same name: {', '.join(tests)}")
        for name, sweep in self.sweeps.items():
            _check(f"sweeps.{name}.split", [sweep.split], self.splits)
            _check(f"sweeps.{name}.model", [sweep.model], self._trained(sweep.split, sweep.commands))
        for name, search in self.searches.items():
            _check(f"searches.{name}.split", [search.split], self.splits)
            _check(f"searches.{name}.model", [search.model], self._trained(search.split, search.commands))
        for name, race in self.races.items():
            _check(f"races.{name}.split", [race.split], self.splits)
            _check(f"races.{name}.models", race.models, [*FIXED, *self._trained(race.split, race.commands)])
        return self

    def _trained(self, split: str, commands: Commands) -> list[str]:
        return [
            model
            for study in self.studies.values()
            if split in study.splits and study.commands == commands
            for model in study.models
            if model in self.models
        ]

    def configured(self, name: str, other: Mapping[str, Any] = MappingProxyType({})) -> ModelConfig:
        """Configuration of a model of the plan, with ``other`` fields instead of its own, block by block.

        Raises:
            ConfigurationError: no such file, or the changes do not fit it.
        """
        change = dict(other)
        base, seen = name, {name}
        while base in self.models:
            model = self.models[base]
            change = merge(model.change, change)
            if model.base is None or model.base == base:
                break
            base = model.base
            if base in seen and base in self.models:
                raise ConfigurationError(f"models.{name}: base: refers to itself")
            seen.add(base)
        return load_model_config(base, change | {"name": name})

    def car(self, study: Study) -> Car:
        return self.cars[self.splits[study.splits[0]].car]

    def nominal(self, car: Car) -> str:
        """The vehicle whose bounds :data:`MID_RANGE` is the middle of: that of the paper's model, if there is one."""
        return (self.models[car.paper].vehicle if car.paper else None) or car.vehicle

    def seeds(self, study: Study, model: str) -> range:
        limit = self.models[model].seeds
        return range(study.seeds if limit is None else min(limit, study.seeds))

    def tests(self, study: Study) -> tuple[str, ...]:
        return tuple(test for split in study.splits for test in self.splits[split].test)

    def with_tests(self, recordings: Mapping[str, float]) -> Plan:
        """The plan in which the splits without test parts have the recordings that the user gives.

        Args:
            recordings: sampling times (s) by name; a split has those of its car's sampling time.

        Raises:
            ConfigurationError: the plan has a recording of that name, or no such split has a car of that sampling time.
        """
        open_splits = {name: split for name, split in self.splits.items() if not split.test}
        times = {name: load_vehicle(self.cars[split.car].vehicle).sampling_time for name, split in open_splits.items()}
        splits = dict(self.splits)
        for recording, T_s in recordings.items():
            if recording in {*self.logs, *self.drives}:
                raise ConfigurationError(
                    f"test={recording}: the plan has a recording of that name; expected another one"
                )
            fitting = [name for name, of_car in times.items() if math.isclose(T_s, of_car, rel_tol=_SAME_TIME)]
            if not fitting:
                expected = " or ".join(f"{each:g} s" for each in dict.fromkeys(times.values()))
                raise ConfigurationError(f"test={recording}: sampling time {T_s:g} s; expected {expected}")
            for name in fitting:
                test = splits[name].test | {recording: Part(recording=recording)}
                splits[name] = splits[name].model_copy(update={"test": test})
        return self.model_copy(update={"splits": splits})

    def home(self, name: str) -> str:
        """The first split with the car and the training part of split ``name``: its trainings serve both."""
        split = self.splits[name]
        return next(n for n, each in self.splits.items() if (each.car, each.train) == (split.car, split.train))

    def shortened(self) -> Plan:
        """The plan that tries everything out: few epochs and seeds, short drives, one split of each study."""
        quick = self.quick
        drives = {
            name: drive.model_copy(update={"duration": min(drive.duration, quick.duration)})
            for name, drive in self.drives.items()
        }
        studies = {
            name: study.model_copy(update={"seeds": min(study.seeds, quick.seeds), "splits": study.splits[:1]})
            for name, study in self.studies.items()
        }
        races = dict(list(self.races.items())[:1])
        sweeps = {name: sweep.model_copy(update={"seeds": 1}) for name, sweep in list(self.sweeps.items())[:1]}
        searches = {
            name: search.model_copy(update={"seeds": 1, "tries": dict(list(search.tries.items())[:1])})
            for name, search in list(self.searches.items())[:1]
        }
        short = {
            "stride": quick.stride, "epochs": quick.epochs, "races": races, "sweeps": sweeps, "searches": searches,
        }  # fmt: skip
        return self.model_copy(update={**short, "drives": drives, "studies": studies})

    @property
    def vehicles(self) -> set[str]:
        """Names of all vehicles that are calibrated, driven or raced, or that a model starts from."""
        of_models = {model.vehicle for model in self.models.values() if model.vehicle}
        parts = (self.cars.values(), self.drives.values(), self.races.values())
        return of_models | {each.vehicle for part in parts for each in part}


def load_plan(path: Path | None = None) -> Plan:
    """Reads a plan, the shipped one if not given.

    Raises:
        ConfigurationError: unreadable, malformed, or it names what is not there, a model without a file among that.
    """
    path = Path(__file__).parent / "plan.yaml" if path is None else path
    plan = configuration.validate(Plan, configuration.read_yaml(path), path)
    try:
        for name in plan.models:
            plan.configured(name)
        for search in plan.searches.values():
            for other in search.tries.values():
                plan.configured(search.model, other)
        for vehicle in sorted(plan.vehicles):
            configuration.find_config("vehicles", vehicle)
        for log in plan.logs.values():
            configuration.find_config("signals", log.signals)
    except ConfigurationError as error:
        raise ConfigurationError(f"{path}: {error}") from error
    return plan


def _check(where: str, names: Iterable[str], known: Iterable[str]) -> None:
    for name in names:
        if name not in known:
            raise ValueError(f"{where}: '{name}' is not one of {', '.join(known)}")
