"""What a model mispredicts is found, and nothing else."""

import math
from dataclasses import replace

import numpy as np
import pytest

from dynssm_ros.control.controller import Controller
from dynssm_ros.control.disturbance import SETTLING, Disturbance
from dynssm_ros.control.prediction_model import Fixed
from dynssm_ros.control.race import Course, race
from dynssm_ros.control.race_models import true_model
from dynssm_ros.control.settings import Settings
from dynssm_ros.simulation.plant import Pose, make_plant
from dynssm_ros.vehicle import COEFFICIENTS, Applied, State

CONSTANT = np.array([0.01, -0.02, 0.3])
SEEN = np.array([2.0, 0.1, 1.0])


def with_errors(disturbance, errors):
    """A model that says that nothing changes, on a car that moves by ``errors``; what is found is counted in."""
    for error in errors:
        disturbance.expects(SEEN + disturbance.value)
        disturbance.measured(SEEN + error)
    return disturbance.value


@pytest.fixture
def settings(orca):
    return replace(Settings.of(orca, N=10, offset_free=True), deadline=math.inf)


def test_a_constant_error_is_found_in_the_time_stated(settings):
    steps = 20
    found = with_errors(Disturbance.of(settings, 0.02), [CONSTANT] * steps)
    share = 1 - np.exp(-steps * 0.02 / (SETTLING * settings.scale.time))
    np.testing.assert_allclose(found, share * CONSTANT, rtol=1e-12)


def test_it_stays_at_nothing_where_models_are_planned_with_as_they_are(settings):
    as_they_are = replace(settings, follows="never")
    found = with_errors(Disturbance.of(as_they_are, 0.02), [CONSTANT] * 50)
    np.testing.assert_array_equal(found, 0.0)


def test_noise_alone_adds_nothing_and_a_sudden_error_is_found_in_a_few_steps(settings):
    """The model is right for 300 steps of noise, and wrong from then on."""
    noise = np.array([0.005, 0.01, 0.05]) * np.random.default_rng(3).standard_normal((330, 3))
    noise[300:] += 5 * CONSTANT
    disturbance = Disturbance.of(replace(settings, follows="chosen"), 0.02)
    found = np.array([with_errors(disturbance, [error]) for error in noise])
    before, after = found[:300], found[310:]
    assert np.all(np.abs(before).mean(axis=0) < 0.1 * noise[:300].std(axis=0))
    np.testing.assert_allclose(after.mean(axis=0), 5 * CONSTANT, rtol=0.2)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -1e9])
def test_a_measurement_that_cannot_be_is_no_error_of_the_model(settings, bad):
    disturbance = Disturbance.of(settings, 0.02)
    before = with_errors(disturbance, [CONSTANT])
    for k in range(3):
        error = CONSTANT.copy()
        error[k] = bad
        np.testing.assert_array_equal(with_errors(disturbance, [error]), before)


def test_only_what_was_expected_is_compared(settings):
    disturbance = Disturbance.of(settings, 0.02)
    disturbance.expects(SEEN)
    disturbance.interrupted()
    disturbance.measured(SEEN + CONSTANT)
    np.testing.assert_array_equal(disturbance.value, 0.0)
    assert np.any(with_errors(disturbance, [CONSTANT]))
    disturbance.forget()
    np.testing.assert_array_equal(disturbance.value, 0.0)


def test_the_true_model_drives_as_without(orca, club, club_line, settings):
    """On the plant that it is the model of, to rounding, which the car's motion carries on."""
    course = Course(orca, club, "euler", club_line, settings)
    followed = race(course, true_model(orca, "euler"))
    plain = race(replace(course, settings=replace(settings, follows="never")), true_model(orca, "euler"))
    np.testing.assert_allclose(followed.lap_times, plain.lap_times, rtol=0, atol=1e-9)
    assert np.max(np.abs(followed.correction)) < 1e-9


def steady(orca, course, knowledge, steps=130):
    """The last decision and place of a drive on a circle."""
    track, reference, settings = course
    pilot = Controller(knowledge, orca.inputs, reference, track, settings)
    car, feedback = make_plant(orca, "euler", Pose(1.0, 0.0, np.pi / 2), State(1.5, 0.0, 1.5)), Applied(0.0, 0.0)
    for k in range(steps):
        decision = pilot.step(0.02 * k, car.pose, car.measured, feedback)
        feedback = decision.command
        car.advance(feedback)
    return decision, float(np.hypot(*car.pose[:2]))


def test_a_wrong_coefficient_leaves_no_steady_offset(orca, circle, settings):
    """A front tyre taken for a fifth too weak: the car turns too sharply, and within the circle; then it does not."""
    track, reference = circle()
    settings = replace(settings, travel="start")
    wrong = orca.nominal.copy()
    wrong[COEFFICIENTS.index("D_f")] *= 0.8
    believed = Fixed("weak", true_model(orca, "euler").car, wrong)
    beside, found = {}, {}
    _, exact = steady(orca, (track, reference, settings), true_model(orca, "euler"))
    for follows in ("never", "always", "chosen"):
        decision, radius = steady(orca, (track, reference, replace(settings, follows=follows)), believed)
        beside[follows], found[follows] = abs(radius - exact), decision.adapted.first.correction
    assert beside["never"] > 1e-3
    assert max(beside["always"], beside["chosen"]) < 0.05 * beside["never"]
    np.testing.assert_array_equal(found["never"], 0.0)
    assert found["always"][2] > 0.1  # a turn that the weak tyre does not explain
