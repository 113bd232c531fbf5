"""Coefficients that follow the car: planted changes appear, an unchanged car stays as calibrated, whatever the noise."""

from functools import cache

import numpy as np
import pytest

import dynssm_ros
from dynssm_ros import compiled
from dynssm_ros.errors import ConfigurationError
from dynssm_ros.runtime.coefficients import BlockErrors, CoefficientEstimator
from dynssm_ros.vehicle import COEFFICIENTS, load_vehicle

ORCA = load_vehicle("orca")
NOISE = np.array([0.01, 0.01, 0.03])
AT = {name: k for k, name in enumerate(COEFFICIENTS)}


@cache
def laps(factor=1.0, seed=3, **effects):
    run = dynssm_ros.simulate(
        "orca", "club", duration=40.0, seed=seed, noise=tuple(factor * NOISE),
        effects={name: dict(values) for name, values in effects.items()},
    )  # fmt: skip
    return dynssm_ros.recorded(run)


def estimator(factor=1.0, car=ORCA, **how):
    """One that knows what is usual from laps of the unchanged car."""
    usual = laps(factor, seed=9)
    scale = np.diff(usual.matrix[:, :3], axis=0).std(axis=0)
    first = CoefficientEstimator(car, scale, BlockErrors(np.ones(3), np.ones(3)), **how)
    rows, increments = usual.matrix[:-1], np.diff(usual.matrix[:, :3], axis=0)
    errors = first.usual_errors([(np.arange(len(rows)), lambda block: (rows[block], increments[block]))])
    return CoefficientEstimator(car, scale, errors, **how)


def follow(found, recording, seconds=None):
    """Coefficients after each row, ``(N, 17)``."""
    path = []
    count = len(recording) - 1 if seconds is None else round(seconds / recording.T_s)
    for k in range(count):
        found.step(recording.matrix[k], recording.matrix[k + 1, :3] - recording.matrix[k, :3])
        path.append(found.theta)
    return np.array(path)


def changed(theta):
    return theta / ORCA.nominal - 1.0


@pytest.mark.parametrize(
    ("effects", "coefficient", "expected", "tolerance"),
    [
        ({"front_grip": {"factor": 0.8}, "rear_grip": {"factor": 0.8}}, "D_f", -0.2, 0.05),
        ({"front_grip": {"factor": 0.8}, "rear_grip": {"factor": 0.8}}, "D_r", -0.2, 0.05),
        ({"mass": {"factor": 1.1}}, "D_f", -0.07, 0.05),  # the same forces on 1.1 times the mass
        ({"mass": {"factor": 1.1}}, "D_r", -0.07, 0.05),
    ],
)
def test_a_planted_change_appears_within_two_seconds_of_driving_at_the_limit(effects, coefficient, expected, tolerance):
    found = estimator()
    frozen = {name: tuple(values.items()) for name, values in effects.items()}
    path = follow(found, laps(**frozen), 2.4)  # the first 0.4 s are straight
    assert found.belief > 0.9
    assert changed(path[-1])[AT[coefficient]] == pytest.approx(expected, abs=tolerance)
    assert 0.0 < found.std[AT[coefficient]] / ORCA.nominal[AT[coefficient]] < 0.1


def test_a_planted_steering_offset_appears_as_a_shift_of_the_front_slip_angle():
    found = estimator()
    path = follow(found, laps(steering_offset=(("offset", 0.015),)), 2.4)
    assert path[-1, AT["S_hf"]] - ORCA.nominal[AT["S_hf"]] == pytest.approx(0.015, abs=0.003)


@pytest.mark.parametrize("factor", [1.0, 3.0])
def test_the_coefficients_of_an_unchanged_car_scatter_by_less_than_3_percent(factor):
    path = follow(estimator(factor), laps(factor))
    scatter = np.sqrt(np.mean(changed(path) ** 2, axis=0))
    scatter[[AT["S_hf"], AT["S_hr"]]] = np.abs(path - ORCA.nominal)[:, [AT["S_hf"], AT["S_hr"]]].max(axis=0)
    assert np.all(scatter < 0.03)


