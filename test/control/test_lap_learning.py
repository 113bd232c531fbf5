"""Faster every lap, and never where it was close."""

from dataclasses import replace

import numpy as np
import pytest

from dynssm_ros.control.lap_learning import SAFE, LapLearner, LapLog, _better
from dynssm_ros.control.prediction_model import Fixed
from dynssm_ros.control.race import Course, race
from dynssm_ros.control.reference import load_reference
from dynssm_ros.control.settings import Settings
from dynssm_ros.errors import ConfigurationError
from dynssm_ros.simulation.sensing import Sensing
from dynssm_ros.vehicle import CarModel

STEP, MOST = 0.06, 1.3


@pytest.fixture
def learner(orca, club):
    """One whose coefficients are known well, so that they bound nothing and are not calibrated anew."""
    known = orca.with_nominal(orca.nominal, np.full(17, 1e-9))
    reference = load_reference("racing", known, club, SAFE)
    built = LapLearner(
        known, club, reference, Settings.of(known), car=CarModel.at_any_speed(known), theta=known.nominal
    )
    built._calibrated = lambda: known
    return built


def lap(learner, seconds=None, close=(), slipping=(), far=()):
    """A lap that takes ``seconds`` in each section, with the car's side on the border in the sections ``close``.

    In the sections ``far`` it is a width away from the borders, in the others half of one. In the sections ``slipping``
    the rear axle moves sideways nearly as much as it may.
    """
    edges = learner._edges
    count = len(edges) - 1
    seconds = np.ones(count) if seconds is None else np.asarray(seconds)
    s = np.linspace(0.0, edges[-1], 50 * count + 1)
    section = np.clip(np.searchsorted(edges, s, "right") - 1, 0, count - 1)
    time = np.interp(s, edges, np.concatenate([[0.0], np.cumsum(seconds)]))
    room = np.select([np.isin(section, close), np.isin(section, far)], [1.0, 3.0], 2.0) * learner._half_width
    velocities = np.zeros((len(s), 3))
    velocities[:, 0] = 2.0
    velocities[:, 1] = np.where(np.isin(section, slipping), 2.0 * np.tan(1.02 * learner._most_slip), 0.0)
    return LapLog(time, s, room, np.zeros(len(s)), velocities, np.zeros((len(s), 7)))


def test_the_first_lap_is_safe_and_each_section_is_driven_faster_by_a_step(learner, club, orca):
    safe = load_reference("racing", orca, club, SAFE)
    np.testing.assert_allclose(learner.reference.speed, safe.speed, rtol=1e-9)
    for k in range(1, 4):
        learner.learn(lap(learner))
        np.testing.assert_allclose(learner._shares, SAFE + k * STEP)
    faster = load_reference("racing", orca, club, SAFE + 3 * STEP)
    np.testing.assert_allclose(learner.reference.speed, faster.speed, rtol=1e-6)


def test_where_it_was_close_it_goes_back_and_stays_there(learner):
    learner.learn(lap(learner))
    learner.learn(lap(learner, close=[2]))
    lower = SAFE + STEP - STEP / 2
    for _ in range(4):
        np.testing.assert_allclose(learner._shares[[1, 2]], lower)  # and what leads there
        learner.learn(lap(learner))
    others = np.delete(learner._shares, [1, 2])
    np.testing.assert_allclose(others, SAFE + 6 * STEP)


def test_where_the_rear_slipped_nearly_as_far_as_it_may_it_goes_back_and_stays_there(learner, orca, club):
    """The section alone: what leads there is not to blame. A car that goes as far as it can does so at any speed."""
    learner.learn(lap(learner))
    learner.learn(lap(learner, slipping=[2]))
    for again in ([], [2], [2]):
        assert learner._shares[2] == pytest.approx(SAFE + STEP / 2)
        learner.learn(lap(learner, slipping=again))
    np.testing.assert_allclose(np.delete(learner._shares, 2), SAFE + 5 * STEP)
    fast = LapLearner(
        orca, club, learner._line, Settings.of(orca, "progress"), car=CarModel.at_any_speed(orca), theta=orca.nominal
    )
    assert not fast._slips(lap(learner, slipping=[2])).any()
    assert np.flatnonzero(learner._slips(lap(learner, slipping=[2]))).tolist() == [2]


