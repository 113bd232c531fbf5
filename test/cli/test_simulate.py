"""``dynssm simulate`` from the shell's point of view."""

from __future__ import annotations

import json

import numpy as np
import pytest

from dynssm_ros.signals.bags import open_bag
from dynssm_ros.signals.extraction import extract
from dynssm_ros.signals.signal_map import load_signal_map


def test_simulate_writes_a_bag_a_summary_and_json(dynssm, tmp_path):
    bag, result = tmp_path / "run", tmp_path / "run.json"
    orca = ("simulate", "--vehicle", "orca", "--track", "club", "--out", bag, "--duration", 9, "--seed", 4)
    status, out, _ = dynssm(*orca, "--effect", "drag:coefficient=0.001", "--noise", "0.01,0.01,0.1", "--json", result)
    assert status == 0
    assert out.count("\n") == 1
    assert "orca on club" in out
    assert "seed 4" in out
    content = json.loads(result.read_text())
    assert content["effects"] == [{"name": "drag", "parameters": {"coefficient": 0.001}}]
    assert content["duration_s"] == pytest.approx(9.0)
    assert len(content["lap_times_s"]) == int(content["laps"]) == 1
    with open_bag(bag) as opened:
        assert set(opened.counts.values()) == {451}


def test_effects_on_the_measurement_are_in_the_bag_and_not_in_the_drive(dynssm, tmp_path):
    laps = {}
    for name, effects in {"plain": (), "biased": ("--effect", "yaw_rate_bias:bias=0.2")}.items():
        options = ("--duration", 2, "--out", tmp_path / name, "--json", tmp_path / f"{name}.json", *effects)
        assert dynssm("simulate", "--vehicle", "orca", "--track", "club", *options)[0] == 0
        laps[name] = extract([tmp_path / name], load_signal_map("default"), rate=50.0)
    plain, biased = laps["plain"], laps["biased"]
    np.testing.assert_allclose(biased["omega"] - plain["omega"], 0.2, rtol=1e-9)
    for name in ("v_x", "v_y", "x", "y", "theta", "r_cmd", "delta_cmd"):
        np.testing.assert_array_equal(biased[name], plain[name])


def test_line_and_plant_are_chosen_and_said(dynssm, tmp_path):
    found = {}
    for line, plant in (("centre", "rk4"), ("racing", "double_track")):
        path = tmp_path / f"{line}.json"
        options = ("--line", line, "--plant", plant, "--laps", 1, "--out", tmp_path / line, "--json", path)
        assert dynssm("simulate", "--vehicle", "orca", "--track", "club", *options)[0] == 0
        found[line] = json.loads(path.read_text())
        assert (found[line]["line"], found[line]["plant"]) == (line, plant)
    assert found["racing"]["duration_s"] < 0.8 * found["centre"]["duration_s"]


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["--track", "nowhere"], "neither a file nor a built-in name"),
        (["--effect", "rocket"], "unknown effect 'rocket'"),
        (["--effect", "drag:coefficient"], "expected NAME=NUMBER"),
        (["--effect", "drag:coefficient=much"], "expected NAME=NUMBER"),
        (["--effect", "drag:coefficient=99"], "outside"),
        (["--effect", "drag:size=1"], "has no parameter 'size'"),
        (["--effect", "load_sensitivity:exponent=0.7"], "expected axle loads that change"),
        (["--effect", "road_bank:roll_gain=1"], "needs the signal roll (rad)"),
        (["--noise", "1,2"], "expected three numbers"),
        (["--noise", "0,-1,0"], "expected finite numbers of at least 0"),
        (["--laps", "1", "--duration", "5"], "expected one of them, positive"),
        (["--scale", "0"], "--scale: Input should be greater than 0"),
        (["--duration", "-1"], "--duration: Input should be greater than 0"),
        (["--scale", "0.2"], "orca leaves track club"),
        (["--scale", "0.1", "--line", "racing"], "track club is 0.04 m wide"),
    ],
)
def test_user_errors_are_one_line_and_leave_no_bag(refused, tmp_path, arguments, complaint):
    line = refused("simulate", "--vehicle", "orca", "--track", "club", "--out", tmp_path / "bag", *arguments)
    assert complaint in line
    assert list(tmp_path.iterdir()) == []
