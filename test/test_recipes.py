"""CONTRIBUTING's recipes, followed from outside the package: one file each, and everything works with them."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

import dynssm_ros
from dynssm_ros.extras import load_plugins
from dynssm_ros.runtime.onnx_model import OnnxModel
from dynssm_ros.signals.bags import write_bag
from dynssm_ros.simulation.plant import PLANTS
from dynssm_ros.vehicle.effects import EFFECTS

RECIPES = Path(__file__).parent / "recipes"


@pytest.fixture(autouse=True, scope="module")
def registered() -> Any:
    """The toys, registered by importing their files, and forgotten again."""
    from dynssm_ros.learning.models.registry import MODELS

    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(RECIPES))
        patch.setenv("DYNSSM_PLUGINS", "toy_effect,toy_model,toy_plant")
        load_plugins()
        yield
    EFFECTS.pop("brake_drag")
    PLANTS.pop("heavy_foot")
    MODELS.pop("momentum")


def test_each_recipe_is_one_file() -> None:
    """A model has a YAML beside it; nothing in the package is touched."""
    assert sorted(path.name for path in RECIPES.iterdir() if path.is_file()) == [
        "momentum.yaml", "my_car.yaml", "toy_effect.py", "toy_model.py", "toy_plant.py",
    ]  # fmt: skip


def test_a_new_effect_is_simulated_and_diagnosed(tmp_path: Path) -> None:
    hidden = {"brake_drag": {"coefficient": 0.03}}
    run = dynssm_ros.simulate("orca", "club", duration=24.0, plant="euler", effects=hidden, noise=(0.005, 0.005, 0.02))
    others = set(EFFECTS) - {"brake_drag", "drag", "rolling_resistance"}
    found = dynssm_ros.diagnose(dynssm_ros.recorded(run), "orca", integrator="euler", exclude=others)
    assert found.causes
    assert "brake_drag" in {found.causes[0].effect, *found.causes[0].alternatives}
    dynssm_ros.save_vehicle(found.vehicle, tmp_path / "car.yaml")
    assert dynssm_ros.load_vehicle(tmp_path / "car.yaml").effects == found.vehicle.effects


@pytest.mark.slow
def test_a_new_effect_acts_in_calibration_training_and_racing(tmp_path: Path) -> None:
    car = dynssm_ros.load_vehicle("orca").with_effect("brake_drag", {"coefficient": 0.03})
    laps = dynssm_ros.recorded(dynssm_ros.simulate(car, "club", duration=30.0))
    assert dynssm_ros.calibrate(laps, car, starts=1).rmse_after.max() < 1e-6
    tiny = tmp_path / "tiny.yaml"
    tiny.write_text("base: dynssm_paper_orca\nname: tiny\nphysics: {nominal: vehicle}\nresidual: null\n")
    trained = dynssm_ros.train(laps, tiny, car, tmp_path / "model", epochs=1)
    assert trained.artifact.card.vehicle.effects[0].name == "brake_drag"
    (lap,) = dynssm_ros.race(car, "club", ["single_track"], plant="euler", speed_scale=0.7)
    assert lap.completed


def test_a_new_model_is_trained_exported_evaluated_and_predicts(tmp_path: Path) -> None:
    laps = dynssm_ros.recorded(dynssm_ros.simulate("orca", "club", duration=30.0))
    trained, artifact = dynssm_ros.train(laps, RECIPES / "momentum.yaml", "orca", tmp_path / "model")
    assert trained.history["validation/prediction"][-1] < trained.history["validation/prediction"][0]
    scores = dynssm_ros.evaluate(laps, [artifact.path, "persistence"]).scores
    assert scores["toy"].rmse[0] < scores["persistence"].rmse[0]
    window = laps.matrix[None, 100:105]
    expected = trained.model.factor.detach().numpy() * np.diff(window[0, :, :3], axis=0).mean(axis=0)  # type: ignore[operator, union-attr]
    np.testing.assert_allclose(OnnxModel(artifact).predict(window).state[0] - window[0, -1, :3], expected, atol=1e-6)


@pytest.mark.slow
def test_a_new_plant_is_driven_and_its_own_model_knows_it() -> None:
    plain, heavy = (
        dynssm_ros.simulate("orca", "club", duration=5.0, plant=p, variation=0.0) for p in ("rk4", "heavy_foot")
    )
    assert heavy.state[50, 0] > plain.state[50, 0]
    true, file = dynssm_ros.race("orca", "club", ["true", "single_track"], plant="heavy_foot", speed_scale=0.7)
    assert true.completed
    assert file.completed


def test_a_new_signal_map_reads_the_cars_own_topics(tmp_path: Path) -> None:
    types = get_typestore(Stores.ROS2_JAZZY).types
    twist, point = types["geometry_msgs/msg/TwistStamped"], types["geometry_msgs/msg/PointStamped"]
    header, stamp = types["std_msgs/msg/Header"], types["builtin_interfaces/msg/Time"]
    vector, pair = types["geometry_msgs/msg/Vector3"], types["geometry_msgs/msg/Point"]
    with write_bag(tmp_path / "bag") as bag:
        bag.add_topic("/state", "geometry_msgs/msg/TwistStamped")
        bag.add_topic("/drive", "geometry_msgs/msg/PointStamped")
        for k in range(200):
            at = header(stamp(1 + k // 50, k % 50 * 20_000_000), "base_link")
            when = (1 + k // 50) * 1_000_000_000 + k % 50 * 20_000_000
            bag.write("/drive", when, point(at, pair(40.0, 5.0, 0.0)))
            inner = types["geometry_msgs/msg/Twist"](vector(2.0 + 0.001 * k, 0.1, 0.0), vector(0.0, 0.0, 0.5))
            bag.write("/state", when + 1000, twist(at, inner))
    recording = dynssm_ros.extract(tmp_path / "bag", RECIPES / "my_car.yaml", rate=50.0)
    np.testing.assert_allclose(recording["r_fb"], 0.4)
    np.testing.assert_allclose(recording["delta_fb"], np.deg2rad(5.0), rtol=1e-8)
    assert recording["v_x"][0] == pytest.approx(2.0, abs=0.01)


def test_commands_know_what_the_environment_names(tmp_path: Path) -> None:
    """In a process of its own: `dynssm` imports the modules of DYNSSM_PLUGINS."""
    command = [
        sys.executable,
        "-m",
        "dynssm_ros.cli.main",
        "simulate",
        "--vehicle",
        "orca",
        "--track",
        "club",
        "--duration",
        "1",
    ]
    effect = ["--effect", "brake_drag:coefficient=0.03", "--plant", "heavy_foot", "--out", str(tmp_path / "bag")]
    environment = os.environ | {"PYTHONPATH": str(RECIPES), "DYNSSM_PLUGINS": "toy_effect,toy_plant"}
    done = subprocess.run([*command, *effect], capture_output=True, text=True, check=False, env=environment)
    assert done.returncode == 0, done.stderr
    lost = subprocess.run(
        command, capture_output=True, text=True, check=False, env=environment | {"DYNSSM_PLUGINS": "gone"}
    )
    assert lost.returncode == 1
    assert lost.stderr.strip() == "error: DYNSSM_PLUGINS: module gone cannot be imported (No module named 'gone')"
