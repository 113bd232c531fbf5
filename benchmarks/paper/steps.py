"""The steps of a plan as values: what each needs, what decides its outcome, and how it is made.

A step's key is the path of its output below the run's folder, and its name. Steps are made in processes of their own, so
they read and write files only.
"""

from __future__ import annotations

import shutil
import tempfile
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from benchmarks.paper.parts import cut
from benchmarks.paper.plan import MID_RANGE, Car, Drive, Log, Part
from dynssm_ros.arrays import Vector
from dynssm_ros.errors import UserError
from dynssm_ros.evaluation.metrics import by_channel, latency_us
from dynssm_ros.evaluation.open_loop import Evaluation, evaluate
from dynssm_ros.files import digest, write_json
from dynssm_ros.identification.result.calibration import calibrate
from dynssm_ros.learning.models.base import ModelConfig
from dynssm_ros.runtime.baselines import SingleTrack
from dynssm_ros.runtime.contract import WindowModel
from dynssm_ros.runtime.registry import UNTRAINED, load_model
from dynssm_ros.signals.extraction import extract
from dynssm_ros.signals.inputs import WINDOW_COLUMNS
from dynssm_ros.signals.recording import Recording
from dynssm_ros.signals.signal_map import Commands, load_signal_map
from dynssm_ros.simulation.laps import simulate, write_run
from dynssm_ros.track.driver import Style
from dynssm_ros.track.layouts import LAYOUTS
from dynssm_ros.track.racing_line import line_of
from dynssm_ros.track.tracks import load_track
from dynssm_ros.vehicle import Vehicle, load_vehicle, save_vehicle

_ROUNDS = 5  # of timing all models in turn, because machines are noisy
_WINDOWS = 50  # different ones, so that no model answers from its caches


class UnavailableError(UserError):
    """Something that the user did not provide is needed."""


@dataclass(frozen=True, kw_only=True)
class Step(ABC):
    """A piece of work with one output."""

    key: str  # path of the output below the run's folder
    title: str  # what is done, for people
    needs: tuple[str, ...] = ()  # keys of steps whose outputs must be there
    uses: tuple[str, ...] = ()  # keys of steps whose outputs are taken as far as they are there
    marker: ClassVar[str] = ""  # file of an output folder that is written last

    @abstractmethod
    def recipe(self) -> dict[str, Any]:
        """All that decides the outcome beside the steps that this one builds on, as JSON has it.

        Raises:
            UserError: it cannot be known.
        """

    @abstractmethod
    def make(self, root: Path, there: frozenset[str]) -> None:
        """Makes the output.

        Args:
            root: the run's folder.
            there: which of :attr:`needs` and :attr:`uses` are there.
        """


@dataclass(frozen=True, kw_only=True)
class Extract(Step):
    """A race log to a recording."""

    log: Log
    data: Path | None = field(repr=False)

    def recipe(self) -> dict[str, Any]:
        signals = load_signal_map(self.log.signals).model_dump(mode="json")
        return {
            "log": self.log.model_dump(mode="json", exclude_none=True),
            "signals": signals,
            "content": digest(self._bag()),
        }

    def make(self, root: Path, there: frozenset[str]) -> None:
        signals = load_signal_map(self.log.signals).with_commands(self.log.commands)
        extract([self._bag()], signals, self.log.rate).save(root / self.key)

    def _bag(self) -> Path:
        return in_data(self.data, self.log.bag)


@dataclass(frozen=True, kw_only=True)
class Simulate(Step):
    """A simulated drive to a recording."""

    drive: Drive
    data: Path | None = field(repr=False)

    def recipe(self) -> dict[str, Any]:
        track = named_track(self.data, self.drive.track)
        return {
            "drive": self.drive.model_dump(mode="json"),
            "vehicle": load_vehicle(self.drive.vehicle).model_dump(mode="json"),
            "track": digest(track) if isinstance(track, Path) else track,
        }

    def make(self, root: Path, there: frozenset[str]) -> None:
        drive = self.drive
        vehicle = load_vehicle(drive.vehicle).with_effects((each.name, each.parameters) for each in drive.effects)
        track = load_track(named_track(self.data, drive.track))
        run = simulate(
            vehicle, track, drive.duration, plant=drive.plant, seed=drive.seed, noise=drive.noise,
            style=Style(drive.aggressiveness, drive.variation), line=line_of(drive.line, vehicle, track),
        )  # fmt: skip
        with tempfile.TemporaryDirectory(prefix="dynssm-") as folder:
            bag = Path(folder) / Path(self.key).stem
            write_run(run, bag)
            extract([bag], load_signal_map("default"), 1 / vehicle.sampling_time).save(root / self.key)


