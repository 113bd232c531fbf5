"""What errors of single steps tell: when something recurs, and that noise does not."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from dynssm_ros.vehicle.effects.step_errors import StepErrors, bent_drive, changed_above, recurring_step, shift_speeds


def steps(errors: np.ndarray, T_s: float, begin: float = 6400.0) -> StepErrors:
    clock = begin + T_s * np.arange(len(errors))
    return StepErrors(np.zeros((7, len(errors))), {"clock": clock}, errors, np.zeros(len(errors), dtype=np.intp), T_s)


def noise(N: int, seed: int) -> np.ndarray:
    """Errors of steps between states with white noise."""
    return np.diff(np.random.default_rng(seed).standard_normal((N + 1, 3)), axis=0)


@pytest.mark.parametrize(("period", "T_s"), [(1.0, 0.04), (0.2, 0.02), (0.734, 0.02), (2.0, 0.04)])
@pytest.mark.parametrize("channel", [0, 2])
def test_a_planted_step_is_found_in_its_row(period: float, T_s: float, channel: int) -> None:
    errors, instant = noise(4000, 3), 0.37
    clock = 6400.0 + T_s * np.arange(len(errors))
    passed = np.floor((clock + T_s) / period - instant) - np.floor(clock / period - instant)
    errors[passed > 0, channel] -= 2.0
    found = recurring_step(steps(errors, T_s))
    assert found is not None
    assert found.period == pytest.approx(period, rel=1e-4)
    foretold = np.floor((clock + T_s) / found.period - found.phase) - np.floor(clock / found.period - found.phase)
    assert np.mean((foretold > 0) & (passed > 0)) > 0.85 * np.mean(
        passed > 0
    )  # where rows do not fall in with the period


@pytest.mark.parametrize("heavy", [False, True])
def test_noise_has_no_step_that_recurs(heavy: bool) -> None:
    rng = np.random.default_rng(0)
    for seed in range(5):
        errors = noise(3000, seed) * (np.exp(rng.standard_normal((3000, 1))) if heavy else 1.0)
        assert recurring_step(steps(errors, 0.04)) is None


def test_a_smooth_wave_is_no_step() -> None:
    wave = 2.0 * np.sin(2 * np.pi * 1.0 * 0.04 * np.arange(4000))[:, None]
    assert recurring_step(steps(noise(4000, 1) + wave, 0.04)) is None


def test_what_is_too_short_or_constant_tells_nothing() -> None:
    assert recurring_step(steps(noise(40, 1), 0.04)) is None
    assert recurring_step(steps(np.zeros((3000, 3)), 0.04)) is None


def test_a_gear_stays_until_the_other_speed_is_passed() -> None:
    speed = np.array([14.0, 15.0, 17.0, 14.0, 12.0, 14.0, 15.9, 16.1])
    assert changed_above(speed, 16.0, 13.0).tolist() == [0, 0, 1, 1, 0, 0, 0, 1]
    assert changed_above(np.array([15.0, 14.0, 12.9]), 16.0, 13.0).tolist() == [1, 1, 0]


def accelerating(force: float, seed: int) -> StepErrors:
    """Speeding up and slowing down between 8 and 24 m/s; from 16 m/s on the drive has ``force`` (m/s per row) more."""
    N, T_s = 5000, 0.04
    rng, time = np.random.default_rng(seed), T_s * np.arange(N)
    v_x, r = 16.0 - 8.0 * np.cos(0.4 * time), 0.5 + 0.4 * np.sin(1.7 * time)
    rows = np.zeros((7, N))
    rows[0], rows[3] = v_x, r
    errors = 0.02 * np.diff(rng.standard_normal((N + 1, 3)), axis=0)
    errors[:, 0] += force * np.maximum(r, 0.0) * changed_above(v_x, 16.0, 13.0) + 0.004 * r * v_x / 16.0
    return StepErrors(rows, {}, errors, np.zeros(N, dtype=np.intp), T_s)


def test_the_speeds_of_a_gear_change_are_found_where_there_is_one() -> None:
    found = shift_speeds(accelerating(0.02, 1))
    assert found is not None
    assert found == pytest.approx((16.0, 13.0), abs=1.0)
    assert [shift_speeds(accelerating(0.0, seed)) for seed in range(6)] == [None] * 6


def test_changes_that_a_gear_sensor_or_the_engine_speed_tells_are_the_ones_tried() -> None:
    drive = accelerating(0.02, 1)
    v_x = drive.rows[0]
    gear = 1.0 + changed_above(v_x, 10.0, 9.0) + changed_above(v_x, 16.0, 13.0)
    engine = v_x * np.array([0.0, 40.0, 25.0, 16.0])[gear.astype(int)] * (1.0 + 0.01 * np.sin(np.arange(len(v_x))))
    for context in ({"gear": gear}, {"engine_speed": engine}):
        found = shift_speeds(drive._replace(context=context))
        assert found == pytest.approx((16.0, 13.0), abs=0.15)  # by the rows of the changes, and not by a grid
    assert shift_speeds(accelerating(0.0, 1)._replace(context={"gear": gear})) is None
    assert shift_speeds(drive._replace(context={"gear": np.ones(len(v_x))})) is None, "one gear, as its sensor says"


@pytest.mark.parametrize("bent", [lambda r, v: r * (1 - r), lambda r, v: r * v * (24.0 - v) / 144.0])
def test_a_drive_that_bends_over_throttle_or_speed_tells_the_top_speed(bent: Callable[..., np.ndarray]) -> None:
    drive = accelerating(0.0, 1)
    errors = drive.errors.copy()
    errors[:, 0] += 0.02 * bent(np.maximum(drive.rows[3], 0.0), drive.rows[0])
    assert bent_drive(drive._replace(errors=errors)) == pytest.approx(24.0, abs=0.5)
    assert [bent_drive(accelerating(0.0, seed)) for seed in range(6)] == [None] * 6


def test_a_small_bend_shows_in_long_sums() -> None:
    """In sums over 0.2 s it is found in three of the six drives."""
    for seed in range(6):
        drive = accelerating(0.0, seed)
        errors = drive.errors.copy()
        errors[:, 0] += 0.016 * drive.rows[3] * (1.0 - drive.rows[3])
        assert bent_drive(drive._replace(errors=errors)) == pytest.approx(24.0, abs=0.5)


def test_brakes_of_another_scale_than_the_drive_tell_the_top_speed() -> None:
    drive = accelerating(0.0, 1)
    rows = drive.rows.copy()
    rows[3] -= 0.5
    errors = drive.errors.copy()
    errors[:, 0] += 0.03 * np.minimum(rows[3], 0.0)
    assert bent_drive(drive._replace(rows=rows, errors=errors)) is not None
    rows[3] = -0.1
    assert bent_drive(drive._replace(rows=rows, errors=errors)) is None, "nothing is driven"
