"""A start for a car that nobody has trained on: the online layer with a prior over simulated cars of its class.

    python -m benchmarks.any_car [--only racer] [--cars 45] [--test] [--out out/any_car] [--data DIR]
    python -m benchmarks.any_car --vehicle car.yaml [--cars 45] [--out out/any_car]

Each drawn car has its drive (:mod:`benchmarks.drawn_cars`), on which its weights of the online layer are estimated, with
the car of the class's middle as physics. The prior is the normal distribution over cars that makes all drives likeliest. It
is written as a model folder, ``dynssm_any_CLASS``, and scored on drives of a real car of the class: by the time that the
layer has seen, over the errors of ``rls`` that was trained on other drives of that car. ``--test`` takes the logs that are
for publishing. ``--vehicle`` writes a model for cars like that of a file.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from benchmarks.drawn_cars import CLASSES, CarClass, drives
from benchmarks.logs import add_data_option
from benchmarks.network import Fold, Study, further_folds
from benchmarks.page import table
from dynssm_ros.arrays import Indices, Vector
from dynssm_ros.files import write_json
from dynssm_ros.learning.dataset import normalisation
from dynssm_ros.learning.earned_layer import LayerBase, earned_layer
from dynssm_ros.learning.export import save_artifact
from dynssm_ros.learning.models.base import OnlineConfig
from dynssm_ros.learning.models.physics import PhysicsConfig
from dynssm_ros.learning.models.registry import build_model, load_model_config
from dynssm_ros.learning.online import LayerDrive, Moments, fit_layer, moments_of
from dynssm_ros.learning.stages import Trained
from dynssm_ros.runtime.along import Along
from dynssm_ros.runtime.artifact import Artifact
from dynssm_ros.runtime.baselines import Persistence, SingleTrack
from dynssm_ros.runtime.contract import WindowModel
from dynssm_ros.runtime.features import LayerFeatures
from dynssm_ros.runtime.online import CHANNELS, OnlineLayer, OnlineLayerCard
from dynssm_ros.runtime.path_judge import PathJudge
from dynssm_ros.runtime.rollout import RolloutCorrection, Step, path_errors, roll_out, step_of
from dynssm_ros.signals.recording import Recording, concatenate
from dynssm_ros.vehicle.kinematics import PATH_HORIZON_S

SEEN_S = (0.0, 2.0, 10.0, 60.0, np.inf)
"""Time of the drive that the layer has seen: edges of the columns (s)."""
OWN = "rls, trained on own laps"
_FOLDS = {"racer": "season_", "indy": "putnam_"}  # beginnings of the names of folds of a real car of the class
_ROUNDS = 30  # of expectation and maximisation
_BELIEVED = 0.03
"""Share of a drive's rows that count: errors of neighbouring rows are alike. Of 0.01 to 1 the least error on development logs
of the 1:10 car in the first ten seconds; 0.01 is as good."""
_DOUBT = 0.1
"""Standard deviation of a weight's change that is added as if of as many more cars as there are weights: few cars do not span
all directions. Of 0.03 to 0.2 the least error there."""
_LEAST_NOISE = 1e-8  # variance, in squared s_delta
_FEWEST_ROWS = 200  # of a drive
_WIDTH = 0.6  # deviation of the weights of a layer without a prior; of 0.1 to 1 the least error there
_STRIDE_S = 0.2  # between starts of paths
_FEWEST_STARTS, _FEWEST_STEPS = 3, 20  # of a column


class OverCars(NamedTuple):
    """A normal distribution of weights over cars; noise and errors of the physics in geometric mean over them."""

    mean: Vector  # (3, n)
    covariance: Vector  # (3, n, n)
    noise: Vector  # (3,), in units of s_delta squared
    physics: Vector  # likewise

    @classmethod
    def undecided(cls, cars: Sequence[Moments]) -> OverCars:
        """The physics alone, with the same doubt about every weight."""
        n = cars[0].gram.shape[1]
        mean, physics = np.zeros((CHANNELS, n)), _usual_errors(cars)
        mean[:, 0] = 1.0
        return cls(mean, np.tile(_WIDTH**2 * np.eye(n), (CHANNELS, 1, 1)), physics / 10, physics)


def over_cars(cars: Sequence[Moments], believed: float = _BELIEVED, doubt: float = _DOUBT) -> OverCars:
    """The distribution of weights that makes the drives of ``cars`` likeliest (empirical Bayes).

    By expectation and maximisation (Dempster, Laird and Rubin 1977): the posterior of each car's weights under the present
    distribution, then the distribution of these posteriors.

    Args:
        cars: of each what least squares needs.
        believed: share of a drive's rows that count.
        doubt: see :data:`_DOUBT`.
    """
    parts = [_one_channel(cars, c, believed, doubt) for c in range(CHANNELS)]
    mean, covariance, noise = (np.stack(each) for each in zip(*parts, strict=True))
    mean[:, 0] += 1.0  # moments are of what the physics leaves
    return OverCars(mean, covariance, noise, _usual_errors(cars))


def _one_channel(cars: Sequence[Moments], c: int, believed: float, doubt: float) -> tuple[Vector, Vector, float]:
    rows = np.array([car.rows for car in cars])
    gram, moment, square = (np.stack([part[c] for part in each]) for each in list(zip(*cars, strict=True))[1:])
    n = gram.shape[1]
    noise, mean, covariance = square / rows, np.zeros(n), np.eye(n)
    for _ in range(_ROUNDS):
        precision, told = np.linalg.inv(covariance), (believed / noise)[:, None]
        P = np.linalg.inv(precision + told[..., None] * gram)
        weights = (P @ (precision @ mean + told * moment)[..., None])[..., 0]
        left = square + np.einsum("ki,ki->k", weights, (gram @ weights[..., None])[..., 0] - 2.0 * moment)
        noise = np.maximum((left + np.einsum("kij,kij->k", P, gram)) / rows, _LEAST_NOISE)
        mean = weights.mean(axis=0)
        apart = weights - mean
        spread = P.sum(axis=0) + apart.T @ apart + n * doubt**2 * np.eye(n)
        covariance = spread / (len(cars) + n * (doubt > 0))
    return mean, covariance, float(np.exp(np.log(noise).mean()))


def _usual_errors(cars: Sequence[Moments]) -> Vector:
    """Mean square of the physics' errors, in geometric mean over cars, ``(3,)``."""
    usual: Vector = np.exp(np.mean([np.log(car.square / car.rows) for car in cars], axis=0))
    return usual