@dataclass(frozen=True, kw_only=True)
class Take(Step):
    """A recording that the user gives."""

    path: Path

    def recipe(self) -> dict[str, Any]:
        Recording.load(self.path)
        return {"content": digest(self.path)}

    def make(self, root: Path, there: frozenset[str]) -> None:
        Recording.load(self.path).save(root / self.key)


@dataclass(frozen=True, kw_only=True)
class Calibrate(Step):
    """A car to the training part of a split."""

    car: Car
    part: Part
    commands: Commands

    def recipe(self) -> dict[str, Any]:
        return _data(self.part, self.commands) | {
            "vehicle": self._start().model_dump(mode="json"),
            "min_speed": self.car.min_speed,
        }

    def make(self, root: Path, there: frozenset[str]) -> None:
        recording = _load(root, self.part, self.commands)
        found = calibrate(recording, self._start(), min_speed=self.car.min_speed)
        save_vehicle(found.vehicle, root / self.key, f"Calibrated on {', '.join(recording.info.source)}.")

    def _start(self) -> Vehicle:
        vehicle = load_vehicle(self.car.vehicle)
        return vehicle if self.car.start == "vehicle" else vehicle.unmeasured()


@dataclass(frozen=True, kw_only=True)
class Train(Step):
    """A model on the training part of a split."""

    marker: ClassVar[str] = "model.yaml"

    model: str  # name in the plan
    config: ModelConfig  # its configuration
    seed: int  # of the training
    epochs: int | None  # in each stage, instead of the file's
    part: Part  # rows to train on
    commands: Commands  # the command protocol
    vehicle: str  # name of a vehicle file, or key of the step that calibrates one
    start: str | None = None  # key of the step that trains what fine-tuning starts from, if there is one

    def recipe(self) -> dict[str, Any]:
        """Model file, rows and, unless calibrated, the car."""
        car = None if self.vehicle in self.needs else load_vehicle(self.vehicle).model_dump(mode="json")
        # a part that the model does not have is no part of the recipe, also if an earlier version did not know it
        model = self._config().model_dump(mode="json", exclude_none=True)
        return _data(self.part, self.commands) | {"model": model, "vehicle": car}

    def make(self, root: Path, there: frozenset[str]) -> None:
        """Trains it; after a kill from where it was. The checkpoint stays, for what starts from this model."""
        from dynssm_ros.learning.export import save_artifact
        from dynssm_ros.learning.stages import checkpoints, train

        config, target = self._config(), root / self.key
        target.parent.mkdir(parents=True, exist_ok=True)
        checkpoint = _checkpoint(target)
        if self.start in there:
            shutil.copyfile(_checkpoint(root / self.start), checkpoints(config, checkpoint)[0])
        vehicle = load_vehicle(root / self.vehicle if self.vehicle in there else self.vehicle)
        save_artifact(train(_load(root, self.part, self.commands), config, vehicle, checkpoint), target)

    def _config(self) -> ModelConfig:
        """The configuration of this training; a step before has calibrated the car."""
        epochs = {} if self.epochs is None else {"epochs": self.epochs}
        return self.config.with_training(seed=self.seed, **epochs)


@dataclass(frozen=True, kw_only=True)
class Evaluate(Step):
    """All models of a split on its test parts."""

    vehicle: str  # key of the calibrated car
    untrained: tuple[str, ...]  # names of models without training
    nominal: str  # vehicle whose bounds the model mid_range is the middle of
    trained: Mapping[str, str]  # names by the keys of their steps
    tests: Mapping[str, Part]  # parts to predict, by the names to show
    commands: Commands  # the command protocol
    horizon: float  # of rollouts (s)
    stride: int  # they start at every ``stride``-th row

    def recipe(self) -> dict[str, Any]:
        tests = {name: part.model_dump(mode="json") for name, part in self.tests.items()}
        recipe = {
            "models": [*self.untrained, *self.trained],
            "tests": tests,
            "horizon": self.horizon,
            "stride": self.stride,
        }
        if MID_RANGE in self.untrained:
            recipe["nominal"] = load_vehicle(self.nominal).model_dump(mode="json")
        return recipe

    def make(self, root: Path, there: frozenset[str]) -> None:
        vehicle = load_vehicle(root / self.vehicle)
        models = {name: self._untrained(name, vehicle) for name in self.untrained}
        models |= {key: load_model(root / key) for key in self.trained if key in there}
        tests = {}
        for name, part in self.tests.items():
            recording = _load(root, part, self.commands)
            scored = evaluate(recording, models, name=name, horizon_s=self.horizon, stride=self.stride, calls=1)
            tests[name] = self._scores(scored)
        write_json(root / self.key, {"tests": tests})

    def _untrained(self, name: str, calibrated: Vehicle) -> WindowModel:
        if name == MID_RANGE:
            return SingleTrack(load_vehicle(self.nominal).unmeasured())
        return load_model(name, calibrated)

    def _scores(self, evaluation: Evaluation) -> dict[str, Any]:
        by_model: dict[str, list[dict[str, Any]]] = {}
        for label, score in evaluation.scores.items():
            entry = score.to_json(evaluation.regimes) | {"seed": score.seed}
            del entry["latency_us"]  # taken while others compute; see TimeModels
            by_model.setdefault(self.trained.get(label, label), []).append(entry)
        return {
            "rows": len(evaluation.rows),
            "starts": evaluation.starts,
            "duration_s": evaluation.recording.duration,
            "horizon_s": round(evaluation.horizon_s, 9),
            "min_speed": evaluation.min_speed,
            "persistence_rmse": by_channel(evaluation.persistence_rmse),
            "models": by_model,
        }


