"""What learning online is worth in closed loop: a car that has changed, with usual noise and a step of delay."""

import numpy as np
import pytest

import dynssm_ros
from dynssm_ros.control.evidence import SOURCES

NOISE, POSE_NOISE = (0.01, 0.01, 0.03), (0.002, 0.002, 0.002)


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    """Trained on noisy laps of another track."""
    run = dynssm_ros.simulate("orca", "club", duration=60.0, seed=1, plant="double_track", noise=NOISE)
    folder = tmp_path_factory.mktemp("rls") / "rls"
    return str(dynssm_ros.train(dynssm_ros.recorded(run), "rls", "orca", folder).artifact.path)


def raced(model, effects=None, **options):
    return dynssm_ros.race(
        "orca", "club_b", ["true", "single_track", model], plant="double_track", objective="progress", laps=2,
        speed_scale=0.9, effects=effects, noise=NOISE, pose_noise=POSE_NOISE, delay=0.02, **options,
    )  # fmt: skip


@pytest.mark.slow
def test_on_a_car_that_has_lost_grip_the_second_lap_is_almost_that_of_the_true_model(model):
    true, fixed, learned = raced(model, {"front_grip": {"factor": 0.85}})
    assert max(race.outside for race in (true, fixed, learned)) == 0.0
    second = [race.lap_times[1] for race in (true, fixed, learned)]
    print("second laps (s): true, fixed, learned", np.round(second, 2))
    assert second[1] > 1.01 * second[0]
    assert second[2] < 1.005 * second[0]
    weights = learned.to_json()["planned_with"]
    assert list(weights) == list(SOURCES)
    assert weights["calibrated"] < 0.5


@pytest.mark.slow
def test_on_a_car_that_has_not_changed_nothing_is_lost(model):
    _, fixed, learned = raced(model)
    assert learned.outside == 0.0
    assert np.all(np.array(learned.lap_times) < 1.005 * np.array(fixed.lap_times))
