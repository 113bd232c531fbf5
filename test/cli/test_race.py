"""``dynssm race`` from the shell's point of view."""

from __future__ import annotations

import json

import pytest
from PIL import Image

SHORT = ("--vehicle", "orca", "--track", "club", "--plant", "euler", "--line", "centre", "--speed-scale", "0.8")


def test_race_writes_a_report_a_table_and_json(dynssm, tmp_path):
    out, result = tmp_path / "race", tmp_path / "race.json"
    models = ("--model", "true", "--model", "persistence")
    more = ("--offset-free", "--noise", "0.01,0.01,0.03", "--delay", "20", "--seed", "3")
    status, text, _ = dynssm("race", *SHORT, *models, "--out", out, "--json", result, *more)
    assert status == 0
    assert "true" in text
    content = json.loads(result.read_text())
    assert content == json.loads((out / "results.json").read_text())
    assert (content["track"], content["plant"], content["objective"]) == ("club", "euler", "tracking")
    assert content["offset_free"]
    assert (content["noise"], content["pose_noise"], content["seed"]) == ([0.01, 0.01, 0.03], [0.0] * 3, 3)
    assert content["delay_s"] == 0.02
    assert list(content["models"]) == ["true", "persistence"]
    assert content["models"]["true"]["completed"]
    assert (out / "report.html").stat().st_size > 50_000


@pytest.mark.slow
def test_an_animation_shows_the_lap(dynssm, tmp_path):
    status, _, _ = dynssm("race", *SHORT, "--model", "true", "--out", tmp_path / "race", "--animation")
    assert status == 0
    with Image.open(tmp_path / "race" / "race.gif") as animation:
        assert animation.n_frames == 120


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["--model", "oracle"], "neither a model folder nor one of true"),
        (["--model", "true", "--model", "true"], "given twice"),
        (["--model", "true", "--scale", "1", "--lap-length", "20"], "expected one of them"),
        (["--model", "true", "--line", "racing", "--lap-length", "1"], "expected more than twice the margin"),
        (["--model", "true", "--lap-length", "1"], "m, the width of orca"),
        (["--model", "true", "--start-speed", "-1"], "expected 0 or more"),
        (["--model", "true", "--start-offset", "0.5"], "expected it on the road"),
        (["--model", "true", "--objective", "glory"], "Invalid value for '--objective'"),
        (["--model", "single_track", "--effect", "rocket"], "unknown effect 'rocket'"),
        (["--model", "true", "--delay", "1000"], "delay 1 s: expected 0 to 0.4 s"),
        (
            ["--model", "true", "--pose-noise", "1,2"],
            "--pose-noise: expected three numbers, as in 0.02,0.01,0.002 (got '1,2')",
        ),
    ],
)
def test_what_cannot_be_raced_is_one_line(refused, tmp_path, arguments, complaint):
    assert complaint in refused("race", *SHORT, *arguments, "--out", tmp_path / "race")
    assert not (tmp_path / "race").exists()