@dataclass(frozen=True, kw_only=True)
class TimeModels(Step):
    """All models side by side, while nothing else computes: it uses all that is made before."""

    trained: Mapping[str, Sequence[str]]
    """Keys of steps that train a model, by its name; the first that is there is timed."""
    vehicle: str  # name of the vehicle file for the models without training
    calls: int  # predictions of each model

    def recipe(self) -> dict[str, Any]:
        return {"models": sorted(self.trained), "calls": self.calls}

    def make(self, root: Path, there: frozenset[str]) -> None:
        vehicle = load_vehicle(self.vehicle)
        models = {name: load_model(name, vehicle) for name in UNTRAINED}
        for name, keys in self.trained.items():
            made = [key for key in keys if key in there]
            if made:
                models[name] = load_model(root / made[0])
        windows = {name: _windows(model, vehicle) for name, model in models.items()}
        calls = -(-self.calls // _ROUNDS)
        times: dict[str, list[Vector]] = {name: [] for name in models}
        for _ in range(_ROUNDS):
            for name, model in models.items():
                times[name].append(latency_us(model, windows[name], calls))
        content = {name: _cost(model, np.concatenate(times[name])) for name, model in models.items()}
        write_json(root / self.key, {"models": content})


def in_data(data: Path | None, path: str) -> Path:
    """A file or folder among the measured data.

    Raises:
        UnavailableError: there is none.
    """
    if data is None or not (data / path).exists():
        raise UnavailableError(f"{path} is not in the data folder (--data or DYNSSM_DATA)")
    return data / path


def named_track(data: Path | None, name: str) -> str | Path:
    """What :func:`load_track` takes: the name of a built-in track, or a file among the measured data.

    Raises:
        UnavailableError: there is none.
    """
    return name if name in LAYOUTS else in_data(data, name)


def recording_key(name: str) -> str:
    """Where a recording lies."""
    return f"recordings/{name}.parquet"


def _checkpoint(folder: Path) -> Path:
    return folder.with_name(f"{folder.name}.checkpoint.pt")


def _data(part: Part, commands: Commands) -> dict[str, Any]:
    return {"part": part.model_dump(mode="json"), "commands": commands}


def _load(root: Path, part: Part, commands: Commands) -> Recording:
    return cut(Recording.load(root / recording_key(part.recording)).with_commands(commands), part)


def _windows(model: WindowModel, vehicle: Vehicle) -> Vector:
    """Windows around what the model was trained on, or around steady driving, shape ``(M, H, 7)``."""
    mean, std = np.array([10.0, *[0.0] * 6]), np.zeros(len(WINDOW_COLUMNS))
    if model.card is not None:
        scales = model.card.normalisation
        mean, std = np.array(scales.input_mean), np.array(scales.input_std)
    drawn = np.random.default_rng(0).standard_normal((_WINDOWS, model.H, len(WINDOW_COLUMNS)))
    windows: Vector = mean + 0.5 * std * drawn
    return windows


def _cost(model: WindowModel, times: Vector) -> dict[str, Any]:
    p50, p99 = np.percentile(times, [50, 99])
    card = model.card
    return {
        "parameters": model.parameters,
        "flops": model.flops,
        "latency_us": {"p50": float(p50), "p99": float(p99)},
        "integrator": card.integrator if card and card.architecture.get("physics") else None,
        "substeps": card.substeps if card else None,
    }
