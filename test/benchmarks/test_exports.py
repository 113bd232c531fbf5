"""An exported car drives a lap as the package's does, and the command's table says by how much it does not."""

from pathlib import Path

import numpy as np

from benchmarks.exports import GENTLE, after_a_second, looked_up, of_acados, of_f1tenth_gym, own
from dynssm_ros.simulation.laps import simulate
from dynssm_ros.track.tracks import load_track


def test_the_model_for_acados_drives_a_lap_by_itself(orca, tmp_path):
    run = simulate(orca, load_track("club"), laps=1)
    first, inputs = np.concatenate([run.pose[0], run.state[0]]), run.command[:-1]
    found = of_acados(orca, tmp_path)(first, inputs)
    np.testing.assert_allclose(found, own(orca)(first, inputs), rtol=0, atol=1e-9)
    np.testing.assert_allclose(found[:, 3:], run.state[1:], rtol=0, atol=1e-9)
    assert np.ptp(run.pose[:, 0]) > 1.0


def test_linear_tyres_and_the_steering_table_follow_a_gentle_lap(orca, tmp_path: Path):
    run = simulate(orca, load_track("club"), duration=10.0, plant="rk4", style=GENTLE)
    distance, turning = np.array(list(after_a_second(of_f1tenth_gym(orca, tmp_path), run))).T
    assert distance.max() < 0.03
    assert turning.max() < 0.05 * abs(run.state[:, 2]).max()
    off = looked_up(orca, run, tmp_path)
    assert np.sqrt(np.mean(off**2)) < 0.08 * abs(run.command[:, 1]).max()
