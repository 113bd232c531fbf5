"""``dynssm paper`` from the shell's point of view."""

from __future__ import annotations

import pytest
import yaml

from dynssm_ros.signals.extraction import extract
from dynssm_ros.signals.signal_map import load_signal_map

PLAN = {
    "logs": {"away": {"bag": "nowhere", "signals": "default", "rate": 50.0}},
    "drives": {"club": {"vehicle": "orca", "track": "club", "duration": 8.0, "plant": "euler"}},
    "cars": {
        "orca": {
            "vehicle": "orca", "min_speed": 0.0, "reference": "sim", "full": "dynssm_orca", "ddm": "ddm_orca",
            "fthd": "fthd_orca", "coefficients": "given",
        },
    },
    "splits": {
        "given": {"car": "orca", "train": {"recording": "club"}},
        "away": {"car": "orca", "train": {"recording": "club"}, "test": {"away": {"recording": "away"}}},
    },
    "models": {"ridge_orca": {}, "dynssm_orca": {}, "ddm_orca": {}, "fthd_orca": {}},
    "studies": {
        name: {
            "title": f"study {name}", "text": "T.", "splits": [name], "commands": "topics",
            "models": ["persistence", "single_track", "ridge_orca"], "seeds": 1,
        }
        for name in ("given", "away")
    },
    "stride": 20, "calls": 5, "quick": {"epochs": 1, "seeds": 1, "stride": 20, "duration": 6.0},
}  # fmt: skip


@pytest.fixture
def plan(tmp_path):
    """A small plan: one study predicts what is given, the other a log that is not there."""
    path = tmp_path / "plan.yaml"
    path.write_text(yaml.safe_dump(PLAN))
    return path


@pytest.fixture
def recording(laps_bag, tmp_path):
    path = tmp_path / "laps.parquet"
    extract([laps_bag], load_signal_map("default"), 50.0).select(slice(0, 200)).save(path)
    return path


def test_writes_the_document_and_goes_on_where_it_was(dynssm, plan, recording, tmp_path):
    out, document = tmp_path / "out", tmp_path / "docs" / "results.md"
    arguments = (
        "paper",
        "--plan",
        plan,
        "--out",
        out,
        "--results",
        document,
        "--test",
        f"mine={recording}",
        "--jobs",
        1,
    )
    code, shown, told = dynssm(*arguments, "--quick")
    assert code == 0
    text = document.read_text()
    assert "| `ridge_orca` |" in text
    assert "**Not results:** a quick run" in text
    assert "extract away: nowhere is not in the data folder (--data or DYNSSM_DATA)" in text
    assert "*study away, topics*: not measured" in text
    assert "train ridge_orca, seed 0, on given, commands topics: " in told
    assert f"{document} written" in " ".join(shown.split())
    code, _, told = dynssm(*arguments, "--quick")
    assert code == 0
    assert "train" not in told
    numbers = [line for line in document.read_text().splitlines() if line.startswith("| `ridge_orca` |")]
    assert numbers == [line for line in text.splitlines() if line.startswith("| `ridge_orca` |")]


def test_a_failed_step_ends_with_one_line_after_the_document(dynssm, plan, recording, tmp_path):
    content = yaml.safe_load(plan.read_text())
    content["splits"]["given"]["train"]["where"] = [{"quantity": "speed", "at_least": 500.0}]
    plan.write_text(yaml.safe_dump(content))
    code, _, told = dynssm(
        "paper", "--plan", plan, "--out", tmp_path / "out", "--test", f"mine={recording}", "--jobs", 1, "--quick"
    )
    assert code == 1
    assert told.splitlines()[-1].startswith("error: 1 of 10 steps failed")
    assert "calibrate on given, commands topics: " in told.splitlines()[-1]
    assert "could not be done" in (tmp_path / "out" / "results.md").read_text()


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (("--test", "nameless"), "--test nameless: expected NAME=R.parquet"),
        (("--test", "a/b=c.parquet"), "--test a/b=c.parquet: expected NAME=R.parquet"),
        (("--test", "club=c.parquet"), "--test club: the plan has a recording of that name"),
        (("--plan", "nowhere.yaml"), "nowhere.yaml: cannot be read"),
        (("--jobs", "0"), "greater than or equal to 1"),
    ],
)
def test_bad_input_gets_one_line_and_starts_nothing(dynssm, plan, tmp_path, arguments, expected):
    code, _, err = dynssm("paper", "--plan", plan, "--out", tmp_path / "out", *arguments)
    assert code == 1
    assert expected in err
    assert err.strip().count("\n") == 0
    assert not (tmp_path / "out").exists()
