"""Laps in closed loop."""

import math
from dataclasses import replace

import numpy as np
import pytest

from dynssm_ros.control import state_estimator
from dynssm_ros.control.race import Course, Start, _RaceCar, race
from dynssm_ros.control.race_models import load_prediction_model, true_model
from dynssm_ros.control.reference import Reference, load_reference
from dynssm_ros.control.settings import Settings
from dynssm_ros.errors import ConfigurationError, UserError
from dynssm_ros.reporting.race_figures import coefficients, driven_coefficients, forces, trajectories
from dynssm_ros.reporting.race_report import race_json, race_report, race_table, summary
from dynssm_ros.simulation.laps import SimulationError
from dynssm_ros.simulation.sensing import Sensing
from dynssm_ros.track.lines import Line
from dynssm_ros.track.tracks import Track, load_track
from dynssm_ros.vehicle import COEFFICIENTS, State, load_vehicle


@pytest.fixture(scope="module")
def course(orca, club, club_line):
    """Without a deadline, so that no load of the machine changes a lap."""
    return Course(orca, club, "euler", club_line, replace(Settings.of(orca), deadline=math.inf))


@pytest.fixture(scope="module")
def lap(course, orca):
    """A lap of the true model; the car has 5 cm to make up at the start."""
    return race(replace(course, start=Start(lateral=0.05)), true_model(orca, "euler"))


def test_the_true_model_completes_a_lap_close_to_what_the_line_allows(lap, course):
    assert lap.completed
    assert lap.outside == 0.0
    assert lap.infeasible == 0
    assert lap.lap_times[0] == pytest.approx(course.reference.lap_time, rel=0.03)
    assert len(lap.time) == int(lap.lap_times[0] / 0.02) + 2


@pytest.mark.parametrize("objective", ["tracking", "progress"])
def test_the_full_size_car_takes_a_bend_at_its_limit(objective):
    """The AV-21 by its own defaults: braking from 41 m/s for a bend that it can take with 35."""
    car, track = load_vehicle("av21"), load_track("road_course")
    reference = load_reference("racing", car, track)
    course = Course(car, track, "rk4", reference, Settings.of(car, objective), start=Start(s=600.0))
    drive = _RaceCar(course, true_model(car, "rk4"))
    assert all(drive.step() is None for _ in range(60))
    driven = drive.result("true", "")
    beside = reference.line.project(driven.pose[:, :2])[1]
    assert driven.outside == 0.0
    assert np.max(np.abs(beside)) < 2.0
    assert driven.s[-1] > 680.0
    assert driven.infeasible == 0


@pytest.mark.parametrize("delay", [0.02, 0.05])
def test_a_delay_that_is_known_costs_the_true_model_nothing(course, lap, orca, delay):
    late = race(replace(course, start=Start(lateral=0.05), sensing=Sensing(delay=delay)), true_model(orca, "euler"))
    assert late.course.delay == pytest.approx(0.02 * math.ceil(delay / 0.02))
    assert late.lap_times[0] == pytest.approx(lap.lap_times[0], abs=0.02)
    np.testing.assert_allclose(late.pose[100:250], lap.pose[100:250], atol=1e-3)


@pytest.mark.slow
def test_noise_is_filtered_before_it_is_planned_from(course, lap, orca, monkeypatch):
    sensing = Sensing(noise=(0.03, 0.03, 0.09), pose_noise=(0.005, 0.005, 0.005), seed=1)
    noisy = replace(course, start=Start(lateral=0.05), sensing=sensing)
    filtered = race(noisy, true_model(orca, "euler"))
    monkeypatch.setattr(state_estimator, "GAINS", (1.0,))
    raw = race(noisy, true_model(orca, "euler"))
    own, without, with_it = (float(np.abs(np.diff(one.command[:, 1])).sum()) for one in (lap, filtered, raw))
    assert without - own < 0.3 * (with_it - own)
    assert filtered.outside == 0.0
    assert race(noisy, true_model(orca, "euler")).lap_times == raw.lap_times  # the seed


def test_commands_respect_the_actuators(lap, orca):
    limits = orca.inputs
    assert limits.throttle[0] <= lap.command[:, 0].min() < lap.command[:, 0].max() <= limits.throttle[1]
    assert np.max(np.abs(lap.command[:, 1])) <= limits.steering[1]
    assert np.max(np.abs(np.diff(lap.command[:, 1], prepend=0.0))) <= limits.steering_rate * 0.02 + 1e-9


