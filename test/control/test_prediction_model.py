"""Models behind the controller."""

import numpy as np
import pytest

from dynssm_ros.control.nmpc import Plan
from dynssm_ros.control.prediction_model import Adaptive, stepped
from dynssm_ros.control.race_models import load_prediction_model, true_model
from dynssm_ros.errors import ArtifactError, ConfigurationError
from dynssm_ros.runtime.baselines import Persistence, SingleTrack
from dynssm_ros.runtime.contract import WindowPrediction
from dynssm_ros.runtime.registry import load_model
from dynssm_ros.simulation.double_track import DoubleTrack
from dynssm_ros.vehicle import load_vehicle, save_vehicle

RNG = np.random.default_rng(0)
ROWS = np.array([1.8, -0.1, 2.0, 0.3, 0.1, 0.1, 0.02]) + 0.01 * RNG.standard_normal((20, 7))


class Speaking(SingleTrack):
    """Says coefficients and a residual that tell which window was read."""

    name = "speaking"
    commands = "topics"

    def __init__(self, vehicle):
        super().__init__(vehicle)
        self.H = 4

    def predict(self, windows):
        physics = self._following(windows, 1)[:, 0]
        theta = np.tile(self._theta, (len(windows), 1)) * (1 + 0.01 * windows[:, :1, 0])
        return WindowPrediction(physics + windows[:, -1, 3:6], theta, physics)


def previous(N=5):
    return Plan(RNG.standard_normal((N + 1, 8)), RNG.standard_normal((N, 2)))


def test_what_the_model_says_of_the_last_window_is_held(orca):
    adapted = Adaptive(Speaking(orca), orca).read(ROWS, previous())
    np.testing.assert_allclose(adapted.theta, orca.nominal * (1 + 0.01 * ROWS[-4, 0]), rtol=1e-12)
    np.testing.assert_allclose(adapted.correction, ROWS[-1, 3:6], rtol=1e-9)


def test_the_nominal_car_drives_until_the_window_is_full(orca):
    adapted = Adaptive(Speaking(orca), orca).read(ROWS[:3], None)
    np.testing.assert_array_equal(adapted.theta, orca.nominal)
    np.testing.assert_array_equal(adapted.correction, 0.0)


def test_along_the_horizon_the_plan_becomes_history(orca):
    plan = previous(5)
    adapted = Adaptive(Speaking(orca), orca, along_horizon=True).read(ROWS, plan)
    assert (adapted.theta.shape, adapted.correction.shape) == ((5, 17), (5, 3))
    np.testing.assert_allclose(adapted.correction[0], ROWS[-1, 3:6], rtol=1e-9)
    rows = np.concatenate([plan.x[1:5, 3:8], plan.u[1:]], axis=1)
    np.testing.assert_allclose(adapted.correction[1:], rows[:, 3:6], rtol=1e-9)
    first = np.concatenate([ROWS[-4:], rows])[:5, 0]
    np.testing.assert_allclose(adapted.theta, orca.nominal * (1 + 0.01 * first[:, None]), rtol=1e-12)


def test_a_model_without_commands_sees_none(orca):
    model = Speaking(orca)
    model.commands = "none"
    adapted = Adaptive(model, orca).read(ROWS, previous())
    np.testing.assert_allclose(adapted.correction, [*ROWS[-1, 3:5], 0.0], atol=1e-12)


def test_a_model_without_physics_corrects_the_nominal_car(orca):
    """Persistence says that nothing changes, so the correction takes off what the nominal step adds."""
    adapted = Adaptive(Persistence(), orca).read(ROWS, None)
    following = SingleTrack(orca).predict(ROWS[None, -1:]).state[0]
    np.testing.assert_allclose(following + adapted.correction, ROWS[-1, :3], atol=1e-12)
    np.testing.assert_array_equal(adapted.theta, orca.nominal)


def test_one_row_is_stepped_as_many_are(orca):
    """Also standing still, where the wheels roll and slip angles have no derivative."""
    model = Adaptive(Persistence(), orca)
    rows = np.concatenate([ROWS, [[0.0, 0.0, 0.0, 0.4, 0.1, 0.0, 0.0], [0.5, 0.0, 0.3, 1.0, -0.2, 0.0, 0.0]]])
    following = stepped(model.car, rows, orca.nominal)
    for row, expected in zip(rows, following, strict=True):
        correction = model.read(row[None], None).correction
        np.testing.assert_allclose(correction, row[:3] - expected, atol=1e-12)


