"""Calibration: planted coefficients come back, their errors are what is claimed, and ignorance is admitted."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import dynssm_ros
from dynssm_ros.errors import RecordingError
from dynssm_ros.identification.result.calibration import Calibration, calibrate
from dynssm_ros.runtime.baselines import SingleTrack
from dynssm_ros.signals.extraction import extract
from dynssm_ros.signals.recording import Recording
from dynssm_ros.signals.signal_map import load_signal_map
from dynssm_ros.simulation.plant import PlantKind
from dynssm_ros.vehicle import COEFFICIENTS, Vehicle, load_vehicle

Drive = Callable[..., Recording]
NOISE = (2e-4, 2e-4, 5e-3)
SENSORS = (0.01, 0.01, 0.03)


def unknown(vehicle: Vehicle, **changes: dict[str, object]) -> Vehicle:
    """The same car of which nothing but the bounds is known, with other fields of some coefficients."""
    content = vehicle.model_dump()
    for name in COEFFICIENTS:
        content["coefficients"][name] |= {"std": None} | changes.get(name, {})
    return Vehicle.model_validate(content)


def mid_range(vehicle: Vehicle) -> Vehicle:
    """The car before anybody measured it."""
    return unknown(vehicle.with_nominal((vehicle.lower + vehicle.upper) / 2))


def around(vehicle: Vehicle, fraction: float) -> Vehicle:
    """The same car, known to lie within ``fraction`` of its ranges around the nominal values."""
    half = fraction * (vehicle.upper - vehicle.lower)
    lower = vehicle.nominal - half
    lower = np.where((vehicle.lower > 0) & (lower < 0), 0.1 * vehicle.nominal, lower)  # what is positive stays so
    bounds = zip(COEFFICIENTS, lower, vehicle.nominal + half, strict=True)
    return unknown(vehicle, **{name: {"bounds": (low, high)} for name, low, high in bounds})


@pytest.fixture(scope="module")
def noisy(drive: Drive, orca: Vehicle) -> Recording:
    """60 s of a pushed car that uses its tyres."""
    return drive(orca, 3000, seed=1, steering=0.09, noise=NOISE)


@pytest.fixture(scope="module")
def found(noisy: Recording, orca: Vehicle) -> Calibration:
    """What the noisy recording says of a car that is known roughly."""
    return calibrate(noisy, around(orca, 0.5), integrator="euler", starts=1)


@pytest.fixture(scope="module")
def club(laps_bag: Path) -> Recording:
    return extract([laps_bag], load_signal_map("default"), 50.0)


# --- recovery -----------------------------------------------------------------------------------


def test_the_published_orca_car_is_recovered_exactly_and_holds_on_another_track(
    orca_bag: Path, club: Recording, orca: Vehicle
) -> None:
    recording = extract([orca_bag], load_signal_map("default"), 50.0)
    found = calibrate(recording, mid_range(orca), integrator="euler", starts=1)
    assert found.rmse_after.max() < 1e-8
    assert (found.rmse_before > 1e-3).all()
    rows = club.window_ends(1)
    predicted = SingleTrack(found.vehicle).predict(club.matrix[rows][:, None]).state
    error = np.sqrt(((predicted - club.matrix[rows + 1, :3]) ** 2).mean(axis=0))
    assert (error < 1e-6).all()


@pytest.mark.parametrize("horizon", [0.02, pytest.param(0.1, marks=pytest.mark.slow), 0.5])
def test_simulated_laps_give_the_coefficients_back_over_any_horizon(
    club: Recording, orca: Vehicle, horizon: float
) -> None:
    found = calibrate(club, mid_range(orca), horizon=horizon, integrator="euler", starts=1)
    np.testing.assert_allclose(found.theta, orca.nominal, atol=1e-6 * (orca.upper - orca.lower).max(), rtol=1e-4)
    assert found.horizon == pytest.approx(horizon, abs=0.021)
    assert found.rmse_after.max() < 1e-7
    assert (found.on_bound, found.unidentified) == ((), ())


def test_effects_of_the_vehicle_are_part_of_the_model(drive: Drive, orca: Vehicle) -> None:
    car = orca.with_effect("steering_offset", {"offset": 0.03}).with_effect("rear_grip", {"factor": 0.8})
    recording = drive(car, 1500, steering=0.09)
    assert calibrate(recording, mid_range(car), integrator="euler", starts=1).rmse_after.max() < 1e-6
    other = calibrate(recording.select(slice(0, 700)), orca, integrator="euler", starts=1)
    assert other.rmse_before.max() > 1e-2, "of the file, whatever is fitted"


@pytest.mark.slow
@pytest.mark.parametrize(("plant", "chosen"), [("euler", "euler"), ("rk4", "rk4")])
def test_the_data_choose_how_the_model_steps(orca: Vehicle, plant: PlantKind, chosen: str) -> None:
    """Euler steps fitted to a continuous car make a yaw inertia of their own."""
    laps = dynssm_ros.recorded(dynssm_ros.simulate(orca, "club", duration=20.0, plant=plant, noise=SENSORS, seed=3))
    width = orca.upper - orca.lower
    car = unknown(
        orca.with_nominal(orca.nominal + 0.1 * np.where(orca.nominal < orca.lower + width / 2, width, -width))
    )
    found = calibrate(laps, car, starts=1)
    assert (found.vehicle.integrator, found.vehicle.model_integrator) == (chosen, chosen)
    assert found.vehicle.coefficients["I_z"].nominal == pytest.approx(orca.coefficients["I_z"].nominal, rel=0.05)
    if plant == "rk4":
        wrong = calibrate(laps, car, integrator="euler", starts=1)
        assert wrong.vehicle.coefficients["I_z"].nominal > 1.2 * orca.coefficients["I_z"].nominal


# --- with noise ---------------------------------------------------------------------------------


def test_estimates_lie_within_their_errors(drive: Drive, orca: Vehicle) -> None:
    pulls = []
    for seed in (1, 2, 3):
        found = calibrate(
            drive(orca, 3000, seed=seed, steering=0.09, noise=NOISE), around(orca, 0.5), integrator="euler", starts=1
        )
        assert found.on_bound == ()
        assert (found.std < 0.3 * (orca.upper - orca.lower)).any()
        np.testing.assert_allclose(found.rmse_after, NOISE, rtol=0.1)
        pulls.append((found.theta - orca.nominal) / found.std)
    assert np.abs(pulls).max() < 4.0
    assert 0.3 < np.sqrt(np.square(pulls).mean()) < 1.7


def test_what_was_known_before_counts(noisy: Recording, orca: Vehicle, found: Calibration) -> None:
    """A coefficient whose value the file states well stays there, and the others are known better for it."""
    known = {name: {"std": 1e-4 * abs(orca.coefficients[name].nominal)} for name in ("B_f", "C_f", "E_f")}
    told = calibrate(noisy, unknown(orca, **known), integrator="euler", starts=1)
    for name in known:
        k = COEFFICIENTS.index(name)
        assert told.theta[k] == pytest.approx(orca.nominal[k], rel=1e-3)
        assert told.std[k] <= 1.001 * known[name]["std"]
    assert told.std[COEFFICIENTS.index("D_f")] < 0.5 * found.std[COEFFICIENTS.index("D_f")]


def test_errors_grow_with_the_noise(drive: Drive, orca: Vehicle) -> None:
    car = around(orca, 0.5)
    less, more = (
        calibrate(
            drive(orca, 3000, seed=2, steering=0.09, noise=tuple(factor * np.array(NOISE))),
            car,
            integrator="euler",
            starts=1,
        ).std
        for factor in (0.05, 0.1)
    )
    known = more < 0.1 * (car.upper - car.lower)  # not by the bounds
    assert known.sum() > 8
    assert np.median(more[known] / less[known]) == pytest.approx(2.0, rel=0.2)


def test_the_calibrated_vehicle_carries_values_and_errors(orca: Vehicle, found: Calibration) -> None:
    np.testing.assert_allclose(found.vehicle.nominal, found.theta)
    assert [found.vehicle.coefficients[name].std for name in COEFFICIENTS] == pytest.approx(found.std)
    assert found.vehicle.constants == orca.constants


@pytest.mark.slow
def test_outliers_hardly_move_it(noisy: Recording, orca: Vehicle, found: Calibration) -> None:
    spoilt = {name: values.copy() for name, values in noisy.columns.items()}
    spoilt["omega"][200::397] += 5.0
    recording = Recording(noisy.info, noisy.time, noisy.segment, spoilt)
    car = around(orca, 0.5)
    with_outliers = calibrate(recording, car, integrator="euler", starts=1)
    off = np.abs(with_outliers.theta - found.theta) / (car.upper - car.lower)
    assert np.median(off) < 0.02


@pytest.mark.slow
def test_the_seed_alone_decides(noisy: Recording, orca: Vehicle) -> None:
    part, car = noisy.select(slice(0, 800)), around(orca, 0.5)
    first, second = (calibrate(part, car, integrator="euler", starts=3, seed=7) for _ in range(2))
    np.testing.assert_array_equal(first.theta, second.theta)
    np.testing.assert_array_equal(first.std, second.std)


# --- what the data do not say -------------------------------------------------------------------


def test_a_coefficient_that_the_data_push_against_a_bound_is_named(noisy: Recording, orca: Vehicle) -> None:
    limits = {"I_z": (3.2e-5, 5.6e-5), "C_m1": (0.1435, 0.25)}
    car = unknown(orca, **{name: {"bounds": b, "nominal": sum(b) / 2} for name, b in limits.items()})
    found = calibrate(noisy, car, integrator="euler", starts=1)
    assert set(limits) <= set(found.on_bound)
    assert found.theta[COEFFICIENTS.index("I_z")] == pytest.approx(3.2e-5, rel=2e-3)
    assert found.vehicle.coefficients["I_z"].nominal >= 3.2e-5


@pytest.mark.slow
def test_straight_driving_tells_the_drive_force_and_admits_that_it_tells_no_tyres(drive: Drive, orca: Vehicle) -> None:
    recording = drive(orca, 3000, steering=0.0, throttle=(0.35, 0.08), noise=NOISE)
    car = around(orca, 0.5)
    width = car.upper - car.lower
    car = car.with_nominal(car.nominal + 0.1 * width)
    found = calibrate(recording, car, integrator="euler", starts=1)
    by_bounds = width / np.sqrt(12)
    for name in ("C_f", "D_f", "C_r", "D_r"):
        k = COEFFICIENTS.index(name)
        assert found.std[k] > 0.4 * by_bounds[k], name
        assert abs(found.theta[k] - car.nominal[k]) < 0.2 * width[k], name
    assert found.std[COEFFICIENTS.index("C_m1")] < 0.3 * by_bounds[COEFFICIENTS.index("C_m1")]
    open_names = {name for combination in found.unidentified for name in combination}
    assert {"B_f", "C_f", "D_f"} & open_names
    assert {"B_r", "C_r", "D_r"} & open_names
    assert all(abs(weight) <= 1 for combination in found.unidentified for weight in combination.values())


# --- bad input ----------------------------------------------------------------------------------


def test_short_recordings_are_cut_into_shorter_stretches_and_too_short_ones_refused(
    drive: Drive, orca: Vehicle
) -> None:
    assert calibrate(drive(orca, 400), orca, starts=1).horizon == pytest.approx(0.26)
    with pytest.raises(
        RecordingError, match=r"drive 0: 14 stretches of 0\.52 s at 0 m/s or more; expected at least 24"
    ):
        calibrate(drive(orca, 400), orca, horizon=0.5)
    with pytest.raises(RecordingError, match=r"0 stretches of 0\.1 s at 50 m/s or more"):
        calibrate(drive(orca, 1500), orca, min_speed=50.0)


def test_another_sampling_time_is_refused(drive: Drive, orca: Vehicle) -> None:
    with pytest.raises(RecordingError, match=r"sampling time 0\.02 s, but vehicle av21 has 0\.04 s"):
        calibrate(drive(orca, 200), load_vehicle("av21"))


def test_progress_counts_the_starting_points_of_each_integrator_and_the_last_fit(drive: Drive, orca: Vehicle) -> None:
    calls: list[tuple[int, int]] = []
    calibrate(drive(orca, 500), orca, starts=2, on_progress=lambda *counts: calls.append(counts))
    assert calls == [(1, 5), (2, 5), (3, 5), (4, 5), (5, 5)]


@pytest.mark.slow
def test_a_model_that_lacks_something_says_how_little_it_knows_of_other_drives() -> None:
    """A tyre that gains less force than load makes the yaw inertia depend on how the car is driven, and its error says so."""
    car = load_vehicle("av21").unmeasured()
    theta, std = [], []
    for seed, aggressiveness in ((1, 0.6), (2, 0.85)):
        run = dynssm_ros.simulate(
            "av21", "road_course", duration=90.0, plant="rk4", seed=seed, aggressiveness=aggressiveness, variation=0.6,
            noise=(0.02, 0.02, 0.003), effects={"load_sensitivity": {"exponent": 0.6}},
        )  # fmt: skip
        found = calibrate(dynssm_ros.recorded(run), car, integrator="rk4", starts=1)
        theta.append(found.theta)
        std.append(found.std)
    off = (theta[1] - theta[0]) / np.hypot(*std)
    assert abs(off[COEFFICIENTS.index("I_z")]) < 2.0
    assert np.all(np.abs(off) < 3.0)
    assert std[0][COEFFICIENTS.index("I_z")] < 0.05 * theta[0][COEFFICIENTS.index("I_z")]
