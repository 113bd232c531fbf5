"""The plant: the published Euler protocol, Runge-Kutta, pose and effect states."""

import numpy as np
import pytest

from dynssm_ros import compiled
from dynssm_ros.simulation.plant import Pose, SingleTrackPlant
from dynssm_ros.track.tracks import load_track
from dynssm_ros.vehicle import Applied, State, load_vehicle
from dynssm_ros.vehicle.single_track import StageEffect

START = Pose(1.0, -2.0, 0.4), State(2.0, 0.05, 1.0)


def run(vehicle, kind, steps=10, pose=START[0], state=START[1], **options):
    car = SingleTrackPlant(vehicle, kind, pose, state, **options)
    for k in range(steps):
        car.advance(Applied(0.5, 0.1 + 0.01 * k))
    return np.array([*car.pose, *car.state])


def test_euler_reproduces_the_published_orca_run(data):
    published = np.load(data / "orca" / "ethz_pure_pursuit.npz")
    rows, inputs = published["dstates"].T, published["inputs"].T
    rows[0, :3] = published["states"][:3, 0]  # zero in the file
    orca = load_vehicle("orca")
    for row, applied, following in zip(rows[:-1], inputs, rows[1:], strict=True):
        car = SingleTrackPlant(orca, "euler", Pose(*row[:3]), State(*row[3:6]))
        car.advance(Applied(*applied))
        np.testing.assert_allclose([*car.pose, *car.state], following[:6], rtol=0, atol=1e-12)


def test_euler_moves_the_pose_by_the_velocity_at_the_start_of_the_step():
    orca = load_vehicle("orca")
    (x, y, theta), (v_x, v_y, omega) = START
    car = SingleTrackPlant(orca, "euler", *START)
    car.advance(Applied(0.3, 0.1))
    expected = (
        x + 0.02 * (v_x * np.cos(theta) - v_y * np.sin(theta)),
        y + 0.02 * (v_x * np.sin(theta) + v_y * np.cos(theta)),
    )
    np.testing.assert_allclose(car.pose, [*expected, theta + 0.02 * omega], atol=1e-15)


def coarse(name, sampling_time):
    return load_vehicle(name).model_copy(update={"sampling_time": sampling_time})


def test_rk4_is_of_fourth_order_in_state_and_pose():
    av21 = coarse("av21", 0.04)
    fast = Pose(0.0, 0.0, 0.1), State(30.0, 0.2, 0.1)

    def final(step):
        return run(av21, "rk4", 5, *fast, step=step)

    exact = final(0.000625)
    coarser, finer = final(0.02) - exact, final(0.01) - exact
    for part in (slice(0, 3), slice(3, 6)):
        assert 12 < np.linalg.norm(coarser[part]) / np.linalg.norm(finer[part]) < 20


def test_euler_approaches_rk4_in_first_order():
    def error(divisor):
        return np.abs(run_fine("euler", divisor) - run_fine("rk4", 16))

    def run_fine(kind, divisor):
        car = SingleTrackPlant(coarse("orca", 0.02 / divisor), kind, *START)
        for _ in range(10 * divisor):
            car.advance(Applied(0.5, 0.1))
        return np.array([*car.pose, *car.state])

    ratio = error(8) / error(16)
    assert np.all((ratio > 1.7) & (ratio < 2.4))


def test_lagging_steering_is_carried_from_step_to_step():
    orca = load_vehicle("orca").with_effect("steering_lag", {"time_constant": 0.1})
    car = SingleTrackPlant(orca, "euler", Pose(0, 0, 0), State(2.0, 0.0, 0.0))
    reference = SingleTrackPlant(load_vehicle("orca"), "euler", Pose(0, 0, 0), State(2.0, 0.0, 0.0))
    delta = 0.0
    for _ in range(20):
        car.advance(Applied(0.2, 0.2))
        reference.advance(Applied(0.2, delta))
        delta += 0.02 / 0.1 * (0.2 - delta)  # the lag under forward Euler
        np.testing.assert_allclose(car.state, reference.state, rtol=1e-12)
    assert car.state.omega > 1.0


def test_effects_see_time_place_and_pose():
    seen = []

    class Witness(StageEffect):  # no file of its own, so that it is not traced
        def slip(self, xp, q):
            seen.append(dict(q.context))

    line = load_track("club").centre
    start = Pose(1.0, 2.0, 0.5), State(2.0, 0.0, 0.0)
    car = SingleTrackPlant(load_vehicle("orca"), "euler", *start, last=(Witness(),), line=line)
    seen.clear()
    car.advance(Applied(0.0, 0.0), s=3.0)
    car.advance(Applied(0.0, 0.0), s=3.1)
    clock = 6400.0  # s; a drive begins 1e9 s after the epoch, at 01:46:40
    assert seen[0] == {"t": 0.0, "clock": clock, **line.place(3.0), "x": 1.0, "y": 2.0, "theta": 0.5}
    assert seen[1]["t"] == pytest.approx(0.02)
    assert seen[1]["x"] > 1.0


class Wanders(StageEffect):
    """Grip by chance: a trace would hold one throw for ever."""

    def __init__(self):
        self.rng = np.random.default_rng(1)

    def tyres(self, xp, q):
        q.F_fy = q.F_fy * self.rng.uniform(0.8, 1.0)


class Tires(StageEffect):
    """Loses grip with every call."""

    def __init__(self):
        self.calls = 0

    def tyres(self, xp, q):
        self.calls += 1
        q.F_fy = q.F_fy * (1.0 if self.calls < 50 else 0.5)


class Branches(StageEffect):
    """Has no drive force above a speed."""

    def drive(self, xp, q):
        if q.v_x > 1.99:
            q.F_rx = 0.0 * q.F_rx


@pytest.mark.parametrize("effect", [Wanders, Tires, Branches])
def test_what_a_trace_cannot_hold_drives_by_its_own_code(effect, monkeypatch):
    orca = load_vehicle("orca")
    found = run(orca, "rk4", last=(effect(),))
    assert not np.allclose(found, run(orca, "rk4"), rtol=0, atol=1e-6)
    monkeypatch.setattr(compiled, "LIBRARY", None)
    np.testing.assert_array_equal(found, run(orca, "rk4", last=(effect(),)))