def test_where_it_stayed_far_from_the_borders_two_steps_are_taken_from_the_second_lap_on_up_to_the_limits(learner):
    expected = SAFE
    for step in (1, 2, 2, 1, 1):
        learner.learn(lap(learner, far=[2]))
        expected += step * STEP
        assert learner._shares[2] == pytest.approx(expected)
    assert expected - STEP > 1.0
    np.testing.assert_allclose(np.delete(learner._shares, 2), SAFE + 5 * STEP)


def test_a_section_that_was_slower_returns_to_its_best(learner):
    learner.learn(lap(learner))
    best = learner._shares.copy()
    learner.learn(lap(learner, 0.9 * np.ones(len(best))))
    learner.learn(lap(learner, np.where(np.arange(len(best)) == 1, 1.0, 0.9)))
    assert learner._shares[1] == pytest.approx(best[1])
    assert learner._shares[0] > best[0]


def test_a_best_that_the_same_share_does_not_reach_again_holds_nothing_back(learner):
    """The first lap begins at the line's speed, so that a section may be faster in it than ever after."""
    count = len(learner._shares)
    learner.learn(lap(learner, np.where(np.arange(count) == 1, 0.8, 1.0)))
    for expected in (SAFE, SAFE + STEP, SAFE + 2 * STEP):
        learner.learn(lap(learner))
        assert learner._shares[1] == pytest.approx(expected)


def test_caution_counts_from_the_second_lap_on(learner):
    unsure = replace(lap(learner), caution=np.full(50 * len(learner._shares) + 1, learner._half_width))
    learner.learn(unsure)
    assert np.all(learner._shares > SAFE)
    learner.learn(unsure)
    assert np.all(learner._shares < SAFE + STEP)


def test_no_share_goes_beyond_what_the_coefficients_allow(orca, club):
    reference = load_reference("racing", orca, club, SAFE)
    allowed = []
    for std in (1e-9, 0.02):
        known = orca.with_nominal(orca.nominal, std * np.abs(orca.nominal) + 1e-12)
        learner = LapLearner(
            known, club, reference, Settings.of(known), car=CarModel.at_any_speed(known), theta=known.nominal
        )
        allowed.append(learner._allowed.min() / MOST)
    assert allowed[0] == pytest.approx(1.0, abs=1e-3)
    assert 0.92 < allowed[1] < 0.98  # 10 % of such cars grip less by 2 % or more


def test_a_car_that_nobody_measured_begins_slower_still(orca, club):
    unknown = orca.model_copy(
        update={"coefficients": {n: c.model_copy(update={"std": None}) for n, c in orca.coefficients.items()}}
    )
    reference = load_reference("racing", orca, club, SAFE)
    learner = LapLearner(
        unknown, club, reference, Settings.of(orca), car=CarModel.at_any_speed(orca), theta=orca.nominal
    )
    assert learner.reference.lap_time > 1.05 * reference.lap_time
    learner._calibrated = lambda: orca
    for _ in range(3):
        before = np.minimum(learner._shares, learner._allowed)
        learner.learn(lap(learner))
        np.testing.assert_allclose(learner._shares, np.clip(SAFE, before + STEP, before + 2 * STEP))


def test_what_is_believed_stays_till_it_is_clearly_worse():
    """Errors of two that are about as good, lap by lap: nothing goes to and fro."""
    assert [_better(error, 1.0, False) for error in (0.85, 0.95, 1.05)] == [True, False, False]
    assert [_better(error, 1.0, True) for error in (0.95, 1.05, 1.2)] == [True, True, False]


def test_a_line_with_a_speed_of_its_own_is_refused(orca, club):
    own = replace(load_reference("racing", orca, club), share=None)
    with pytest.raises(ConfigurationError, match="has a speed of its own"):
        LapLearner(orca, club, own, Settings.of(orca), car=CarModel.at_any_speed(orca), theta=orca.nominal)