def test_the_json_is_that_of_the_contract(lap):
    content = race_json([lap])
    assert content["track"] == "club"
    figures = content["models"]["true"]
    assert {
        "lap_time_s", "violation", "mean_v_x", "mean_abs_v_y", "mean_abs_omega", "steering_total_variation", "solve_ms",
        "completed",
    } <= set(figures)  # fmt: skip
    assert (figures["violation"], figures["completed"]) == (False, True)
    assert figures["lap_time_s"] == lap.lap_times[0]
    assert figures["mean_v_x"] == pytest.approx(np.mean(lap.state[:, 0]))
    assert figures["steering_total_variation"] == pytest.approx(
        abs(lap.command[0, 1]) + np.sum(np.abs(np.diff(lap.command[:, 1])))
    )
    assert 0 < figures["solve_ms"]["p50"] <= figures["solve_ms"]["p99"]


def test_the_report_shows_every_model(lap, course, orca, tmp_path):
    other = replace(lap, name="other", theta=lap.theta * np.linspace(1, 1.1, len(lap.time))[:, None], failure="spins")
    race_report([lap, other]).save(tmp_path / "report.html")
    text = (tmp_path / "report.html").read_text()
    for words in ("Trajectories", "Coefficients", "other", "Forces", "rolling", "weights along 1, across 1"):
        assert words in text
    assert "Not completed: other spins" in summary([lap, other])
    assert "true, twin are the fastest" in summary([lap, replace(lap, name="twin")])
    assert len(race_table([lap, other]).cells) == 2


def test_forces_are_those_of_each_models_own_coefficients(lap):
    """Twice the peak is twice the force; the dashed line is the driven car's."""
    peak = np.array([2.0 if name in ("D_f", "S_vf") else 1.0 for name in COEFFICIENTS])
    panels = forces([lap, replace(lap, name="other", theta=lap.theta * peak)]).axes
    own, other, driven = (line.get_ydata() for line in panels[0].lines[:3])
    np.testing.assert_allclose(own, driven)
    np.testing.assert_allclose(other, 2 * driven)
    np.testing.assert_allclose(*(line.get_ydata() for line in panels[1].lines[:2]))


def test_a_large_track_has_an_enlarged_part_where_the_paths_part_most(lap, course):
    assert len(trajectories([lap]).axes) == 1
    track = load_track("road_course")
    x, y = track.centre.points.T
    pose = np.column_stack([x, y, np.zeros_like(x)])
    beside = pose + 2.0 * np.exp(-((np.arange(len(x)) - 100.0) ** 2) / 50.0)[:, None] * [0.0, 1.0, 0.0]
    large = replace(course, track=track, reference=load_reference("centre", course.vehicle, track))
    driven = [replace(lap, course=large, name=name, pose=path) for name, path in (("true", pose), ("other", beside))]
    whole, near = trajectories(driven).axes
    centre = np.mean([near.get_xlim(), near.get_ylim()], axis=1)
    np.testing.assert_allclose(centre, beside[100, :2], atol=0.5)
    assert np.ptp(near.get_xlim()) * 6 < np.ptp(whole.get_xlim())
    assert list(near.get_xticks()) != list(whole.get_xticks())


def test_a_car_that_leaves_the_road_is_stopped_and_said_so(course, orca):
    """Towards the border at top speed, no controller keeps the 1:43 car on the road."""
    lost = race(replace(course, start=Start(s=1.0, speed=12.0)), true_model(orca, "euler"))
    assert not lost.completed
    assert lost.outside > 0
    assert lost.to_json()["lap_time_s"] is None
    assert "after" in lost.failure


@pytest.mark.parametrize(
    ("start", "complaint"),
    [
        (Start(lateral=0.5), "expected it on the road, -0.2 to 0.2 m"),
        (Start(speed=-1.0), "expected 0 or more"),
    ],
)
def test_impossible_starts_are_refused(course, orca, start, complaint):
    with pytest.raises(SimulationError, match=complaint):
        race(replace(course, start=start), true_model(orca, "euler"))


def test_a_standing_start_takes_off_with_all_there_is(course, orca):
    """At full throttle the 1:43 car gains C_m1 - C_r0 over its mass at first: 5.7 m/s^2, less with speed."""
    start = race(replace(course, start=Start(speed=0.0)), true_model(orca, "euler"))
    assert start.completed
    assert start.outside == 0.0
    gain = np.diff(start.state[:, 0])[:6] / 0.02
    assert np.max(gain) == pytest.approx((0.287 - 0.0518) / 0.041, rel=0.05)
    assert np.all(gain[1:] > 4.5)


