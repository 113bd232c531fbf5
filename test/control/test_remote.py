"""What a predictor on a bus says, with planted coefficients and predictions."""

from __future__ import annotations

import math

import numpy as np
import pytest

from dynssm_ros.control.prediction_model import stepped
from dynssm_ros.control.remote import RemoteModel
from dynssm_ros.simulation.plant import Pose
from dynssm_ros.vehicle import COEFFICIENTS, Applied, State

T_S = 20_000_000  # ns
STAMP = 1_700_000_000_000_000_000
CONTEXT = (1.0, 2.0, 11.7, 0.4)
APPLIED = Applied(0.3, 0.1)
SEEN = State(2.0, 0.1, 1.0)
BEYOND = np.array([0.02, -0.01, 0.3])  # what the planted predictor adds


@pytest.fixture
def remote(orca):
    return RemoteModel(orca, max_age=0.1)


@pytest.fixture
def theta(orca):
    """Coefficients inside the bounds that are not the nominal ones."""
    return orca.nominal + 0.02 * (orca.upper - orca.nominal)


def odometry(remote: RemoteModel, k: int = 0):
    """The odometry message of step ``k`` reaches the controller."""
    x = remote.start(Pose(0.0, 0.0, 0.5), SEEN, APPLIED, CONTEXT, None)
    remote.measured(STAMP + k * T_S, x, CONTEXT)
    return x


def state(remote: RemoteModel, theta):
    """What the planted predictor says of the step that :func:`odometry` begins, by the vehicle room's own step."""
    row = np.array([[*SEEN, *APPLIED, 0.0, 0.0]])
    return stepped(remote.car, row, theta)[0] + BEYOND


def output(remote: RemoteModel, theta, k: int = 0) -> None:
    """The planted predictor answers that message."""
    assert remote.predicted(STAMP + (k + 1) * T_S, state(remote, theta)) == ""
    assert remote.adapted(STAMP + (k + 1) * T_S, dict(zip(COEFFICIENTS, theta, strict=True))) == ""


def test_without_a_predictor_it_is_the_nominal_car(remote, orca):
    odometry(remote)
    remote.update(STAMP)
    assert remote.output.source == RemoteModel.NOMINAL
    assert remote.output.age == math.inf
    adapted = remote.read(np.zeros((1, 7)), None)
    np.testing.assert_array_equal(adapted.theta, orca.nominal)
    np.testing.assert_array_equal(adapted.correction, 0.0)


@pytest.mark.parametrize("answer_first", [True, False])
def test_coefficients_and_what_the_prediction_adds_to_them_are_found(remote, theta, answer_first):
    for part in (lambda: output(remote, theta), lambda: odometry(remote))[:: 1 if answer_first else -1]:
        part()
    remote.update(STAMP + T_S)
    assert remote.output.source == RemoteModel.ADAPTED
    assert remote.output.age == pytest.approx(0.02)
    adapted = remote.read(np.zeros((1, 7)), None)
    np.testing.assert_allclose(adapted.theta, theta)
    np.testing.assert_allclose(adapted.correction, BEYOND, atol=1e-12)


def test_one_step_ahead_is_what_the_predictor_says(remote, theta):
    x = odometry(remote)
    output(remote, theta)
    remote.update(STAMP)
    ahead = remote.ahead(x, CONTEXT, remote.output.adapted)
    np.testing.assert_allclose(ahead[3:6], state(remote, theta), atol=1e-12)
    np.testing.assert_array_equal(ahead[6:8], APPLIED)
    turn = 0.02 * (SEEN.omega + ahead[5]) / 2
    assert ahead[2] == pytest.approx(0.5 + turn)


def test_what_was_said_is_held_up_to_its_age_and_not_longer(remote, orca, theta):
    odometry(remote)
    output(remote, theta)
    remote.update(STAMP + 5 * T_S)
    np.testing.assert_array_equal(remote.output.adapted.theta, theta)
    assert remote.output.age == pytest.approx(0.1)
    remote.update(STAMP + 6 * T_S)
    assert remote.output.source == RemoteModel.NOMINAL
    np.testing.assert_array_equal(remote.output.adapted.theta, orca.nominal)


def test_coefficients_whose_prediction_is_lost_do_not_displace_a_whole_answer(remote, orca, theta):
    odometry(remote)
    output(remote, theta)
    odometry(remote, 1)
    remote.adapted(STAMP + 2 * T_S, dict(zip(COEFFICIENTS, orca.nominal, strict=True)))
    remote.update(STAMP + 2 * T_S)
    np.testing.assert_array_equal(remote.output.adapted.theta, theta)
    np.testing.assert_allclose(remote.output.adapted.correction, BEYOND, atol=1e-12)


def test_coefficients_alone_hold_without_a_correction(remote, theta):
    remote.adapted(STAMP + T_S, dict(zip(COEFFICIENTS, theta, strict=True)))
    remote.update(STAMP)
    np.testing.assert_array_equal(remote.output.adapted.theta, theta)
    np.testing.assert_array_equal(remote.output.adapted.correction, 0.0)


def test_a_predictor_without_coefficients_corrects_the_nominal_car(remote, orca):
    odometry(remote)
    remote.predicted(STAMP + T_S, state(remote, orca.nominal))
    remote.update(STAMP)
    assert remote.output.source == RemoteModel.CORRECTED
    np.testing.assert_allclose(remote.output.adapted.correction, BEYOND, atol=1e-12)


def test_names_count_and_not_their_order(remote, theta):
    remote.adapted(STAMP + T_S, dict(reversed(list(zip(COEFFICIENTS, theta, strict=True)))))
    remote.update(STAMP)
    np.testing.assert_array_equal(remote.output.adapted.theta, theta)


@pytest.mark.parametrize(
    ("spoil", "reason"),
    [
        ({"D_f": math.nan}, "D_f = nan; expected 0.1 to 0.9"),
        ({"B_r": 4.0}, "B_r = 4; expected 5 to 30"),
        ({"I_z": math.inf}, "I_z = inf"),
    ],
)
def test_coefficients_that_cannot_be_are_refused_with_the_reason(remote, orca, theta, spoil, reason):
    values = dict(zip(COEFFICIENTS, theta, strict=True)) | spoil
    assert reason in remote.adapted(STAMP + T_S, values)
    remote.update(STAMP)
    np.testing.assert_array_equal(remote.output.adapted.theta, orca.nominal)


def test_missing_coefficients_and_predictions_that_are_not_finite_are_refused(remote):
    assert "C_m1" in remote.adapted(STAMP, {"B_f": 6.0})
    assert "nan" in remote.predicted(STAMP + T_S, (1.0, math.nan, 0.0))
    odometry(remote)
    remote.update(STAMP)
    assert remote.output.source == RemoteModel.NOMINAL


def test_bounds_leave_room_for_single_precision(remote, orca):
    edge = np.float32(orca.upper).astype(float)
    assert remote.adapted(STAMP, dict(zip(COEFFICIENTS, edge, strict=True))) == ""


def test_answers_of_another_time_do_not_count(remote, theta):
    output(remote, theta, k=100)
    remote.update(STAMP)
    assert remote.output.source == RemoteModel.NOMINAL
