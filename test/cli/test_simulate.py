"""``dynssm simulate`` from the shell's point of view."""

from __future__ import annotations

import json

import pytest

from dynssm_ros.signals.bags import open_bag


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
        (["--noise", "1,2"], "expected three numbers"),
        (["--noise", "0,-1,0"], "expected finite numbers of at least 0"),
        (["--laps", "1", "--duration", "5"], "expected one of them, positive"),
        (["--scale", "0"], "scale 0; expected a positive number"),
        (["--scale", "0.2"], "orca leaves track club"),
        (["--scale", "0.1", "--line", "racing"], "track club is 0.04 m wide"),
    ],
)
def test_user_errors_are_one_line_and_leave_no_bag(dynssm, tmp_path, arguments, complaint):
    status, _, err = dynssm("simulate", "--vehicle", "orca", "--track", "club", "--out", tmp_path / "bag", *arguments)
    assert status == 1
    assert complaint in err
    assert err.strip().count("\n") == 0
    assert list(tmp_path.iterdir()) == []