def test_stated_deviations_are_those_of_the_errors():
    within = []
    for seed in range(4):
        found = estimator()
        path = follow(found, laps(1.0, 20 + seed, front_grip=(("factor", 0.8),)), 15.0)
        error = path[-1] - np.where(np.arange(17) == AT["D_f"], 0.8, 1.0) * ORCA.nominal
        within.append(np.abs(error[found.adapted]) < 2.5 * found.std[found.adapted])
    assert np.mean(within) > 0.9


def test_coefficients_stay_within_their_bounds_whatever_is_measured():
    found = estimator()
    rng = np.random.default_rng(0)
    recording = laps()
    for row in recording.matrix[:1500]:
        found.step(row, rng.normal(scale=20.0, size=3))
        assert np.all((found.theta >= ORCA.lower) & (found.theta <= ORCA.upper))
        assert np.isfinite(found.std).all()
    found.step(np.full(7, np.nan), np.zeros(3))
    for row in recording.matrix[:50]:
        found.step(row, np.zeros(3))
    assert np.isfinite(found.theta).all()


def test_coefficients_that_are_not_named_stay_as_calibrated():
    path = follow(estimator(spread={"D_f": 0.15}), laps(front_grip=(("factor", 0.8),)), 10.0)
    others = np.delete(np.arange(17), AT["D_f"])
    np.testing.assert_array_equal(path[-1, others], ORCA.nominal[others])
    assert changed(path[-1])[AT["D_f"]] < -0.1
    still = follow(estimator(spread={}), laps(front_grip=(("factor", 0.8),)), 3.0)
    np.testing.assert_array_equal(still[-1], ORCA.nominal)
    with pytest.raises(ConfigurationError, match="spread: unknown D_x"):
        estimator(spread={"D_x": 0.1})


def test_it_goes_on_from_what_was_kept():
    recording = laps(front_grip=(("factor", 0.8),))
    one, other = estimator(), estimator()
    follow(one, recording, 6.0)
    other.restore(one.kept())
    np.testing.assert_array_equal(other.theta, one.theta)
    np.testing.assert_array_equal(other.std, one.std)
    assert other.evidence == one.evidence


def test_effect_states_are_carried_through_a_block():
    car = ORCA.with_effect("steering_lag", {"time_constant": 0.05})
    path = follow(estimator(car=car), laps(1.0, 5), 3.0)
    assert np.isfinite(path).all()
    assert np.abs(changed(path[-1])).max() > 0.0


def test_a_complete_block_counts_once_it_is_asked_for_or_the_next_row_comes():
    recording = laps(front_grip=(("factor", 0.8),))
    one, other = estimator(), estimator()
    paths = [[], []]
    for k in range(200):
        for found, path in zip((one, other), paths, strict=True):
            found.step(recording.matrix[k], recording.matrix[k + 1, :3] - recording.matrix[k, :3])
            path.append(found.theta)
        if k % 3:
            other.finish()
    np.testing.assert_array_equal(*paths)
    changes = np.flatnonzero(np.any(np.diff(paths[0], axis=0), axis=1)) + 1
    assert len(changes)
    assert not (changes % one.rows).any(), "with the row after the last of a block"
    one.finish()
    other.interrupt()
    np.testing.assert_array_equal(one.theta, other.theta)


@pytest.mark.parametrize("effects", [(), (("steering_lag", (("time_constant", 0.05),)),)])
def test_blocks_are_the_same_with_and_without_the_compiled_loop(effects, library, monkeypatch):
    monkeypatch.setattr(compiled, "LIBRARY", library)
    car = ORCA
    for name, values in effects:
        car = car.with_effect(name, dict(values))
    found, rows = estimator(car=car), laps(1.0, 5).matrix
    cars = car.nominal * np.random.default_rng(0).uniform(0.8, 1.2, (5, 17))
    fast = found._mean_increments(rows[: found.rows], cars)
    monkeypatch.setattr(compiled, "LIBRARY", None)
    np.testing.assert_allclose(fast, found._mean_increments(rows[: found.rows], cars), rtol=1e-10, atol=1e-13)