class Start(NamedTuple):
    """What a layer for any car of a class stands on."""

    base: LayerBase
    features: LayerFeatures
    recording: Recording  # all drives of the cars
    cars: list[Moments]

    @classmethod
    def of(cls, cars: CarClass, logs: Sequence[Recording]) -> Start:
        """From the drives of cars of a class."""
        car, joined = cars.middle, concatenate(logs)
        config = load_model_config("rls")
        H = config.rows(car.sampling_time)
        scale = normalisation(joined, joined.window_ends(H, min_speed=car.minimum_speed))
        base = LayerBase(car, PhysicsConfig(), scale, H, OnlineConfig(throttle_steps=cars.throttle_steps))
        features = base.features(False)
        moments = [moments_of(drive_of(log, base, features), np.array(scale.increment_scale)) for log in logs]
        return cls(base, features, joined, [one for one in moments if one.rows >= _FEWEST_ROWS])

    def layer(self, prior: OverCars) -> OnlineLayer:
        """The online layer that begins with a prior; it does not follow coefficients, which are nobody's."""
        square = np.mean([np.einsum("cii->ci", car.gram) / car.rows for car in self.cars], axis=0)
        told = prior.noise[:, None] / (np.einsum("cii->ci", prior.covariance) * square)
        card = OnlineLayerCard(
            features=self.features.names, error_rows=self.features.layout.errors, memory=self.base.config.memory,
            prior_rows=float(np.median(told)), spread={},
        )  # fmt: skip
        one, scale = np.ones(CHANNELS), np.array(self.base.normalisation.increment_scale)
        return OnlineLayer(card, *prior, one, one, scale, self.base.vehicle, *self.features.stepping)

    def save(self, layer: OnlineLayer, name: str, out: Path) -> Artifact:
        """Writes the model folder ``name`` into ``out``."""
        config = load_model_config("rls").model_copy(update={"name": name})
        base, rows = self.base, sum(car.rows for car in self.cars)
        v_x, v_y, omega = (np.sqrt(layer.noise) * layer.scale).tolist()
        trained = Trained(
            config, base.vehicle, self.recording, build_model(config, base.vehicle, base.normalisation),
            base.normalisation, {}, 0, (v_x, v_y, omega), float(layer.noise.mean()), (rows, 0),
            features=self.features, online=layer,
        )  # fmt: skip
        words = f"{len(self.cars)} simulated cars about {base.vehicle.name}"
        return save_artifact(trained, out / name, {"recordings": [words]})