def test_what_is_not_finite_is_not_used(orca):
    rows = ROWS.copy()
    rows[-1, 3] = np.nan
    adapted = Adaptive(Speaking(orca), orca).read(rows, None)
    np.testing.assert_array_equal(adapted.theta, orca.nominal)


def test_a_trained_model_says_here_what_it_says_elsewhere(orca, small_model):
    knowledge = load_prediction_model(str(small_model), orca, orca, "rk4", as_is=True)
    adapted = knowledge.read(ROWS, None)
    said = load_model(small_model).predict(ROWS[None, -knowledge.H :])
    np.testing.assert_array_equal(adapted.theta, said.theta[0])
    np.testing.assert_array_equal(adapted.correction, (said.state - said.physics)[0])


def test_a_model_whose_physics_nobody_calibrated_is_stepped_as_the_car_is_known(orca, small_model):
    """Its own nominal car may be no car that ever was; as it is, it is planned with nevertheless."""
    known = orca.with_nominal(0.9 * orca.nominal + 0.1 * orca.lower).model_copy(update={"integrator": "rk4"})
    model = load_model(small_model)
    assert model.vehicle.integrator is None
    judged, as_it_is = (
        load_prediction_model(str(small_model), known, known, "rk4", as_is=each) for each in (False, True)
    )
    assert (judged.car.integrator, as_it_is.car.integrator) == ("rk4", "euler")
    np.testing.assert_array_equal(judged.calibrated.theta, known.nominal)
    np.testing.assert_array_equal(as_it_is.calibrated.theta, model.vehicle.nominal)
    said, adapted = model.predict(ROWS[None, -model.H :]), judged.read(ROWS, None)
    following = stepped(judged.car, ROWS[-1:], adapted.theta)
    np.testing.assert_allclose(following + adapted.correction, said.state, atol=1e-12)
    calibrated = model.vehicle.model_copy(update={"integrator": "rk4"})
    model.vehicle = calibrated
    np.testing.assert_array_equal(Adaptive(model, known).calibrated.theta, calibrated.nominal)


def test_the_true_model_has_what_the_plant_has(orca):
    driven = orca.with_effect("drag", {"coefficient": 0.001})
    assert driven.active_effects[0] in true_model(driven, "rk4").car.effects
    assert any(isinstance(effect, DoubleTrack) for effect in true_model(driven, "double_track").car.effects)
    assert true_model(driven, "euler").car.integrator == "euler"
    np.testing.assert_array_equal(
        load_prediction_model("true", orca, driven, "rk4").read(ROWS, None).theta, orca.nominal
    )


def test_a_vehicle_file_is_the_car_that_the_controller_believes_in(orca, tmp_path):
    path = tmp_path / "weak.yaml"
    save_vehicle(orca.with_nominal((orca.lower + orca.upper) / 2), path)
    knowledge = load_prediction_model(str(path), orca, orca, "rk4")
    assert knowledge.name == "weak"
    np.testing.assert_array_equal(knowledge.read(ROWS, None).theta, (orca.lower + orca.upper) / 2)


def test_models_of_another_car_or_sampling_time_are_refused(orca, small_model, tmp_path):
    slow = orca.model_copy(update={"sampling_time": 0.04})
    with pytest.raises(ArtifactError, match=r"sampling time 0\.02 s; expected that of vehicle orca, 0\.04 s"):
        load_prediction_model(str(small_model), slow, slow, "rk4")
    heavy = orca.model_copy(update={"constants": orca.constants.model_copy(update={"m": 0.05})})
    with pytest.raises(ArtifactError, match=r"another vehicle \(m = 0\.041\); expected that of orca \(m = 0\.05\)"):
        load_prediction_model(str(small_model), heavy, heavy, "rk4")
    save_vehicle(load_vehicle("av21").model_copy(update={"sampling_time": 0.02}), tmp_path / "indy.yaml")
    with pytest.raises(ConfigurationError, match="another vehicle"):
        load_prediction_model(str(tmp_path / "indy.yaml"), orca, orca, "rk4")
    with pytest.raises(ConfigurationError, match="neither a model folder nor one of true, "):
        load_prediction_model("oracle", orca, orca, "rk4")
