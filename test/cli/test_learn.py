"""``dynssm learn``: what is run, what is not run again, and what the report begins with."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import pytest

from dynssm_ros import api
from dynssm_ros.api.learn import LearnSettings, plan
from dynssm_ros.configuration import config_root
from dynssm_ros.errors import UserError
from dynssm_ros.progress import OnProgress
from dynssm_ros.reporting.page import Report, Section, figures_of

RECORDED = "dynssm_ros.reporting.learning_report._recorded"
STATES = {"v_x": 0.1, "v_y": 0.1, "omega": 0.1}
RESULTS: dict[str, dict[str, object]] = {
    "inspect": {},
    "calibrate": {"rmse_ahead": STATES, "persistence": dict.fromkeys(STATES, 0.5), "on_bound": [], "horizon_s": 0.5},
    "diagnose": {"verdict": "healthy", "causes": [], "nearest_effects": [], "small_effects": [], "moved": {}},
    "evaluate": {
        "horizon_s": 0.6,
        "models": {"model": {"ade": 0.01}, "single_track": {"ade": 0.02}, "persistence": {"ade": 0.1}},
        "not_tests": [],
    },
}


FILES = {"signals.yaml": (config_root() / "signals" / "default.yaml").read_text()}


class Commands:
    """Writes what each command would write; ``lines`` are what some print, ``status`` how some end, ``maps`` of some logs."""

    def __init__(self) -> None:
        self.verbs: list[str] = []
        self.lines: dict[str, list[str]] = {}
        self.status: dict[str, int] = {}
        self.maps: dict[str, str] = {}

    def __call__(self, command: Sequence[str], on_line: OnProgress) -> int:
        verb, options = command[0], dict(pairwise(command))
        self.verbs.append(verb)
        for line in self.lines.get(verb, []):
            on_line(line)
        if not self.status.get(verb):
            for path in _written(verb, options):
                path.parent.mkdir(parents=True, exist_ok=True)
                files = FILES | {"signals.yaml": self.maps.get(path.parent.name, FILES["signals.yaml"])}
                path.write_text(json.dumps(RESULTS[verb]) if path.suffix == ".json" else files.get(path.name, verb))
        return self.status.get(verb, 0)


def _written(verb: str, options: dict[str, str]) -> list[Path]:
    out, results = Path(options["--out"]), Path(options.get("--json", Path(options["--out"]) / "results.json"))
    return {
        "inspect": [out / "signals.yaml", results],
        "diagnose": [out / "vehicle.yaml", results],
        "train": [out / "model.yaml"],
        "evaluate": [results],
    }.get(verb, [out, results] if verb == "calibrate" else [out])


@pytest.fixture
def commands(monkeypatch: pytest.MonkeyPatch) -> Commands:
    """Commands that recordings need not be read for."""
    monkeypatch.setattr(RECORDED, lambda files: ("1 recording, 10 s", False))
    made = Commands()
    monkeypatch.setattr(sys.modules["dynssm_ros.api.learn"], "_in_a_process", made)
    return made


@pytest.fixture
def log(tmp_path: Path) -> Path:
    file = tmp_path / "run.csv"
    file.write_text("time\n0\n")
    return file


@pytest.mark.parametrize("signals", [None, "default"])
def test_a_car_with_another_first_input_is_told_after_the_first_look(
    commands: Commands, log: Path, tmp_path: Path, signals: str | None
) -> None:
    found = api.learn([log], "f1tenth", tmp_path / "out", signals=signals)
    assert commands.verbs == ["inspect"]
    seen = api.learn([log], "f1tenth", tmp_path / "seen", signals="default_speed")
    assert not seen.failure
    again = api.learn([log], "f1tenth", tmp_path / "seen", signals="default")
    assert "its first input is a throttle" in again.failure, "although the log was looked at before"
    assert found.failure == (
        "signal map default: its first input is a throttle, but vehicle f1tenth takes a speed set-point (inputs.set_point: "
        "speed); `dynssm vehicle new --set-point throttle` writes a file that fits"
    )


def test_a_map_that_is_corrected_after_the_first_look_is_kept(commands: Commands, log: Path, tmp_path: Path) -> None:
    corrected = (config_root() / "signals" / "default_speed.yaml").read_text()
    assert api.learn([log], "f1tenth", tmp_path / "out").failure
    file = tmp_path / "out" / "inspection" / "run" / "signals.yaml"
    file.write_text(corrected)
    assert not api.learn([log], "f1tenth", tmp_path / "out").failure
    assert file.read_text() == corrected
    assert commands.verbs == WAY


WAY = ["inspect", "extract", "calibrate", "diagnose", "train", "evaluate"]


def lines(out: Path) -> dict[str, str]:
    """The state of each line that the page begins with."""
    return dict(
        re.findall(r'<b>(\w+)</b><span class="state">(\w+)</span>', (out / "index.html").read_text(encoding="utf-8"))
    )


def test_what_is_unchanged_is_not_run_again(commands: Commands, log: Path, tmp_path: Path) -> None:
    """A map that was corrected by hand is kept, and what hangs on it is done anew."""
    out, told = tmp_path / "out", list[str]()
    assert api.learn(log, "orca", out).failure == ""
    assert commands.verbs == WAY
    assert lines(out) == dict.fromkeys(("data", "car", "diagnosis", "model"), "ok")
    api.learn(log, "orca", out, on_progress=told.append)
    assert (len(commands.verbs), told.count("as before")) == (6, 6)
    assert f"[1/6] dynssm inspect {log} --vehicle orca" in told[0]
    (out / "inspection" / "run" / "signals.yaml").write_text(FILES["signals.yaml"] + "# corrected\n")
    api.learn(log, "orca", out)
    assert commands.verbs[6:] == ["extract"]  # whose recording is the same again
    log.write_text("time\n0\n1\n")
    api.learn(log, "orca", out)
    assert commands.verbs[7:] == ["inspect", "extract"]
    (out / "car.yaml").unlink()
    api.learn(log, "orca", out, settings=LearnSettings(holdout=0.25))
    assert commands.verbs[9:] == ["calibrate"]


def test_a_failed_step_ends_it_and_is_told_first(commands: Commands, log: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    commands.lines = {"calibrate": ["error: signs are wrong"], "extract": ["warning: v_y is rough"]}
    commands.status = {"calibrate": 1}
    assert api.learn(log, "orca", out).failure == "signs are wrong"
    assert lines(out) == {"data": "look", "car": "wrong", "diagnosis": "look", "model": "look"}
    assert "v_y is rough" in (out / "index.html").read_text()
    commands.status = {}
    api.learn(log, "orca", out)
    assert commands.verbs[3:] == WAY[2:]


def test_signals_that_contradict_each_other_are_wrong(
    commands: Commands, log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(RECORDED, lambda files: ("1 recording, 10 s", True))
    commands.lines = {"extract": ["warning: run: steering_sign: the other way round"]}
    api.learn(log, "orca", tmp_path / "out")
    assert lines(tmp_path / "out")["data"] == "wrong"


@pytest.mark.parametrize(
    ("verb", "changed", "name", "state"),
    [
        ("calibrate", {"on_bound": ["D_f"]}, "car", "look"),
        ("calibrate", {"rmse_ahead": dict.fromkeys(STATES, 0.6)}, "car", "wrong"),
        ("diagnose", {"verdict": "unexplained", "nearest_effects": [{"effect": "drag"}]}, "diagnosis", "look"),
        ("diagnose", {"verdict": "recalibrate", "moved": {"D_r": {}}}, "diagnosis", "look"),
        ("evaluate", {"not_tests": ["model was trained on it"]}, "model", "look"),
        ("evaluate", {"models": {"m": {"ade": 0.3}, "single_track": {"ade": 0.2}, "persistence": {"ade": 0.25}}},
         "model", "wrong"),
        ("evaluate", {"models": {"m": {"ade": 0.3}, "single_track": {"ade": 0.2}, "persistence": {"ade": 0.4}}},
         "model", "look"),
    ],
)  # fmt: skip
def test_verdicts_follow_from_the_results(
    commands: Commands, log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    verb: str, changed: dict[str, object], name: str, state: str,
) -> None:  # fmt: skip
    monkeypatch.setitem(RESULTS, verb, RESULTS[verb] | changed)
    api.learn(log, "orca", tmp_path / "out")
    assert lines(tmp_path / "out") == dict.fromkeys(("data", "car", "diagnosis", "model"), "ok") | {name: state}


def test_several_logs_have_recordings_of_their_own(tmp_path: Path) -> None:
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "run.csv").touch()
    logs = [tmp_path / "a" / "run.csv", tmp_path / "b" / "run.csv"]
    steps = list(plan(logs, "orca", tmp_path / "out", LearnSettings()))
    assert [step.outputs[0].name for step in steps if step.name == "extract"] == ["run_1.parquet", "run_2.parquet"]


def test_a_log_that_suggests_another_scale_than_the_first_is_told(
    commands: Commands, log: Path, tmp_path: Path
) -> None:
    """As often as it runs, unless a map is given."""
    other, told, out = tmp_path / "other.csv", list[str](), tmp_path / "out"
    other.write_text("time\n0\n")
    steering = 'field: "position[steering]"}'
    commands.maps["other"] = FILES["signals.yaml"].replace(steering, steering.replace("}", ", scale: 4.2}"), 1)
    expected = (
        f"warning: other: steering_feedback: scale 4.2 suits this log, scale 1 suits run; taken for all logs is "
        f"{out / 'inspection' / 'run' / 'signals.yaml'}: correct it, or leave out the log that is wrong"
    )
    for _ in range(2):
        api.learn([log, other], "orca", out, on_progress=told.append)
    assert [line for line in told if line.startswith("warning")] == [expected] * 2
    assert lines(out)["data"] == "look"
    api.learn([log, other], "orca", tmp_path / "given", signals="default", on_progress=told.append)
    assert told.count(expected) == 2


def test_a_folder_of_something_else_is_not_written_to(log: Path, tmp_path: Path, commands: Commands) -> None:
    with pytest.raises(UserError, match="is not a folder of dynssm learn"):
        api.learn(log, "orca", tmp_path)
    assert not commands.verbs


def test_figures_are_taken_from_the_sections_that_have_them(tmp_path: Path) -> None:
    drawn = Section("Errors <over> time", "Less & less.", "data:x")
    Report("", "", [Section("Without", "A table."), drawn]).save(tmp_path / "report.html")
    assert figures_of(tmp_path / "report.html") == [drawn]
