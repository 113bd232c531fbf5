"""SimulationWindows of simulation, the noise in them, and fits to them: exact where the truth is known."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from dynssm_ros import compiled
from dynssm_ros.identification.problem import compiled_simulation
from dynssm_ros.identification.problem.car import CarEstimate, prior_std
from dynssm_ros.identification.problem.fit import IdentificationProblem, position, with_values
from dynssm_ros.identification.problem.noise import Noise, NoiseResponse, fit_noise, weights
from dynssm_ros.identification.problem.windows import RecordedRows, SimulationWindows
from dynssm_ros.signals.recording import Recording
from dynssm_ros.signals.signal_map import Hold
from dynssm_ros.simulation.laps import simulate
from dynssm_ros.track.driver import Style
from dynssm_ros.track.tracks import load_track
from dynssm_ros.vehicle import COEFFICIENTS, Vehicle, load_vehicle
from dynssm_ros.vehicle.effects import EFFECTS
from dynssm_ros.vehicle.effects.base import CONTEXT_UNITS
from dynssm_ros.vehicle.integrators import Integrator
from dynssm_ros.vehicle.tape import trace

AV21 = load_vehicle("av21")
LAG = {"steering_lag": {"time_constant": 0.1}}


def windows(
    vehicle: Vehicle, noise: tuple[float, float, float] = (0.0, 0.0, 0.0), duration: float = 50.0
) -> SimulationWindows:
    run = simulate(vehicle, load_track("road_course"), duration=duration, noise=noise, seed=3)
    rows = np.concatenate([run.measured.T, run.feedback.T, (run.command - run.feedback).T])
    time = (run.time - run.time[0]) / 1e9
    track = RecordedRows(
        rows, {"t": time, "theta": run.pose[:, 2]}, vehicle.sampling_time, time, np.zeros(len(time), dtype=np.intp)
    )
    return SimulationWindows(track, np.arange(8, rows.shape[1] - 13, 12), 12, 8, "euler")


def test_the_true_car_makes_no_errors_and_a_wrong_one_does() -> None:
    some = windows(AV21)
    assert np.abs(some.errors(CarEstimate.of(AV21))).max() < 1e-9
    assert np.abs(some.errors(CarEstimate.of(AV21).with_effect("drag", {"coefficient": 0.3}))).max() > 1e-2


def test_a_lag_is_led_along_the_rows_before_the_start() -> None:
    lagging = AV21.with_effect("steering_lag", LAG["steering_lag"])
    some = windows(lagging)
    settled = replace(some, warm=0)
    assert (
        np.abs(some.errors(CarEstimate.of(lagging))).max()
        < 0.02 * np.abs(settled.errors(CarEstimate.of(lagging))).max()
    )
    in_fit = replace(CarEstimate.of(AV21), effects=LAG)
    np.testing.assert_array_equal(some.errors(in_fit), some.errors(CarEstimate.of(lagging)))


def test_between_two_speeds_the_drive_before_tells_the_gear() -> None:
    shifting = AV21.with_effect("gear_shift", {"factor": 0.7, "up": 34.0, "down": 24.0})
    some = windows(shifting)
    begin, upper = some.starts - some.warm, np.zeros(some.data.rows.shape[1])
    for row, speed in enumerate(some.data.rows[0]):
        upper[row] = 1.0 if speed > 34.0 else 0.0 if speed < 24.0 else upper[row - 1]
    misled = (some.data.rows[0, begin] > 29.0) != upper[begin]
    with_gears, without = (np.abs(some.errors(CarEstimate.of(car))).max(axis=(1, 2)) for car in (shifting, AV21))
    assert np.count_nonzero(misled) > 10
    assert with_gears.max() < 0.01 < without[misled].max()


def test_neither_another_recording_nor_what_was_before_a_gap_tells_the_gear() -> None:
    shift = EFFECTS["gear_shift"](factor=0.7, up=34.0, down=24.0)
    rows = np.zeros((7, 9))
    rows[0] = [36.0, 30.0, 30.0, 25.0, 25.0, 23.0, 30.0, 28.0, 28.0]  # the last two parts begin below the middle
    time, number = 0.02 * np.array([0, 1, 2, 0, 1, 2, 3, 9, 10]), np.repeat([0, 1], [3, 6])
    told = RecordedRows(rows, {}, 0.02, time, number).told_by(shift)
    assert told["gear_shift.gear"].tolist() == [1, 1, 1, 0, 0, 0, 0, 0, 0]
    assert RecordedRows(rows, {}, 0.02, 0.02 * np.arange(9), 0 * number).told_by(shift)["gear_shift.gear"][3] == 1
    assert RecordedRows(rows, {}, 0.02, time, number).told_by(EFFECTS["drag"](coefficient=0.1)) == {}


def test_simulations_in_blocks_are_those_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    some, car = windows(AV21), CarEstimate.of(AV21)
    cars = [car.with_effect("steering_lag", {"time_constant": value}) for value in (0.05, 0.1)]
    at_once = some.errors_of(cars)
    monkeypatch.setattr("dynssm_ros.identification.tuning.AT_ONCE", 7)
    np.testing.assert_array_equal(some.errors_of(cars), at_once)
    assert len(some) % 7


def test_steps_are_differentiated_by_their_start() -> None:
    some = windows(AV21, duration=10.0)
    at, car = some.starts[3], CarEstimate.of(AV21)
    moved = some.data.rows.copy()
    moved[1, at] += 1e-3
    changed = replace(some, data=replace(some.data, rows=moved)).errors(car)[3, 0] - some.errors(car)[3, 0]
    np.testing.assert_allclose(some.transitions(car)[3, 0, :, 1], changed / 1e-3, rtol=0.02, atol=1e-3)


def test_runge_kutta_steps_are_short_enough_for_the_car() -> None:
    some = windows(AV21, duration=20.0)
    chosen = some.with_integrator("rk4", AV21)
    fine = replace(chosen, substeps=16)
    coarse = chosen.errors(CarEstimate.of(AV21)) - fine.errors(CarEstimate.of(AV21))
    assert chosen.substeps <= 2
    assert np.abs(coarse).max() < 0.02 * np.abs(fine.errors(CarEstimate.of(AV21))).max()
    stiff = AV21.with_nominal(AV21.nominal * np.where(np.array(COEFFICIENTS) == "B_r", 4.0, 1.0))
    assert some.with_integrator("rk4", stiff).substeps > chosen.substeps
    assert some.with_integrator("euler", stiff).substeps == 1


def test_a_simulation_that_runs_away_counts_as_far_off_and_not_as_nan() -> None:
    some = windows(AV21, duration=10.0)
    wild = some.errors(CarEstimate.of(AV21).with_effect("steering_gain", {"factor": 1e200}))
    assert np.isfinite(wild).all()


def test_noise_is_recovered_and_whitened() -> None:
    stds = (0.02, 0.03, 0.004)
    some = windows(AV21, stds)
    problem = IdentificationProblem(some, CarEstimate.of(AV21))
    errors = problem.errors(CarEstimate.of(AV21))
    noise = problem.noise(errors)
    np.testing.assert_allclose(np.sqrt(noise.v[:3]), stds, rtol=0.1)
    assert (np.sqrt(noise.v[3:6]) < np.array(stds) / 4).all()
    white = noise.whiten(errors)
    assert (white**2).mean() == pytest.approx(1.0, abs=0.02)
    assert np.abs(np.corrcoef(white.T) - np.eye(white.shape[1])).max() < 0.5


def test_an_estimated_v_y_has_no_less_noise_than_its_recording_states() -> None:
    some = windows(AV21, (0.02, 0.03, 0.004), duration=20.0)
    errors = IdentificationProblem(some, CarEstimate.of(AV21)).errors(CarEstimate.of(AV21))
    stated = replace(some, data=replace(some.data, v_y_variance=0.2**2))
    measured, estimated = (
        np.sqrt(IdentificationProblem(one, CarEstimate.of(AV21)).noise(errors).v[:3]) for one in (some, stated)
    )
    assert measured[1] < 0.05
    assert estimated[1] >= 0.2 * (1 - 1e-9)
    assert estimated[2] == pytest.approx(measured[2], rel=0.3)


def test_disturbances_on_the_way_are_told_from_noise_of_the_measurement() -> None:
    rng, W, K = np.random.default_rng(0), 1500, 6
    keep = np.broadcast_to(0.8 * np.eye(3), (W, K, 3, 3))
    spread = NoiseResponse.of(keep, np.ones(W))
    R, Q = np.array([0.1, 0.2, 0.3]), np.array([0.05, 0.1, 0.2])
    state, errors = R * rng.standard_normal((W, 3)), []
    for _ in range(K):
        state = 0.8 * state + Q * rng.standard_normal((W, 3))
        errors.append(state - R * rng.standard_normal((W, 3)))
    found = fit_noise(spread, np.stack(errors, axis=1).reshape(W, -1), np.full(9, 0.01), np.full(9, 1e-12))
    np.testing.assert_allclose(np.sqrt(found.v), [*R, *Q, *R], rtol=0.12)


def test_a_filtered_start_is_closer_to_the_car_than_a_measured_row() -> None:
    some = windows(AV21, (0.02, 0.03, 0.004))
    noise = IdentificationProblem(replace(some, starts=some.starts[2:], warm=16, filtered=True), CarEstimate.of(AV21))
    R, _, P = noise.noise(noise.errors(CarEstimate.of(AV21))).v.reshape(3, 3)
    assert (P < 0.4 * R).all()


@pytest.mark.parametrize("filtered", [True, False])
def test_a_relaxing_tyre_is_not_taken_for_a_shorter_one_where_starts_are_filtered(filtered: bool) -> None:
    effect, free = "tire_relaxation", (("tire_relaxation", "length"),)
    some = windows(AV21.with_effect(effect, {"length": 0.8}), (0.02, 0.02, 0.003), duration=100.0)
    problem = IdentificationProblem(
        replace(some, starts=some.starts[2:], warm=16, filtered=filtered), CarEstimate.of(AV21)
    )
    fit = problem.fit(CarEstimate.of(AV21).with_effect(effect, {"length": 0.4}), free)
    off = (fit.car.effects[effect]["length"] - 0.8) / (0.3 * np.sqrt(problem.covariance(fit)[-1, -1]))
    assert abs(off) < 2.5 if filtered else off < -2.5


def test_a_window_that_is_far_out_counts_less() -> None:
    white = np.ones((3, 12))
    white[1] *= 20
    assert weights(white)[[0, 2]].tolist() == [1.0, 1.0]
    assert 0 < weights(white)[1] < 0.02


def test_whitening_undoes_what_the_covariance_says() -> None:
    spread = NoiseResponse.of(np.broadcast_to(0.9 * np.eye(3), (5, 4, 3, 3)), np.arange(5.0))
    noise = Noise(spread, np.array([1.0, 2.0, 3.0, 0.1, 0.2, 0.3, 0.5, 0.6, 0.7]))
    np.testing.assert_allclose(noise.whiten(np.stack([noise.roots[0]] * 5))[0], np.eye(12), atol=1e-12)
    assert noise.log_dets.sum() == pytest.approx(5 * np.linalg.slogdet(noise.roots[0] @ noise.roots[0].T)[1])


def test_a_fit_finds_planted_values_and_knows_how_well() -> None:
    stds = (0.01, 0.01, 0.002)
    some = windows(AV21.with_effect("drag", {"coefficient": 0.4}), stds)
    known = CarEstimate.of(AV21.with_nominal(AV21.nominal, 0.1 * prior_std(AV21)))
    problem = IdentificationProblem(some, known)
    free = (("drag", "coefficient"),)
    fit = problem.fit(known.with_effect("drag", {"coefficient": 0.0}), free)
    std = 0.2 * np.sqrt(problem.covariance(fit)[-1, -1])
    assert abs(fit.car.effects["drag"]["coefficient"] - 0.4) < 3 * std < 0.2
    assert problem.inflation(fit) < 1.5
    assert problem.inflation(fit, 1) < 3.0
    without = problem.fit(known, ())
    assert without.objective - fit.objective > 100


def test_values_are_placed_and_read_back_within_their_bounds() -> None:
    car, free = CarEstimate.of(AV21).with_effect("drag", {"coefficient": 0.2}), (("drag", "coefficient"),)
    p = position(car, free)
    assert with_values(car, free, p).effects == car.effects
    p[-1] = 1e3
    assert with_values(car, free, p).effects["drag"]["coefficient"] == 2.0
    p[:18] = 1e9
    theta = np.array(with_values(car, free, p).theta)
    assert ((AV21.lower < theta) & (theta < AV21.upper)).all()


def test_what_the_vehicle_file_does_not_say_is_known_by_its_bounds() -> None:
    open_car = AV21.with_nominal(AV21.nominal)
    coefficients = {name: c.model_copy(update={"std": None}) for name, c in open_car.coefficients.items()}
    open_car = open_car.model_copy(update={"coefficients": coefficients})
    np.testing.assert_allclose(prior_std(open_car), (AV21.upper - AV21.lower) / np.sqrt(12))
    stated = prior_std(AV21)[COEFFICIENTS.index("D_f")]
    assert stated == AV21.coefficients["D_f"].std


def test_the_extended_vehicle_is_the_car_as_fitted(laps: Callable[..., tuple[Recording, Vehicle]]) -> None:
    car = replace(CarEstimate.of(AV21), moved=np.full(18, 0.5)).with_effect("mass", {"factor": 1.1})
    covariance = np.diag(np.full(18, 0.25))
    covariance[0, 1] = covariance[1, 0] = -0.2
    vehicle = car.extended(covariance)
    assert vehicle.coefficients["B_f"].std == pytest.approx(0.5 * AV21.coefficients["B_f"].std * np.exp(0.5 * 0.25))
    assert vehicle.known_correlation[0, 1] == pytest.approx(-0.8, abs=1e-3)
    np.testing.assert_allclose(vehicle.nominal, np.array(car.theta))
    assert vehicle.constants.m == pytest.approx(790 * np.exp(0.005))
    assert [(entry.name, entry.parameters) for entry in vehicle.effects] == [("mass", {"factor": 1.1})]
    some = windows(AV21, duration=10.0)
    np.testing.assert_allclose(some.errors(CarEstimate.of(vehicle)), some.errors(car), atol=1e-12)


def test_lines_from_sample_to_sample_begin_a_sample_before_the_row_that_changes() -> None:
    held = np.repeat([0.0, 0.0, 3.0, 3.0, 6.0], 3)
    rows = np.zeros((7, 15))
    rows[3], rows[4] = held, np.arange(15.0)
    time = 0.02 * np.arange(15)
    time[12:] += 1.0  # a gap: the last sample is of another stretch
    one = np.zeros(15, dtype=np.intp)
    data = RecordedRows(rows, {}, 0.02, time, one, (3, 1))
    throttle, steering = data.lines
    np.testing.assert_allclose(throttle, [0, 0, 0, 0, 1, 2, 3, 3, 3, 3, 3, 3, 6, 6, 6])
    np.testing.assert_array_equal(steering, rows[4])
    two = RecordedRows(rows, {}, 0.02, 0.02 * np.arange(15), np.repeat([0, 1], [12, 3]), (3, 1))
    np.testing.assert_array_equal(two.lines, data.lines)


@pytest.mark.slow
@pytest.mark.parametrize("hold", ["zero", "first"])
def test_a_lag_is_seen_through_actuators_that_are_sampled_slowly(hold: Hold) -> None:
    """What a driver does between two samples is nearer to a line than to the older one, which is 0.05 s old in the mean."""
    car = load_vehicle("orca").with_effect("steering_lag", {"time_constant": 0.1})
    road, noise = load_track("club"), (0.002, 0.002, 0.005)
    run = simulate(car, road, duration=40.0, plant="rk4", noise=noise, seed=4, style=Style(0.6))
    rows = np.concatenate([run.measured.T, run.feedback.T, (run.command - run.feedback).T])
    applied = rows[3:5] + rows[5:]
    rows[3:5], rows[5:] = applied[:, np.arange(rows.shape[1]) // 5 * 5], 0.0
    time = (run.time - run.time[0]) / 1e9
    data = RecordedRows(rows, {"t": time}, car.sampling_time, time, np.zeros(len(time), dtype=np.intp), (5, 5))
    some = SimulationWindows(data, np.arange(40, rows.shape[1] - 13, 12), 12, 32, "rk4", 4, filtered=True, hold=hold)
    start = CarEstimate.of(load_vehicle("orca")).with_effect("steering_lag", {"time_constant": 0.05})
    fit = IdentificationProblem(some, start).fit(start, (("steering_lag", "time_constant"),))
    found = fit.car.effects["steering_lag"]["time_constant"]
    if hold == "first":
        assert found == pytest.approx(0.1, abs=0.015)
    else:
        assert found < 0.075


@pytest.mark.skipif(compiled.LIBRARY is None, reason="the compiled loops were not built")
@pytest.mark.parametrize(("integrator", "hold"), [("euler", "zero"), ("rk4", "first")])
def test_compiled_simulations_of_all_effects_are_numpys(
    monkeypatch: pytest.MonkeyPatch, acting: Callable[..., dict[str, float]], integrator: Integrator, hold: Hold
) -> None:
    some, rng = windows(AV21, (0.02, 0.03, 0.004), duration=4.0), np.random.default_rng(0)
    place = {name: rng.uniform(0.1, 1.0, len(some.data.time)) for name in CONTEXT_UNITS}
    some = replace(
        some, data=replace(some.data, context=place), integrator=integrator, hold=hold, substeps=2, every=3,
        filtered=integrator == "rk4",
    )  # fmt: skip
    car = CarEstimate.of(AV21)
    for name in EFFECTS:
        cars = [replace(car, moved=rng.normal(0.0, 0.2, 18)).with_effect(name, acting(name, s)) for s in (0.1, 0.2)]
        errors = some.errors_of(cars), some.errors_of([cars[0].with_effect(name, acting(name), only_in=(1,))])
        with monkeypatch.context() as without:
            without.setattr(compiled, "LIBRARY", None)
            by_numpy = some.errors_of(cars), some.errors_of([cars[0].with_effect(name, acting(name), only_in=(1,))])
        for found, expected in zip(errors, by_numpy, strict=True):
            np.testing.assert_allclose(found, expected, rtol=1e-11, atol=1e-11 * some.spread.max(), err_msg=name)


@pytest.mark.skipif(compiled.LIBRARY is None, reason="the compiled loops were not built")
def test_equations_are_traced_once_for_cars_that_differ_in_values(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compiled_simulation, "_KNOWN", {})
    some, car = windows(AV21, duration=4.0), CarEstimate.of(AV21)
    one, other = (car.with_effect("steering_lag", {"time_constant": value}) for value in (0.05, 0.1))
    absent = car.with_effect("steering_lag", {"time_constant": 0.0})
    other = replace(other, moved=np.full(18, 0.1))
    expected = some.errors(one), some.errors(other)
    with monkeypatch.context() as without:
        without.setattr(compiled, "LIBRARY", None)
        by_numpy = some.errors(other)
    monkeypatch.setattr(compiled_simulation, "trace", None)  # none is traced any more
    np.testing.assert_array_equal(some.errors_of([one, other]), expected)
    np.testing.assert_allclose(expected[1], by_numpy, rtol=1e-11, atol=1e-11)
    asked: list[int] = []
    monkeypatch.setattr(
        compiled_simulation, "trace", lambda function, inputs: asked.append(inputs) or trace(function, inputs)
    )
    some.errors(absent)
    assert asked, "without the lag it has other equations"
