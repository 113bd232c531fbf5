"""The car inside the controller is the package's single-track car."""

import numpy as np
import pytest

from dynssm_ros.control.horizon_model import HorizonModel
from dynssm_ros.runtime.predictor import propagate_pose
from dynssm_ros.simulation.double_track import DoubleTrack
from dynssm_ros.simulation.plant import Pose, make_plant
from dynssm_ros.vehicle import Applied, CarModel, Coefficients, State
from dynssm_ros.vehicle.effects import EFFECTS

N = 3
NOW = np.array([0.3, -0.2, 0.7, 1.8, -0.1, 2.0, 0.4, 0.12])
U = np.array([0.1, -0.03])
ADDED = np.array([0.02, -0.01, 0.3])


def parameters(vehicle):
    return np.concatenate([vehicle.nominal, ADDED, [0.5, 0.0, 12.0, 0.3]])


@pytest.mark.parametrize(("integrator", "substeps"), [("euler", 1), ("rk4", 2)])
def test_a_step_is_the_single_track_step_plus_the_correction(orca, integrator, substeps):
    model = HorizonModel(CarModel(orca.constants, 0.02, (), integrator, substeps), N)
    x = model.step(NOW, U, parameters(orca))
    now, applied = State(*NOW[3:6]), Applied(*(NOW[6:] + U))
    theta = Coefficients(*orca.nominal)
    stepped = CarModel(orca.constants, 0.02, (), integrator, substeps).step(now, applied, theta)[0]
    following = np.array(stepped) + ADDED
    np.testing.assert_allclose(x[3:6], following, rtol=1e-12)
    np.testing.assert_allclose(x[6:8], applied, rtol=1e-15)
    pose = propagate_pose(dict(zip(("x", "y", "theta"), NOW[:3], strict=True)), now, following, 0.02)
    np.testing.assert_allclose(x[:3], pose, rtol=1e-12)


@pytest.mark.parametrize(("plant", "car", "travel", "off"), [
    ("euler", ("euler", 1), "start", 1e-12),
    ("rk4", ("rk4", 2), "middle", 2e-4),
])  # fmt: skip
def test_the_true_model_moves_as_its_plant(orca, plant, car, travel, off):
    """State and pose, in a quick turn; with the other travel the published car would be a millimetre beside where it is."""
    driven = make_plant(orca, plant, Pose(*NOW[:3]), State(*NOW[3:6]))
    driven.advance(Applied(*(NOW[6:] + U)))
    p = np.concatenate([orca.nominal, np.zeros(3), [0.0, 0.0, 12.0, 0.0]])
    following = {
        each: HorizonModel(CarModel(orca.constants, 0.02, (), *car), N, each).step(NOW, U, p)
        for each in ("start", "middle")
    }
    np.testing.assert_allclose(following[travel][:6], [*driven.pose, *driven.state], rtol=0, atol=off)
    assert np.hypot(*(following["start"] - following["middle"])[:2]) > 9e-4


@pytest.mark.parametrize("travel", ["start", "middle"])
def test_the_jacobians_are_those_of_the_step(orca, travel):
    model = HorizonModel(CarModel(orca.constants, 0.02, (), "rk4", 1), N, travel)
    x, u = np.tile(NOW, (N, 1)) * np.array([[1.0], [1.1], [0.9]]), np.tile(U, (N, 1))
    p = np.tile(parameters(orca), (N, 1))
    following, by_x, by_u = model.linearised(x, u, p)
    for k in range(N):
        np.testing.assert_allclose(following[k], model.step(x[k], u[k], p[k]), rtol=1e-12)
        for j, h in enumerate(1e-6 * np.eye(8)):
            slope = (model.step(x[k] + h, u[k], p[k]) - model.step(x[k] - h, u[k], p[k])) / 2e-6
            np.testing.assert_allclose(by_x[k, :, j], slope, rtol=1e-5, atol=1e-6)
        for j, h in enumerate(1e-6 * np.eye(2)):
            slope = (model.step(x[k], u[k] + h, p[k]) - model.step(x[k], u[k] - h, p[k])) / 2e-6
            np.testing.assert_allclose(by_u[k, :, j], slope, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("name", [*EFFECTS, "double_track"])
def test_every_effect_acts_and_can_be_differentiated(orca, acting, name):
    car = orca.model_copy(update={"constants": orca.constants.model_copy(update={"h_cg": 0.02, "load_transfer": True})})
    values = {} if name == "double_track" else acting(name)
    if name == "grip_patch":
        values = {"factor": 0.6, "centre": 0.0, "length": 0.2}
    effect = DoubleTrack.of(car.constants) if name == "double_track" else EFFECTS[name](**values)
    if "roll" in getattr(effect, "needs", ()):
        pytest.skip("needs the measured roll, which a controller does not have")
    effects = (effect,)
    model = HorizonModel(CarModel(car.constants, 0.02, effects), N)
    x = np.concatenate([NOW, np.full(model.size - 8, float(name == "gear_shift"))])  # in the upper gear
    following, by_x, _ = model.linearised(np.tile(x, (N, 1)), np.tile(U, (N, 1)), np.tile(parameters(orca), (N, 1)))
    plain = HorizonModel(CarModel(car.constants, 0.02), N).step(NOW, U, parameters(orca))
    assert np.all(np.isfinite(by_x))
    if name != "odometry_delay":
        assert not np.allclose(following[0, :8], plain, rtol=1e-9, atol=0)


def test_slip_angles_are_those_of_the_physics_with_shifts_and_effects(orca):
    """Closed form, and what an effect on the steering changes; the Jacobian by differences."""
    car = orca.with_effect("steering_offset", {"offset": 0.02})
    model = HorizonModel(CarModel.at_any_speed(car), 2)
    x = np.zeros((2, model.size))
    x[:, 3:8] = [[1.9, 0.03, 1.5, 0.3, 0.1], [2.4, -0.1, -2.0, 0.2, -0.05]]
    p = np.tile(parameters(car), (2, 1)) if parameters(car).ndim == 1 else parameters(car)[:2]
    slips, by_x = model.slip_angles(x, p)
    theta, c = Coefficients(*car.nominal), car.constants
    v_x, v_y, omega, delta = x[:, 3], x[:, 4], x[:, 5], x[:, 7]
    front = delta + 0.02 - np.arctan2(v_y + c.l_f * omega, v_x) + theta.S_hf
    rear = np.arctan2(c.l_r * omega - v_y, v_x) + theta.S_hr
    np.testing.assert_allclose(slips, np.stack([front, rear], axis=1), atol=1e-12)
    for k in range(model.size):
        moved = x.copy()
        moved[:, k] += 1e-6
        np.testing.assert_allclose((model.slip_angles(moved, p)[0] - slips) / 1e-6, by_x[:, :, k], atol=1e-5)
