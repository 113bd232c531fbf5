"""A prior over cars: a planted one is found, what sensors do to a drive is as said, the model folder is one."""

from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks import any_car, drawn_cars
from benchmarks.any_car import OWN, Errors, OverCars, Start, over_cars
from benchmarks.drawn_cars import CarClass
from dynssm_ros.errors import ConfigurationError
from dynssm_ros.evaluation.open_loop import accuracies
from dynssm_ros.learning.online import Moments
from dynssm_ros.runtime.baselines import Persistence
from dynssm_ros.runtime.registry import load_model
from dynssm_ros.vehicle import Vehicle
from dynssm_ros.vehicle.effects import EFFECTS

RACERS = drawn_cars.CLASSES["racer"]
MEAN, DEVIATIONS, NOISE = np.array([0.5, -1.0, 0.0]), np.array([0.3, 0.2, 1.0]), 0.2


def planted(cars: int, rows: int) -> tuple[list[Moments], np.ndarray]:
    """Drives of cars whose weights ``(cars, 3, 3)`` are drawn, the first two correlated: the errors are theirs, and noise."""
    rng, found, drawn = np.random.default_rng(3), [], []
    for _ in range(cars):
        z = rng.standard_normal((3, 3))
        weights = MEAN + DEVIATIONS * np.stack([z[:, 0], 0.8 * z[:, 0] + 0.6 * z[:, 1], z[:, 2]], axis=1)
        F = rng.standard_normal((rows, 3, 3))
        left = np.einsum("kci,ci->kc", F, weights) + NOISE * rng.standard_normal((rows, 3))
        gram, moment = np.einsum("kci,kcj->cij", F, F), np.einsum("kci,kc->ci", F, left)
        found.append(Moments(rows, gram, moment, np.sum(left**2, axis=0)))
        drawn.append(weights)
    return found, np.array(drawn)


@pytest.mark.parametrize(("rows", "tolerance"), [(12, 0.15), (200, 0.03)])
def test_the_prior_over_cars_is_the_planted_one_however_short_the_drives(rows: int, tolerance: float) -> None:
    cars, weights = planted(400, rows)
    prior = over_cars(cars, believed=1.0, doubt=0.0)
    for c in range(3):
        np.testing.assert_allclose(
            prior.mean[c] - [1.0, 0.0, 0.0], weights[:, c].mean(axis=0), atol=tolerance * DEVIATIONS.min()
        )
        deviations = np.outer(DEVIATIONS, DEVIATIONS)
        np.testing.assert_allclose(
            prior.covariance[c] / deviations, np.cov(weights[:, c].T) / deviations, atol=tolerance
        )
    np.testing.assert_allclose(prior.noise, NOISE**2, rtol=tolerance)


def test_doubt_widens_the_prior_of_few_cars() -> None:
    cars, _ = planted(2, 100)
    sure, doubting = (over_cars(cars, believed=1.0, doubt=doubt) for doubt in (0.0, 0.1))
    assert np.linalg.eigvalsh(sure.covariance).min() < 1e-3
    assert np.linalg.eigvalsh(doubting.covariance).min() > 0.5 * 0.1**2


def test_cars_are_drawn_within_their_bounds_and_the_same_again() -> None:
    middle = RACERS.middle
    cars = []
    for seed in range(20):
        with suppress(ConfigurationError):  # an effect that cannot act on such a car
            cars.append(drawn_cars.drawn(RACERS, seed)[0])
    assert len(cars) > 12
    theta = np.array([car.nominal for car in cars])
    assert ((theta >= middle.lower) & (theta <= middle.upper)).all()
    assert (theta.std(axis=0) > 0.3 * np.array([std or 0.0 for std in middle.std])).all()
    lagging = np.mean(["steering_lag" in {each.NAME for each in car.active_effects} for car in cars])
    assert 0.4 < lagging < 1.0
    assert len({each.NAME for car in cars for each in car.active_effects}) > 6
    assert {each.NAME for car in cars for each in car.active_effects} <= {*EFFECTS}
    assert drawn_cars.drawn(RACERS, 0) == drawn_cars.drawn(RACERS, 0)