@pytest.mark.slow
def test_grip_is_learned_where_it_is_and_bounds_the_speed_there(orca, club):
    """On two fifths of the lap the car grips a fifth less; nobody tells."""
    driven = orca.with_effect("grip_patch", {"factor": 0.8, "centre": 0.5, "length": 0.4})
    settings, line = replace(Settings.of(orca), deadline=np.inf), load_reference("racing", orca, club, SAFE)
    sensing = Sensing((0.01, 0.01, 0.03), (0.002, 0.002, 0.002), 0.02)
    course = Course(driven, club, "rk4", line, settings, 4, sensing=sensing, learning=orca)
    outcome = race(course, Fixed("file", CarModel.at_any_speed(orca, "rk4", 2), orca.nominal))
    assert outcome.completed
    assert outcome.outside == 0
    last = outcome.learned[-1]
    centres = (np.arange(len(last.grip)) + 0.5) / len(last.grip)
    inside, outside = np.abs(centres - 0.5) < 0.15, np.abs(centres - 0.5) > 0.28
    assert last.grip[inside].mean() / last.grip[outside].mean() == pytest.approx(0.8, abs=0.05)
    assert last.allowed[inside].max() < 0.92 * last.allowed[outside].min()
    assert last.planned
    np.testing.assert_array_equal(outcome.learned[0].grip, 1.0)
    assert outcome.to_json()["learned"][-1]["grip"] == last.grip.tolist()


def test_a_model_that_knows_of_the_place_learns_without_it(learner, orca, club):
    driven = orca.with_effect("grip_patch", {"factor": 0.8, "centre": 0.5, "length": 0.4})
    knowing = LapLearner(
        orca, club, learner._line, Settings.of(orca), car=CarModel.at_any_speed(driven), theta=orca.nominal
    )
    knowing._calibrated = lambda: orca
    for _ in range(2):
        knowing.learn(lap(learner))
    assert len(knowing.laps) == 2


def learned_laps(orca, club, laps):
    """The front tyres grip 15 % less than the controller's model has it."""
    driven = orca.with_effect("front_grip", {"factor": 0.85})
    settings, line = replace(Settings.of(orca, "progress"), deadline=np.inf), load_reference("racing", orca, club, SAFE)
    sensing = Sensing((0.01, 0.01, 0.03), (0.002, 0.002, 0.002), 0.02)
    course = Course(driven, club, "rk4", line, settings, laps, sensing=sensing, learning=orca)
    return race(course, Fixed("file", CarModel.at_any_speed(orca, "rk4", 2), orca.nominal))


@pytest.mark.slow
def test_a_second_lap_is_driven_with_what_the_first_one_told(orca, club):
    outcome = learned_laps(orca, club, 2)
    assert outcome.completed
    assert outcome.outside == 0
    first, second = outcome.learned
    known = [one.vehicle.coefficients["D_f"] for one in (first, second)]
    assert known[1].std < known[0].std
    assert known[1].nominal < 0.95 * orca.coefficients["D_f"].nominal
    assert len(outcome.to_json()["learned"]) == 2


@pytest.mark.slow
def test_a_car_with_less_grip_than_its_file_learns_it_and_comes_round_faster(orca, club):
    outcome = learned_laps(orca, club, 5)
    assert outcome.completed
    assert outcome.outside == 0
    assert outcome.lap_times[-1] < 0.975 * outcome.lap_times[0]
    first, last = outcome.learned[0], outcome.learned[-1]
    known = last.vehicle.coefficients["D_f"]
    assert known.std < 0.5 * first.vehicle.coefficients["D_f"].std
    assert known.nominal == pytest.approx(0.85 * orca.coefficients["D_f"].nominal, rel=0.03)
    assert last.allowed.min() < 0.95 * first.allowed.min()
    assert last.planned
    assert len(outcome.to_json()["learned"]) == 5
