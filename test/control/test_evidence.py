"""What a model says is planned with where it has predicted better than the calibrated car, and not before."""

import math
from dataclasses import replace

import numpy as np
import pytest

from dynssm_ros.control.caution import QUANTILE
from dynssm_ros.control.evidence import SOURCES, Evidence, sources
from dynssm_ros.control.horizon_model import STATES
from dynssm_ros.control.nmpc import Adapted
from dynssm_ros.control.prediction_model import Fixed
from dynssm_ros.control.race import Course, race
from dynssm_ros.control.reference import load_reference
from dynssm_ros.control.settings import Settings
from dynssm_ros.vehicle import CarModel

STEPS = 8
AXLES = (0.03, -0.03)
CALIBRATED = Adapted(np.zeros(17), np.zeros(3))


def said(theta=0.0, correction=0.0):
    return Adapted(np.full(17, theta), np.full(3, correction))


def following(states, increments, adapted, t):
    """Cars that drive straight on, as fast as their coefficients and what is added say."""
    moved = states.copy()
    moved[:, STATES.index("v_x")] = 1.0 + adapted.theta[:, 0] + adapted.correction[:, 0]
    return moved


def driven(evidence, speeds, model):
    """Drives at true ``speeds`` (m/s); returns the weights after each step."""
    state, weights = np.zeros(len(STATES)), []
    for k, speed in enumerate(speeds):
        evidence.earned(sources(CALIBRATED, model))
        evidence.sent(state, np.zeros(2), sources(CALIBRATED, model), 0.1 * k)
        weights.append(evidence.weights)
        state = state.copy()
        state[STATES.index("v_x")] = speed
    return np.array(weights)


def test_without_evidence_the_calibrated_car_is_planned_with():
    evidence = Evidence(following, STEPS, 0.1, AXLES)
    model = said(theta=0.1, correction=0.2)
    earned = evidence.earned(sources(CALIBRATED, model))
    np.testing.assert_array_equal(earned.theta, CALIBRATED.theta)
    np.testing.assert_array_equal(earned.correction, CALIBRATED.correction)
    weights = driven(evidence, [1.0] * 200, model)  # the calibrated car is right
    assert np.all(weights[:, 0] == 1.0)


@pytest.mark.parametrize(
    ("move", "model", "source"),
    [
        (1.1, said(theta=0.1, correction=0.2), "coefficients"),
        (1.3, said(theta=0.1, correction=0.2), "model"),
        (1.01, said(theta=0.1, correction=0.2), "calibrated"),
        (1.1, said(theta=np.nan, correction=0.2), "calibrated"),
    ],
)
def test_what_has_predicted_best_is_planned_with_after_a_few_horizons(move, model, source):
    evidence = Evidence(following, STEPS, 0.1, AXLES)
    weights = driven(evidence, [move] * 200, model)
    assert evidence.source == source
    assert weights[-1][SOURCES.index(source)] == pytest.approx(1.0, abs=1e-3)
    assert np.all(weights[: STEPS + 4, 0] == 1.0)
    assert np.all(np.abs(np.diff(weights, axis=0)) < 1.5 / STEPS)  # no jump
    np.testing.assert_allclose(weights.sum(axis=1), 1.0)


def test_caution_is_what_was_mispredicted_step_by_step():
    """Straight on at 1 m/s; the car is dragged to the side at a constant 0.1 m/s that nobody foresees."""
    evidence = Evidence(following, STEPS, 0.1, AXLES)
    assert not any(part.any() for part in evidence.margins())
    model = said(theta=np.nan)  # a source that says nothing does not count
    state = np.zeros(len(STATES))
    state[STATES.index("v_x")] = 1.0
    for k in range(100):
        evidence.earned(sources(CALIBRATED, model))
        evidence.sent(state.copy(), np.zeros(2), sources(CALIBRATED, model), 0.1 * k)
        state[STATES.index("v_y")] = 0.1 * (k + 1)  # the next horizon begins with what is measured
    margins = evidence.margins()
    steps = np.arange(1, STEPS + 1)
    beside = 0.1 * 0.1 * steps**2 / 2  # twice integrated, by the means of the steps
    np.testing.assert_allclose(margins.lateral, QUANTILE * beside, rtol=0.02)
    assert np.all(np.diff(margins.slip, axis=0) > 0)
    np.testing.assert_allclose(margins.slip[:, 0], margins.slip[:, 1])  # it does not turn
    evidence.forget()
    assert not any(part.any() for part in evidence.margins())


def test_what_has_become_worse_is_left():
    evidence = Evidence(following, STEPS, 0.1, AXLES)
    model = said(theta=0.1)
    weights = driven(evidence, [1.1] * 100 + [1.0] * 100, model)
    assert weights[99][0] < 0.01
    assert weights[-1][0] == pytest.approx(1.0, abs=1e-3)


def test_a_gap_drops_what_is_under_way_and_keeps_what_was_found():
    evidence = Evidence(following, STEPS, 0.1, AXLES)
    driven(evidence, [1.1] * 100, said(theta=0.1))
    evidence.interrupt()
    assert evidence.source == "coefficients"
    driven(evidence, [1.1] * 3, said(theta=0.1))  # begins elsewhere
    assert evidence.source == "coefficients"
    evidence.forget()
    assert evidence.source == "calibrated"


class Wrong(Fixed):
    """Says that the car has twice the grip, and drifts."""

    def read(self, rows, previous):
        theta = self.calibrated.theta.copy()
        theta[[2, 6]] *= 2.0
        return Adapted(theta, np.array([0.0, 0.02, 0.3]))


def test_a_model_that_is_wrong_drives_like_the_calibrated_car(orca, club):
    """As it is, the same model leaves the road or spins."""
    reference = load_reference("racing", orca, club, 0.9)
    settings = replace(Settings.of(orca, "progress"), deadline=math.inf)  # no load of the machine changes a lap
    course = Course(orca, club, "euler", reference, settings)
    car = Wrong("wrong", CarModel.at_any_speed(orca), orca.nominal)
    plain = race(course, Fixed("calibrated", CarModel.at_any_speed(orca), orca.nominal))
    judged = race(course, car)
    assert judged.completed
    assert judged.lap_times == plain.lap_times
    as_is = race(replace(course, settings=replace(settings, evidence=False, follows="never")), car)
    assert not as_is.completed or as_is.outside > 0
