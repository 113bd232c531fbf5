"""``dynssm evaluate`` from the shell's point of view."""

from __future__ import annotations

import json

import numpy as np
import pytest

from dynssm_ros.signals.inputs import WINDOW_COLUMNS
from dynssm_ros.signals.recording import Recording, RecordingInfo


@pytest.fixture
def recording(tmp_path):
    """200 rows at 50 Hz with random inputs and states around 2 m/s."""
    rng = np.random.default_rng(2)
    matrix = rng.normal(size=(200, 7)) * [0.1, 0.1, 0.1, 0.2, 0.1, 0.0, 0.0] + [2, 0, 0, 0, 0, 0, 0]
    info = RecordingInfo(sampling_time=0.02, commands="none", source=("planted",))
    time = (np.arange(200) * 0.02 * 1e9).astype(np.int64)
    columns = {name: matrix[:, k] for k, name in enumerate(WINDOW_COLUMNS)}
    path = tmp_path / "run.parquet"
    Recording(info, time, np.zeros(200, np.int32), columns).save(path)
    return path


def test_writes_report_results_and_table(dynssm, recording, tmp_path):
    out, extra = tmp_path / "out", tmp_path / "extra.json"
    models = ("--model", "persistence", "--model", "single_track", "--vehicle", "orca")
    code, shown, _ = dynssm("evaluate", recording, *models, "--out", out, "--json", extra)
    assert code == 0
    assert sorted(p.name for p in out.iterdir()) == ["report.html", "results.json", "results.md"]
    results = json.loads((out / "results.json").read_text())
    assert results == json.loads(extra.read_text())
    assert list(results["models"]) == ["persistence", "single_track"]
    assert results["recording"] == "run.parquet"
    assert results["horizon_s"] == 0.3
    assert "single_track" in shown
    assert "report.html" in shown


def test_holdout_scores_the_last_block_only(dynssm, recording, tmp_path):
    code, _, _ = dynssm("evaluate", recording, "--model", "persistence", "--holdout", "0.25", "--out", tmp_path / "out")
    results = json.loads((tmp_path / "out" / "results.json").read_text())
    assert code == 0
    assert results["rows"] == 49
    assert results["split"] == "last 25 % of the recording, as one block"
    last = np.diff(Recording.load(recording).matrix[150:, :3], axis=0)
    assert results["models"]["persistence"]["rmse"]["v_y"] == pytest.approx(np.sqrt(np.mean(last[:, 1] ** 2)))


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (("--model", "no_such_model"), "no_such_model"),
        (("--model", "single_track"), "needs --vehicle"),
        (("--model", "single_track", "--vehicle", "av21_paper"), "extract the bag at 25 Hz"),
        (("--model", "persistence", "--min-speed", "90"), "at 90 m/s or more"),
        (("--model", "persistence", "--holdout", "-1"), "--holdout -1: expected a fraction"),
        (("--model", "persistence", "--commands", "topics"), "commands 'topics' asked for"),
    ],
)
def test_bad_input_gets_one_line_and_leaves_nothing_behind(dynssm, recording, tmp_path, arguments, expected):
    code, _, err = dynssm("evaluate", recording, *arguments, "--out", tmp_path / "out")
    assert code == 1
    assert expected in err
    assert err.strip().count("\n") == 0
    assert not (tmp_path / "out").exists()