def drive_of(log: Recording, base: LayerBase, features: LayerFeatures) -> LayerDrive:
    """A log as the layer sees it."""
    ends = log.window_ends(base.H, min_speed=base.vehicle.minimum_speed)
    return LayerDrive.of(log, ends, base.H, features.seen)


class Errors(NamedTuple):
    """Errors along a log."""

    squares: Vector  # of one step, a row after the other, (N, 3)
    starts: Indices  # rows at which paths start, counted like these, (M,)
    distances: Vector  # mean distance of a path of 0.6 s, (M,) (m)

    def table(self, T_s: float) -> list[list[float] | None]:
        """In each column of :data:`SEEN_S` the mean squares and the distance; ``None`` where too little was driven."""
        found: list[list[float] | None] = []
        for begin, end in pairwise(SEEN_S):
            first, last = begin / T_s, end / T_s
            rows = slice(round(first), round(min(last, len(self.squares))))
            inside = (self.starts >= first) & (self.starts < last)
            enough = len(self.squares[rows]) >= _FEWEST_STEPS and inside.sum() >= _FEWEST_STARTS
            values = (
                [*self.squares[rows].mean(axis=0).tolist(), float(self.distances[inside].mean())] if enough else None
            )
            found.append(values)
        return found


Contender = Callable[[Recording, LayerBase], Errors]


def of_model(model: WindowModel, log: Recording, base: LayerBase) -> Errors:
    """Errors of a model that does not learn along the drive."""
    ends = log.window_ends(base.H, min_speed=base.vehicle.minimum_speed)
    predicted = model.predict(log.windows(ends, base.H)).state
    return _with_paths(predicted - log.states(ends + 1), log, base, lambda at: step_of(model))


def of_layer(layer: OnlineLayer, features: LayerFeatures, log: Recording, base: LayerBase) -> Errors:
    """Errors of the physics with an online layer that learns along the drive."""
    drive = drive_of(log, base, features)
    seen, (rows, increments) = drive.see(slice(None)), drive.measured(slice(None))
    known = Along(layer).over(seen, rows, increments, drive.ends)
    judge = PathJudge(layer, features.seen, features)
    known = known._replace(trusted=judge.along(log.windows(drive.ends, base.H), drive.ends, known, seen))

    def step(at: Indices) -> Step:
        correction = RolloutCorrection(layer, known.at(at))
        return lambda windows: np.asarray(windows[:, -1, :CHANNELS] + correction.increments(features.seen(windows)))

    return _with_paths(layer.increments(seen.features, known.weights) - increments, log, base, step)


def _with_paths(errors: Vector, log: Recording, base: LayerBase, step: Callable[[Indices], Step]) -> Errors:
    H, T_s, slow = base.H, base.vehicle.sampling_time, base.vehicle.minimum_speed
    steps = round(PATH_HORIZON_S / T_s)
    starts = log.window_ends(H, steps, slow)[:: max(1, round(_STRIDE_S / T_s))]
    at = np.searchsorted(log.window_ends(H, min_speed=slow), starts)
    rows = log.windows(starts, H, steps)
    predicted = roll_out(step(at), rows, H)
    distances = path_errors(rows[:, H - 1 : H, :3], predicted, rows[:, H:, :3], T_s)
    return Errors(errors**2, at, distances.mean(axis=1))


def contenders(start: Start) -> dict[str, Contender]:
    """Those that know nothing of the car, by name."""
    layers = {
        "middle car, layer without prior": start.layer(OverCars.undecided(start.cars)),
        "middle car, prior over cars": start.layer(over_cars(start.cars)),
    }
    car = start.base.vehicle
    found: dict[str, Contender] = {
        "persistence": partial(of_model, Persistence()),
        "middle car": partial(of_model, SingleTrack(car, *start.features.stepping)),
    }
    return found | {name: partial(of_layer, layer, start.features) for name, layer in layers.items()}


