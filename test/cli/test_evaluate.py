"""``dynssm evaluate`` from the shell's point of view."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
import yaml

from dynssm_ros.api import evaluate
from dynssm_ros.errors import DataWarning
from dynssm_ros.runtime.artifact import open_artifact
from dynssm_ros.signals.extraction import extract
from dynssm_ros.signals.inputs import WINDOW_COLUMNS
from dynssm_ros.signals.recording import Recording, RecordingInfo
from dynssm_ros.signals.signal_map import load_signal_map
from dynssm_ros.track.tracks import load_track
from dynssm_ros.vehicle import load_vehicle, save_vehicle


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


@pytest.fixture
def laps(laps_bag, tmp_path):
    """Two seconds of the simulated car on the club track, less than a lap, as a recording."""
    path = tmp_path / "laps.parquet"
    extract([laps_bag], load_signal_map("default"), 50.0).select(slice(0, 100)).save(path)
    return path


@pytest.fixture
def quick_figures(monkeypatch):
    """Figures are made but not drawn, which takes most of the time of a report."""
    monkeypatch.setattr("dynssm_ros.reporting.page.svg_uri", lambda figure: "data:,")


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
    assert results["horizon_s"] == 0.6
    assert "single_track" in shown
    assert "report.html" in shown


@pytest.mark.slow
@pytest.mark.usefixtures("quick_figures")
def test_several_processes_find_what_one_finds(dynssm, laps, small_model, tmp_path):
    models = ("--model", "persistence", "--model", small_model, "--model", "single_track", "--vehicle", "orca")
    found = []
    for jobs in (1, 2):
        assert dynssm("evaluate", laps, *models, "--stride", 10, "--jobs", jobs, "--out", tmp_path / str(jobs))[0] == 0
        results = json.loads((tmp_path / str(jobs) / "results.json").read_text())
        times = [model.pop("latency_us") for model in results["models"].values()]
        assert all(time["p50"] > 0 for time in times), "taken here, one after the other"
        found.append(results)
    assert list(found[0]["models"]) == list(found[1]["models"])
    assert found[0] == found[1]


@pytest.mark.usefixtures("quick_figures")
def test_holdout_scores_the_last_block_only(dynssm, recording, tmp_path):
    code, _, _ = dynssm("evaluate", recording, "--model", "persistence", "--holdout", "0.25", "--out", tmp_path / "out")
    results = json.loads((tmp_path / "out" / "results.json").read_text())
    assert code == 0
    assert results["rows"] == 49
    assert results["split"] == "last 25 % of the recording, as one block"
    last = np.diff(Recording.load(recording).matrix[150:, :3], axis=0)
    assert results["models"]["persistence"]["rmse"]["v_y"] == pytest.approx(np.sqrt(np.mean(last[:, 1] ** 2)))


@pytest.mark.usefixtures("quick_figures")
def test_several_seeds_become_one_row_and_errors_are_placed_on_the_given_track(dynssm, small_model, laps, tmp_path):
    other = shutil.copytree(small_model, tmp_path / "again")
    card = yaml.safe_load((other / "model.yaml").read_text())
    card["training"]["seed"] = card["architecture"]["training"]["seed"] = 5
    (other / "model.yaml").write_text(yaml.safe_dump(card))
    models = ("--model", small_model, "--model", other)
    code, shown, _ = dynssm("evaluate", laps, *models, "--track", "club", "--out", tmp_path / "out")
    assert code == 0
    results = json.loads((tmp_path / "out" / "results.json").read_text())["models"]
    assert list(results) == ["small"]
    assert results["small"]["seeds"] == [0, 5]
    assert results["small"]["std"]["rmse"] == {"v_x": 0.0, "v_y": 0.0, "omega": 0.0}
    assert "small: n = 2, seeds 0, 5" in " ".join(shown.split())
    assert "peaks of one model are its own" in (tmp_path / "out" / "report.html").read_text()


def test_a_track_that_was_not_driven_is_refused(refused, laps, tmp_path):
    centre = load_track("club").centre.points + 5.0
    track = tmp_path / "elsewhere.csv"
    track.write_text("# x_m,y_m,w_tr_right_m,w_tr_left_m\n" + "\n".join(f"{x},{y},0.2,0.2" for x, y in centre))
    line = refused("evaluate", laps, "--model", "persistence", "--track", track, "--out", tmp_path / "out")
    assert re.search(
        r"elsewhere.csv: the recording lies \S+ m \(median\) from its centre line; expected the same", line
    )
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (("--model", "no_such_model"), "model 'no_such_model': neither a model folder nor one of persistence, "),
        (("--model", "single_track"), "needs --vehicle"),
        (("--model", "single_track", "--vehicle", "av21_paper"), "extract the bag at 25 Hz"),
        (("--model", "persistence", "--min-speed", "90"), "at 90 m/s or more"),
        (("--model", "persistence", "--holdout", "-1"), "--holdout: Input should be greater than 0 (got -1.0)"),
        (("--model", "persistence", "--commands", "topics"), "commands 'topics' asked for"),
        (("--model", "persistence", "--track", "nowhere"), "track 'nowhere' is neither a file nor a built-in name"),
        (("--model", "persistence", "--track", "club"), "--track club: the recording holds no positions (x, y)"),
    ],
)
def test_bad_input_gets_one_line_and_leaves_nothing_behind(refused, recording, tmp_path, arguments, expected):
    line = refused("evaluate", recording, *arguments, "--out", tmp_path / "out")
    assert expected in line
    assert not (tmp_path / "out").exists()


def test_what_the_car_file_left_out_is_left_out_of_training_and_scored(dynssm, laps_bag, tmp_path, monkeypatch):
    """Until another share is asked for, which is warned of where it was trained on."""
    monkeypatch.chdir(tmp_path)
    recording, car = extract([laps_bag], load_signal_map("default"), 50.0), load_vehicle("orca")
    recording.save("laps.parquet")
    save_vehicle(car.with_held_out({recording.beginning: 0.25}), "car.yaml")
    dynssm("train", "laps.parquet", "--model", "ridge", "--vehicle", "car.yaml", "--out", "model")
    assert open_artifact(tmp_path / "model").card.training["holdout"] == 0.25
    found = evaluate("laps.parquet", ["model", "persistence"], stride=50)
    assert (found.split, found.not_tests) == ("last 25 % of the recording, as one block", [])
    with pytest.warns(DataWarning, match="ridge was trained on"):
        assert evaluate("laps.parquet", ["model"], holdout=0.9, stride=50).not_tests


def test_several_recordings_are_scored_at_the_end_of_each(recording):
    log = Recording.load(recording)
    first, second = log.split_last(0.5)
    found = evaluate([first, second], ["persistence"], holdout=0.5, stride=50)
    assert found.split == "last 50 % of each recording, as one block"
    assert set(found.recording.time) == {*first.split_last(0.5)[1].time, *second.split_last(0.5)[1].time}


def test_a_model_that_knows_the_rows_is_named_beside_the_table(dynssm, laps_bag, quick_figures, tmp_path, monkeypatch):
    """One was trained on all of them, one on the first half alone, and a car was calibrated on all."""
    monkeypatch.chdir(tmp_path)
    laps, out, car = Path("laps.parquet"), Path("out"), load_vehicle("orca")
    recording = extract([laps_bag], load_signal_map("default"), 50.0)
    recording.save(laps)
    save_vehicle(car.calibrated_on(recording.fingerprints, car), "car.yaml")
    models = ["--model", "single_track", "--vehicle", "car.yaml"]
    for name, holdout in (("all", 0.0), ("half", 0.5)):
        dynssm("train", laps, "--model", "ridge", "--vehicle", "orca", "--holdout", holdout, "--out", name)
        models += ["--model", name]
    status, _, err = dynssm("evaluate", laps, *models, "--holdout", 0.5, "--out", out)
    assert status == 0
    told = json.loads((out / "results.json").read_text())["not_tests"]
    assert [note.split(" on ")[0] for note in told] == ["single_track has a car calibrated", "all was trained"]
    assert [line.removeprefix("warning: ") for line in err.splitlines() if line.startswith("warning: ")] == told
    assert all(f"No test: {note}." in (out / "results.md").read_text() for note in told)
