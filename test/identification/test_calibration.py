"""Calibration: planted coefficients come back, their errors are what is claimed, and ignorance is admitted."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from dynssm_ros.errors import RecordingError
from dynssm_ros.learning.calibration import PredictionErrors, calibrate
from dynssm_ros.runtime.models import SingleTrack
from dynssm_ros.signals.extraction import extract
from dynssm_ros.signals.recording import Recording
from dynssm_ros.signals.signal_map import load_signal_map
from dynssm_ros.vehicle import COEFFICIENTS, Vehicle, load_vehicle

Drive = Callable[..., Recording]
NOISE = (2e-4, 2e-4, 5e-3)


def mid_range(vehicle: Vehicle) -> Vehicle:
    """The car before anybody measured it."""
    return vehicle.with_nominal((vehicle.lower + vehicle.upper) / 2)


def around(vehicle: Vehicle, fraction: float) -> Vehicle:
    """The same car with bounds of its nominal values plus and minus ``fraction`` of their range."""
    content = vehicle.model_dump()
    for name in COEFFICIENTS:
        entry = content["coefficients"][name]
        half = fraction * (entry["bounds"][1] - entry["bounds"][0])
        entry["bounds"] = (entry["nominal"] - half, entry["nominal"] + half)
    return Vehicle.model_validate(content)


def narrowed(vehicle: Vehicle, **bounds: tuple[float, float]) -> Vehicle:
    content = vehicle.model_dump()
    for name, interval in bounds.items():
        content["coefficients"][name] |= {"bounds": interval, "nominal": sum(interval) / 2}
    return Vehicle.model_validate(content)


@pytest.fixture(scope="module")
def noisy(drive: Drive, orca: Vehicle) -> Recording:
    """30 s of a pushed car that uses its tyres."""
    return drive(orca, 1500, seed=1, steering=0.09, noise=NOISE)


@pytest.fixture(scope="module")
def club(laps_bag: Path) -> Recording:
    return extract([laps_bag], load_signal_map("default"), 50.0)


# --- recovery -----------------------------------------------------------------------------------


def test_the_published_orca_car_is_recovered_exactly_and_holds_on_another_track(
    orca_bag: Path, club: Recording, orca: Vehicle
) -> None:
    recording = extract([orca_bag], load_signal_map("default"), 50.0)
    found = calibrate(recording, mid_range(orca), starts=3)
    assert found.rmse_after.max() < 1e-9
    assert (found.rmse_before > 1e-3).all()
    rows = club.window_ends(1)
    predicted = SingleTrack(found.vehicle).predict(club.matrix[rows][:, None]).state
    error = np.sqrt(((predicted - club.matrix[rows + 1, :3]) ** 2).mean(axis=0))
    assert (error < 1e-6).all()


def test_simulated_laps_give_the_coefficients_back(club: Recording, orca: Vehicle) -> None:
    found = calibrate(club, mid_range(orca), starts=2)
    np.testing.assert_allclose(found.theta, orca.nominal, atol=1e-6 * (orca.upper - orca.lower).max(), rtol=1e-5)
    assert found.rmse_after.max() < 1e-9
    assert found.on_bound == ()
    assert found.unidentified == ()


def test_errors_of_several_steps_give_them_back_too(drive: Drive, orca: Vehicle) -> None:
    found = calibrate(drive(orca, 400, steering=0.09), mid_range(orca), steps=3, starts=1)
    assert found.steps == 3
    assert found.rmse_after.max() < 1e-6
    assert found.rows == 400 - 3


def test_effects_of_the_vehicle_are_part_of_the_model(drive: Drive, orca: Vehicle) -> None:
    car = orca.with_effect("steering_offset", {"offset": 0.03}).with_effect("rear_grip", {"factor": 0.8})
    recording = drive(car, 800, steering=0.09)
    assert calibrate(recording, mid_range(car), starts=1).rmse_after.max() < 1e-6
    assert PredictionErrors(recording, orca).one_step_rmse(orca.nominal).max() > 1e-2


# --- with noise ---------------------------------------------------------------------------------


@pytest.mark.parametrize("loss", ["soft_l1", "linear"])
def test_estimates_lie_within_their_errors(noisy: Recording, orca: Vehicle, loss: str) -> None:
    found = calibrate(noisy, around(orca, 0.5), starts=1, loss=loss)  # type: ignore[arg-type]
    assert found.on_bound == ()
    pull = (found.theta - orca.nominal) / found.std
    assert np.abs(pull).max() < 3.5
    assert 0.3 < np.sqrt((pull**2).mean()) < 2.0
    assert (found.std < 0.5 * (orca.upper - orca.lower)).any()
    np.testing.assert_allclose(found.rmse_after, NOISE, rtol=0.1)


def test_errors_grow_with_the_noise(drive: Drive, orca: Vehicle) -> None:
    car = around(orca, 0.5)
    less, more = (
        calibrate(drive(orca, 1500, seed=2, steering=0.09, noise=tuple(factor * np.array(NOISE))), car, starts=1).std
        for factor in (0.05, 0.1)
    )
    known = more < 0.1 * (car.upper - car.lower)  # not by the bounds
    assert known.sum() > 8
    assert np.median(more[known] / less[known]) == pytest.approx(2.0, rel=0.15)


def test_the_calibrated_vehicle_carries_values_and_errors(noisy: Recording, orca: Vehicle) -> None:
    found = calibrate(noisy, around(orca, 0.5), starts=1)
    np.testing.assert_allclose(found.vehicle.nominal, found.theta)
    assert [found.vehicle.coefficients[name].std for name in COEFFICIENTS] == pytest.approx(found.std)
    assert found.vehicle.constants == orca.constants


def test_outliers_are_borne_by_the_robust_loss(noisy: Recording, orca: Vehicle) -> None:
    spoilt = {name: values.copy() for name, values in noisy.columns.items()}
    spoilt["omega"][200::97] += 5.0
    recording = Recording(noisy.info, noisy.time, noisy.segment, spoilt)
    car = around(orca, 0.5)
    robust, plain = (calibrate(recording, car, loss=loss, starts=1) for loss in ("soft_l1", "linear"))  # type: ignore[arg-type]
    deviation = [np.abs((each.theta - orca.nominal) / (car.upper - car.lower)).mean() for each in (robust, plain)]
    assert deviation[0] < 0.5 * deviation[1]


def test_the_seed_alone_decides(noisy: Recording, orca: Vehicle) -> None:
    first, second = (calibrate(noisy, around(orca, 0.5), starts=3, seed=7) for _ in range(2))
    np.testing.assert_array_equal(first.theta, second.theta)
    np.testing.assert_array_equal(first.std, second.std)


# --- what the data do not say -------------------------------------------------------------------


def test_a_coefficient_that_the_data_push_against_a_bound_is_named(noisy: Recording, orca: Vehicle) -> None:
    found = calibrate(noisy, narrowed(orca, I_z=(3.2e-5, 5.6e-5), C_m1=(0.1435, 0.25)), starts=1)
    assert {"I_z", "C_m1"} <= set(found.on_bound)
    index = COEFFICIENTS.index("I_z")
    assert found.theta[index] == pytest.approx(3.2e-5, rel=1e-3)
    assert found.std[index] == pytest.approx((5.6e-5 - 3.2e-5) / np.sqrt(12))
    assert found.vehicle.coefficients["I_z"].nominal >= 3.2e-5


def test_straight_driving_tells_the_drive_force_and_admits_that_it_tells_no_tyres(drive: Drive, orca: Vehicle) -> None:
    recording = drive(orca, 1500, steering=0.0, throttle=(0.35, 0.08), noise=NOISE)
    car = around(orca, 0.5)
    width = car.upper - car.lower
    car = car.with_nominal(car.nominal + 0.1 * width)
    found = calibrate(recording, car, starts=1)
    by_bounds = width / np.sqrt(12)
    for name in ("C_f", "D_f", "E_f", "C_r", "D_r", "E_r"):
        k = COEFFICIENTS.index(name)
        assert found.std[k] > 0.5 * by_bounds[k], name
        assert abs(found.theta[k] - car.nominal[k]) < 0.2 * width[k], name
    assert (found.std <= by_bounds * (1 + 1e-6)).all()
    assert found.std[COEFFICIENTS.index("C_m1")] < 0.2 * by_bounds[COEFFICIENTS.index("C_m1")]
    open_names = {name for combination in found.unidentified for name in combination}
    assert {"B_f", "C_f", "D_f"} & open_names
    assert {"B_r", "C_r", "D_r"} & open_names
    assert all(abs(weight) <= 1 for combination in found.unidentified for weight in combination.values())


# --- the errors that are minimised --------------------------------------------------------------


def test_errors_of_the_true_car_are_the_pushes(drive: Drive, orca: Vehicle) -> None:
    recording = drive(orca, 300, seed=5, noise=NOISE)
    errors = PredictionErrors(recording, orca)(orca.nominal)
    assert errors.shape == (3, 1, 299)
    pushes = np.random.default_rng(5)
    pushes.standard_normal(301 + 240)  # the two input signals come first
    pushes.standard_normal(301 + 90)
    np.testing.assert_allclose(errors[:, 0].T, -pushes.standard_normal((300, 3))[:-1] * NOISE, atol=1e-12)


def test_rows_are_thinned_to_the_limit_and_never_cross_a_gap_or_a_slow_stretch(drive: Drive, orca: Vehicle) -> None:
    recording = drive(orca, 900, segments=3)
    errors = PredictionErrors(recording, orca, steps=4, min_speed=1.6, limit=1000)
    assert len(errors.starts) * 4 <= 1000
    for start in errors.starts:
        touched = slice(start, start + 5)
        assert len(set(recording.segment[touched])) == 1
        assert recording["v_x"][touched].min() >= 1.6


def test_too_few_rows_are_refused(drive: Drive, orca: Vehicle) -> None:
    with pytest.raises(RecordingError, match=r"drive 0: only 39 usable rows at 0 m/s or more; expected at least 57"):
        calibrate(drive(orca, 40), orca)
    with pytest.raises(RecordingError, match="only 0 usable rows at 50 m/s or more"):
        calibrate(drive(orca, 200), orca, min_speed=50.0)


def test_another_sampling_time_is_refused(drive: Drive, orca: Vehicle) -> None:
    with pytest.raises(RecordingError, match=r"sampling time 0\.02 s, but vehicle av21 has 0\.04 s"):
        calibrate(drive(orca, 200), load_vehicle("av21"))


def test_progress_counts_the_starting_points_and_the_last_fit(drive: Drive, orca: Vehicle) -> None:
    told: list[tuple[int, int]] = []
    calibrate(drive(orca, 200), orca, starts=2, progress=lambda *counts: told.append(counts))
    assert told == [(1, 3), (2, 3), (3, 3)]