def those_that_know(fold: Fold, start: Start, out: Path) -> dict[str, tuple[Contender, LayerBase]]:
    """Those that were fitted to the training of a fold, which is of the same car."""
    study = Study.of(fold, out)
    model = build_model(load_model_config("rls"), study.car, study.base.normalisation)
    own = earned_layer(study.base, model, fold.training, [])
    base = start.base
    drives = [drive_of(part, base, start.features) for part in map(fold.training.select, fold.training.stretches(4))]
    other = fit_layer(drives, start.features, base.normalisation, base.config).layer
    return {
        "calibrated car": (partial(of_model, SingleTrack(study.car, *own.features.stepping)), study.base),
        "middle car, prior of own laps": (partial(of_layer, other, start.features), base),
        OWN: (partial(of_layer, own.layer, own.features), study.base),
    }


def scored(
    name: str, start: Start, out: Path, data: Path, test: bool
) -> dict[str, dict[str, list[list[float] | None]]]:
    """:meth:`Errors.table` of each contender on each fold of a class; what is done is kept in ``out``."""
    others, found = {each: (run, start.base) for each, run in contenders(start).items()}, {}
    knowing: dict[str, dict[str, tuple[Contender, LayerBase]]] = {}
    for label, make in further_folds(data, test).items():
        if not label.startswith(_FOLDS[name]):
            continue
        file = out / f"{name}_{label}.json"
        if not file.is_file():
            fold = make()
            training = fold.trained or fold.name
            if training not in knowing:
                knowing[training] = those_that_know(fold, start, out)
            all_of = others | knowing[training]
            T_s = start.base.vehicle.sampling_time
            write_json(file, {each: run(fold.left_out, base).table(T_s) for each, (run, base) in all_of.items()})
        found[label] = json.loads(file.read_text(encoding="utf-8"))
    return found


def page(found: Mapping[str, Mapping[str, list[list[float] | None]]]) -> str:
    """Errors over those of ``rls`` on own laps, geometric means over channels and logs: one step, path."""
    rows = []
    for name in next(iter(found.values())):
        cells = []
        for k in range(len(SEEN_S) - 1):
            pairs = [(log[name][k], log[OWN][k]) for log in found.values()]
            ratios = np.array([np.log(np.divide(ours, own)) for ours, own in pairs if ours and own])
            if len(ratios):
                one, path = np.exp(0.5 * ratios[:, :CHANNELS].mean()), np.exp(ratios[:, CHANNELS].mean())
                cells.append(f"{one:.2f}, {path:.2f}")
            else:
                cells.append("")
        rows.append([name, *cells])
    ends = [f"{begin:g} to {end:g} s" if end < np.inf else f"after {begin:g} s" for begin, end in pairwise(SEEN_S)]
    return table(["", *ends], rows)


def main() -> None:
    """Draws cars, writes the models, and prints a table for each class."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("out/any_car"))
    add_data_option(parser)
    parser.add_argument("--only", default="", choices=["", *CLASSES], help="class of cars")
    parser.add_argument(
        "--vehicle", default="", help="vehicle file: writes a model for cars like this one, scores nothing"
    )
    parser.add_argument("--cars", type=int, default=45, help="that are drawn of a class")
    parser.add_argument("--test", action="store_true", help="on logs that are for publishing only")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    out = arguments.out / ("test" if arguments.test else "develop")
    out.mkdir(parents=True, exist_ok=True)
    classes = {name: of for name, of in CLASSES.items() if arguments.only in ("", name)}
    if arguments.vehicle:
        classes = {"": CarClass.about(arguments.vehicle)}
    for name, of in classes.items():
        start = Start.of(of, list(drives(of, arguments.cars, arguments.out / "cars")))
        print(start.save(start.layer(over_cars(start.cars)), f"dynssm_any_{of.name}", arguments.out).path)
        found = scored(name, start, out, arguments.data, arguments.test) if name else {}
        print(f"\n{page(found)}\n" if found else "")


if __name__ == "__main__":
    main()