@pytest.mark.parametrize("file", ["f1tenth", "indy"])
def test_cars_like_that_of_a_file_can_be_driven(file: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(drawn_cars, "SECONDS", 1.0)
    of = CarClass.about(file)
    assert of.throttle_steps == (file == "indy")
    logs = [log for seed in range(2) if (log := drawn_cars.drive(of, seed)) is not None]
    assert logs
    assert all(log.info.set_point == of.middle.inputs.set_point for log in logs)
    largest = max(np.abs(log["v_x"] * log["omega"]).max() for log in logs)
    assert 0.5 < largest < 20.0, "bends at the usual share of grip"


def test_smoothing_is_the_slope_of_a_quadratic_through_the_path() -> None:
    line = 0.1 * np.arange(200.0)
    np.testing.assert_allclose(drawn_cars.smoothed(line, 9)[10:-10], line[10:-10], atol=1e-9)
    np.testing.assert_array_equal(drawn_cars.smoothed(line, 1), line)
    noise = np.random.default_rng(0).standard_normal(50_000)
    rows = np.arange(-4, 5)  # of the path, weighed by themselves over 60, the sum of their squares
    after = np.array([np.sum(rows[rows > row]) + row / 2 for row in rows]) / 60
    assert after.sum() == pytest.approx(1.0)
    assert drawn_cars.smoothed(noise, 9)[10:-10].std() == pytest.approx(np.sqrt(np.sum(after**2)), rel=0.03)


def test_sensors_hold_inputs_and_blur_speeds_and_a_seed_gives_the_same_again(drive: Any, orca: Vehicle) -> None:
    log = drive(orca, 400)
    for seed in range(5):
        seen = drawn_cars.measured(log, RACERS, seed)
        assert seen.info.commands == "none"
        assert not seen["r_cmd"].any()
        rows = np.flatnonzero(np.diff(seen["delta_fb"], prepend=np.nan))
        np.testing.assert_array_equal(seen["delta_fb"][rows], log["delta_fb"][rows])
        assert len(rows) >= 400 / 5
        blur = np.abs(seen["v_x"] - log["v_x"])[20:-20]
        assert 0 < blur.max() < 0.3
    np.testing.assert_array_equal(drawn_cars.measured(log, RACERS, 4).matrix, seen.matrix)


@pytest.fixture(scope="module")
def start(drive: Any) -> Start:
    """Of three drives of the class's middle car, each with noise of its own."""
    car = RACERS.middle.model_copy(update={"integrator": "euler"})
    logs = [drive(car, 500, seed=seed, noise=(0.005, 0.005, 0.02)) for seed in range(3)]
    return Start.of(RACERS, [log.with_commands("none") for log in logs])


def test_the_model_folder_holds_the_prior_and_predicts(start: Start, tmp_path: Path) -> None:
    prior = over_cars(start.cars)
    start.save(start.layer(prior), "dynssm_any_racer", tmp_path)
    model = load_model(tmp_path / "dynssm_any_racer")
    layer = model.online
    assert layer is not None
    for of_file, fitted in zip((layer.mean, layer.covariance, layer.noise, layer.physics), prior, strict=True):
        np.testing.assert_array_equal(of_file, fitted)
    found = accuracies(start.recording, {"any": model, "persistence": Persistence()})
    assert found["any"].rmse[2] < found["persistence"].rmse[2]


def test_a_layer_with_the_prior_begins_better_than_one_without(start: Start) -> None:
    log = start.recording.select(slice(1000, None))
    errors = {
        name: any_car.of_layer(start.layer(prior), start.features, log, start.base)
        for name, prior in (("prior", over_cars(start.cars[:2])), ("none", OverCars.undecided(start.cars[:2])))
    }
    assert errors["prior"].squares[:50].mean(axis=0) == pytest.approx(
        errors["none"].squares[:50].mean(axis=0), rel=0.99
    )
    assert (errors["prior"].squares[:50].mean(axis=0) < errors["none"].squares[:50].mean(axis=0)).all()
    alone = any_car.of_model(Persistence(), log, start.base)
    np.testing.assert_array_equal(alone.starts, errors["none"].starts)
    np.testing.assert_allclose(alone.squares, np.diff(log.matrix[:, :3], axis=0)[start.base.H - 1 :] ** 2, atol=1e-12)


def test_errors_are_sorted_by_the_time_that_was_seen() -> None:
    squares = np.repeat([[1.0], [4.0], [9.0]], [100, 400, 500], axis=0) * np.ones(3)
    starts = np.arange(0, 1000, 10)
    table = Errors(squares, starts, np.where(starts < 100, 2.0, 3.0)).table(0.02)
    assert table == [[1.0, 1.0, 1.0, 2.0], [4.0, 4.0, 4.0, 3.0], [9.0, 9.0, 9.0, 3.0], None]


def test_the_page_compares_with_rls_on_own_laps() -> None:
    own = [[1.0, 1.0, 1.0, 2.0], None, None, None]
    other = [[4.0, 4.0, 4.0, 1.0], None, None, None]
    text = any_car.page({"a": {"ours": other, OWN: own}, "b": {"ours": other, OWN: own}})
    assert "| ours | 2.00, 0.50 | | | |" in text
    assert f"| {OWN} | 1.00, 1.00 | | | |" in text
