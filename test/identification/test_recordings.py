"""Several recordings of one car: each has its clock, its held-out end, its parts; what acts in one acts in no other."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.hidden_causes.cases import Case, drive, vehicle_file
from dynssm_ros.errors import RecordingError
from dynssm_ros.identification.problem.car import CarEstimate
from dynssm_ros.identification.problem.recordings import RecordingSet, driven_alike
from dynssm_ros.identification.problem.windows import SimulationWindows, fit_windows
from dynssm_ros.identification.result.diagnose import diagnose
from dynssm_ros.identification.tuning import BLOCK_S
from dynssm_ros.reporting.diagnosis_words import as_text
from dynssm_ros.signals.recording import Recording
from dynssm_ros.simulation.laps import as_recording, simulate
from dynssm_ros.track.tracks import load_track
from dynssm_ros.vehicle import load_vehicle

ORCA = load_vehicle("orca")
CLUB = load_track("club")


def recorded(duration: float, seed: int, day: float = 0.0) -> Recording:
    recording = as_recording(simulate(ORCA, CLUB, duration=duration, seed=seed))
    named = recording.info.model_copy(update={"source": (f"day {seed}",)})
    return replace(recording, info=named, time=recording.time + np.int64(day * 86400e9))


@pytest.fixture(scope="module")
def days() -> list[Recording]:
    """The second was driven the day before the first; the third is short."""
    return [recorded(60.0, 1, 1.0), recorded(60.0, 2, 0.0), recorded(20.0, 3, 2.0)]


def test_each_recording_has_its_own_clock_and_they_follow_each_other(days: list[Recording]) -> None:
    together = RecordingSet.of(days, 0.25)
    assert together.names == ("day 1", "day 2", "day 3")
    firsts = np.flatnonzero(np.diff(together.number, prepend=-1))
    np.testing.assert_array_equal(together.clock[firsts], 0.0)
    assert (np.diff(together.time) > 0).all()
    np.testing.assert_allclose(together.time[firsts] % BLOCK_S, 0.0)
    name, clock = together.place(float(together.time[firsts[1]]) + 12.0)
    assert name == "day 2"
    assert clock == pytest.approx(12.0, abs=ORCA.sampling_time)


def test_the_end_of_each_recording_is_held_out(days: list[Recording]) -> None:
    together = RecordingSet.of(days, 0.25)
    data = together.rows()
    fitted = fit_windows(together.recording, data, 0.4, 0.0, together.held_out)
    for k in range(3):
        own = together.held_out[together.number == k]
        assert 0.1 < own.mean() < 0.6
        assert own[-1]
        assert (np.diff(own.astype(int)) >= 0).all()
        assert (fitted.number == k).any()
    assert not together.held_out[fitted.starts + fitted.steps].any()
    assert together.split.startswith("of each recording ")


def test_what_the_vehicle_left_out_is_held_out_and_noted(days: list[Recording]) -> None:
    together = RecordingSet.of(days, 0.25, known={days[1].beginning: 0.4})
    held = together.held_out[together.number == 1]
    assert held.mean() == pytest.approx(0.4, abs=1e-3)
    assert (np.diff(held.astype(int)) >= 0).all()
    assert together.shares[days[1].beginning] == pytest.approx(0.4, abs=1e-3)
    assert "as when the vehicle was calibrated" in together.split


@pytest.mark.slow
def test_a_short_recording_is_not_drowned_by_a_long_one() -> None:
    together = RecordingSet.of([recorded(300.0, 1), recorded(40.0, 2)], 0.25)
    fitted = fit_windows(together.recording, together.rows(), 0.4, 0.0, together.held_out)
    assert len(fitted) == 300
    assert (fitted.number == 1).sum() > 40


def test_three_recordings_are_left_out_in_turn_and_their_parts_too(days: list[Recording]) -> None:
    together = RecordingSet.of(days, 0.25)
    starts = np.flatnonzero(~together.held_out)[::20]
    whole, parts, places = together.left_out(starts)
    assert places is parts
    number = together.number[starts]
    np.testing.assert_array_equal(whole.unit, number)
    np.testing.assert_array_equal(whole.fold, number)
    assert set(parts.fold) == {0, 1, 2, 3}
    assert len(set(parts.unit)) == 12
    for unit in set(parts.unit):
        assert len(set(number[parts.unit == unit])) == 1
        assert len(set(parts.fold[parts.unit == unit])) == 1


def test_two_recordings_are_left_out_by_parts(days: list[Recording]) -> None:
    together = RecordingSet.of(days[:2], 0.25)
    whole, parts, _ = together.left_out(np.flatnonzero(~together.held_out)[::20])
    assert whole is parts
    assert len(set(parts.unit)) == 8


def test_each_road_has_its_own_laps(days: list[Recording]) -> None:
    """The lap of another road says nothing of where a car is on this one."""
    elsewhere = as_recording(simulate(ORCA, load_track("club_b"), duration=60.0, seed=6))
    together = RecordingSet.of([days[0], elsewhere, days[2]], 0.25)
    assert together.levels.road == (0, 1, 0)
    assert together.has_places
    own, other, again = together.lines
    assert own is again
    assert own is not other
    rows = together.rows()
    for k, line in enumerate(together.lines):
        assert line is not None
        np.testing.assert_array_equal(rows.context["lap_length"][together.number == k], line.length)
    alone = RecordingSet.of([elsewhere], 0.25).rows()
    assert (alone.on_one_lap, rows.on_one_lap) == (True, False)
    np.testing.assert_array_equal(rows.context["s"][together.number == 1], alone.context["s"])
    starts = np.flatnonzero(~together.held_out)[::20]
    _, parts, _ = together.left_out(starts)
    assert len(set(parts.unit[together.number[starts] == 1])) == 4


@pytest.mark.slow
def test_many_short_laps_are_left_out_in_groups() -> None:
    together = RecordingSet.of([recorded(200.0, 4)], 0.25)
    whole, parts, _ = together.left_out(np.flatnonzero(~together.held_out)[::20])
    assert whole is parts
    assert len(set(whole.fold)) == 8
    assert (np.diff(whole.fold) >= 0).all()


@pytest.mark.parametrize(("duration", "again"), [(8.0, False), (16.0, True), (60.0, True)])
def test_places_that_one_part_alone_has_are_left_out_by_stretches(duration: float, again: bool) -> None:
    together = RecordingSet.of([recorded(duration, 5)], 0.01, CLUB.centre)
    starts = np.flatnonzero(~together.held_out)[::5]
    _, parts, places = together.left_out(starts)
    assert (places is parts) == again
    if not again:
        block = together.time[starts] // BLOCK_S
        assert all(len(set(places.fold[block == k])) == 1 for k in set(block))
        assert len(set(places.fold)) == 3


def test_recordings_of_the_same_driving_are_alike_and_others_are_not(days: list[Recording]) -> None:
    together = RecordingSet.of(days[:2], 0.25)
    windows = fit_windows(together.recording, together.rows(), 0.4, 0.0)
    assert driven_alike(windows, (1,)) > 0.8
    rows = windows.data.rows.copy()
    rows[3, windows.data.number == 1] -= 2.0
    braked = replace(windows, data=replace(windows.data, rows=rows))
    assert driven_alike(braked, (1,)) < 0.2


def test_recordings_of_different_rates_are_one_clear_line(days: list[Recording]) -> None:
    other = replace(days[1], info=days[1].info.model_copy(update={"sampling_time": 0.04}))
    with pytest.raises(RecordingError, match=r"recording day 2: sampling_time 0.04, but day 1 has 0.02"):
        RecordingSet.of([days[0], other], 0.25)


def test_what_acts_in_one_recording_acts_in_no_other(days: list[Recording]) -> None:
    together = RecordingSet.of(days, 0.25)
    windows: SimulationWindows = fit_windows(together.recording, together.rows(), 0.4, 0.0)
    plain = CarEstimate.of(ORCA)
    for name, values in (("grip", {"factor": 0.8}), ("steering_lag", {"time_constant": 0.1})):
        without, everywhere = windows.errors(plain), windows.errors(plain.with_effect(name, values))
        there = windows.errors(plain.with_effect(name, values, (1,)))
        second = windows.number == 1
        np.testing.assert_allclose(there[second], everywhere[second], rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(there[~second], without[~second], rtol=1e-9, atol=1e-12)
        assert np.abs(everywhere - without)[~second].max() > 1e-3


def test_an_effect_of_one_recording_is_taken_away_and_written_with_it() -> None:
    car = CarEstimate.of(ORCA).with_effect("grip", {"factor": 0.8}, (1,)).with_effect("drag", {"coefficient": 1e-3})
    assert car.only_in == {"grip": (1,)}
    assert car.without("grip").only_in == {}
    assert [e.name for e in car.extended(np.eye(18)).effects] == ["drag"]
    assert [e.name for e in car.extended(np.eye(18), 1).effects] == ["grip", "drag"]


Drive = Callable[[dict[str, dict[str, float]], int], Recording]


@pytest.fixture(scope="module")
def driven() -> Drive:
    return lambda hidden, seed: drive(Case(hidden, seed, "rk4", 60.0))


@pytest.mark.slow
def test_a_place_that_was_passed_once_is_found_where_all_of_it_agrees() -> None:
    """A quarter of the time has all of the patch, so that the fit without it knows nothing of it."""
    patch = {"factor": 0.85, "centre": 0.35, "length": 0.15}
    case = Case({"grip_patch": patch}, 9412, "rk4", 90.0)
    found = diagnose(drive(case), vehicle_file(Case({}, 9400)), integrator="rk4", line=case.road.centre)
    (cause,) = found.causes
    assert cause.effect == "grip_patch"
    assert cause.values["factor"] == pytest.approx(0.85, abs=max(0.005, 3 * cause.std["factor"]))
    assert cause.values["centre"] == pytest.approx(0.35, abs=0.02)
    assert len(cause.confirmation.improvement) == 4
    assert cause.confirmation.least > 1.0
    assert any(note.startswith("grip_patch was seen in one pass of most places") for note in found.notes)


@pytest.mark.slow
def test_what_changed_since_the_reference_is_told_from_what_was_there(driven: Drive) -> None:
    lag = {"steering_lag": {"time_constant": 0.1}}
    wet = {"front_grip": {"factor": 0.75}, "rear_grip": {"factor": 0.75}}
    found = diagnose(
        driven(lag, 9401), vehicle_file(Case({}, 9400)), integrator="rk4", suspect=[driven(lag | wet, 9402)]
    )
    causes = {cause.effect: cause for cause in found.causes}
    assert set(causes) == {"steering_lag", "grip"}
    assert causes["steering_lag"].only_in == ()
    assert causes["grip"].only_in == ("steering_lag+front_grip+rear_grip/rk4/road_course/25Hz/9402",)
    assert causes["grip"].values["factor"] == pytest.approx(0.75, abs=max(0.01, 3 * causes["grip"].std["factor"]))
    assert {effect.name for effect in found.vehicle.effects} == {"steering_lag", "grip"}
    assert "grip (only in steering_lag+front_grip" in as_text(found)


@pytest.mark.slow
def test_what_one_of_three_days_has_is_named_with_it_and_not_written(driven: Drive) -> None:
    lag = {"yaw_rate_lag": {"time_constant": 0.05}}
    turned = {"odometry_misalignment": {"angle": -0.007}}
    found = diagnose(
        [driven(lag, 9403), driven(lag | turned, 9404), driven(lag, 9405)],
        vehicle_file(Case({}, 9400)),
        integrator="rk4",
    )
    causes = {cause.effect: cause for cause in found.causes}
    assert set(causes) == {"yaw_rate_lag", "odometry_misalignment"}
    assert len(causes["yaw_rate_lag"].confirmation.improvement) == 3
    turning = causes["odometry_misalignment"]
    assert turning.only_in == ("yaw_rate_lag+odometry_misalignment/rk4/road_course/25Hz/9404",)
    assert turning.values["angle"] == pytest.approx(-0.007, abs=5e-4)
    assert [effect.name for effect in found.vehicle.effects] == ["yaw_rate_lag"]
    assert any(note.startswith("odometry_misalignment: not in the vehicle file") for note in found.notes)


@pytest.mark.slow
def test_what_a_session_has_is_named_with_it(driven: Drive) -> None:
    """A sensor that was turned between two days is in both drives of the second."""
    turned = {"odometry_misalignment": {"angle": -0.007}}

    def at(hour: float, hidden: dict[str, dict[str, float]], seed: int) -> Recording:
        recording = driven(hidden, seed)
        return replace(recording, time=recording.time + np.int64(hour * 3600e9))

    found = diagnose(
        [at(0.0, {}, 9410), at(1.0, {}, 9411), at(24.0, turned, 9413), at(25.0, turned, 9414)],
        vehicle_file(Case({}, 9400)),
        integrator="rk4",
    )
    (cause,) = found.causes
    assert (cause.effect, cause.level) == ("odometry_misalignment", "session")
    assert [name.split("/")[-1] for name in cause.only_in] == ["9413", "9414"]
    assert cause.values["angle"] == pytest.approx(-0.007, abs=5e-4)
    assert "9414, one session)" in as_text(found)


@pytest.mark.slow
def test_three_healthy_days_of_unlike_noise_are_right(driven: Drive) -> None:
    found = diagnose([driven({}, seed) for seed in (9406, 9407, 9408)], vehicle_file(Case({}, 9400)), integrator="rk4")
    # the file knows the car to 2 %
    assert (found.verdict, found.causes) == ("recalibrate", ())