def test_a_line_for_one_lap_is_not_driven_twice(course, orca, club_line):
    standing = Reference("launch", club_line.line, np.where(club_line.line.s > 0, club_line.speed, 0.0))
    with pytest.raises(SimulationError, match="2 laps of line launch, which starts from standstill; expected 1"):
        race(replace(course, reference=standing, laps=2), true_model(orca, "euler"))


def test_a_model_that_needs_what_is_not_measured_is_refused(course, orca):
    banked = orca.with_effect("road_bank", {"roll_gain": 1.0})
    with pytest.raises(ConfigurationError, match="needs the signal roll"):
        race(course, load_prediction_model("single_track", banked, banked, "euler"))


def test_what_effects_amount_to_is_told_as_coefficients(lap, course, orca):
    """Less grip all over is a smaller peak, a steering offset a shift of the front slip angle."""
    slick = orca.with_effect("front_grip", {"factor": 0.8}).with_effect("steering_offset", {"offset": 0.01})
    told = driven_coefficients(replace(lap, course=replace(course, vehicle=slick)))
    assert set(told) == {"D_f", "S_hf"}
    np.testing.assert_allclose(told["D_f"][np.isfinite(told["D_f"])], 0.8 * 0.192, rtol=1e-9)
    assert np.mean(np.isfinite(told["D_f"])) > 0.5
    np.testing.assert_allclose(told["S_hf"], -0.0013 + 0.01, rtol=1e-9)
    assert driven_coefficients(lap) == {}


def test_the_figure_of_a_hidden_effect_shows_what_answers_to_it(lap, course, orca):
    """Not what a model says once and for all, which without an effect is what tells models apart."""
    steady, following = lap.theta.copy(), lap.theta.copy()
    steady[15:, COEFFICIENTS.index("B_r")] = 6.0
    following[:, COEFFICIENTS.index("D_f")] *= np.linspace(1.0, 0.8, len(following))
    races = [replace(lap, name="steady", theta=steady), replace(lap, name="following", theta=following)]

    def shown(races):
        return [panel.get_ylabel() for panel in coefficients(races).axes if panel.get_visible()]

    assert shown(races) == ["D_f (N)", "B_r (1/rad)"]
    slick = replace(course, vehicle=orca.with_effect("front_grip", {"factor": 0.8}))
    assert shown([replace(race, course=slick) for race in races]) == ["D_f (N)"]
    wandering = replace(lap, theta=lap.theta * (1 + np.linspace(0, 0.5, len(lap.time))[:, None]))
    assert len(shown([wandering])) == len(COEFFICIENTS)
    assert shown([replace(wandering, course=slick)])[0] == "D_f (N)"
    assert len(shown([replace(wandering, course=slick)])) == 6
    assert len(shown([lap])) == len(State._fields), "nothing moves and nothing is added"


def test_a_road_narrower_than_the_car_is_refused(course, orca, club):
    path = replace(club, width_left=club.width_left / 12, width_right=club.width_right / 12)
    with pytest.raises(SimulationError, match=r"track club is 0.0333 m wide .* more than 0.0403 m, the width of orca"):
        race(replace(course, track=path), true_model(orca, "euler"))


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["centre", "racing"])
def test_an_open_road_is_raced_once_from_start_to_end(orca, club, kind):
    """As fast as its line allows, with no straight back to the start."""
    last = 2 * len(club.centre.points) // 3
    road = Track("road", Line(club.centre.points[:last], closed=False), club.width_right[:last], club.width_left[:last])
    reference = load_reference(kind, orca, road)
    course = Course(orca, road, "euler", reference, replace(Settings.of(orca), deadline=math.inf))
    driven = race(course, true_model(orca, "euler"))
    assert driven.completed
    assert driven.outside == 0.0
    assert driven.lap_times == [pytest.approx(reference.lap_time, rel=0.05)]
    assert summary([driven]) == f"true is the fastest with {driven.lap_times[0]:.3f} s."
    for wrong in (replace(course, laps=2), replace(course, learning=orca)):
        with pytest.raises(UserError, match="open road"):
            race(wrong, true_model(orca, "euler"))
