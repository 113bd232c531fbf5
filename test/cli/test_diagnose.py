"""``dynssm diagnose``: folder, JSON, words; what does not fit is one line."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from benchmarks.hidden_causes.cases import Case, record
from dynssm_ros.vehicle import load_vehicle, save_vehicle
from dynssm_ros.vehicle.effects import EFFECTS

Run = Callable[..., tuple[int, str, str]]
Refused = Callable[..., str]
FEW = [word for name in set(EFFECTS) - {"steering_offset", "drag"} for word in ("--exclude", name)]  # two are tried


@pytest.fixture(scope="module")
def offset(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Laps of a car whose steering is off, and the vehicle file that does not know."""
    folder = tmp_path_factory.mktemp("offset")
    recording, vehicle = record(Case({"steering_offset": {"offset": 0.015}}, 2, "euler", 70.0))
    recording.save(folder / "laps.parquet")
    save_vehicle(vehicle, folder / "car.yaml")
    return folder / "laps.parquet", folder / "car.yaml"


def test_the_folder_holds_vehicle_report_and_results(dynssm: Run, offset: tuple[Path, Path], tmp_path: Path) -> None:
    laps, car = offset
    arguments = ["--vehicle", car, "--out", tmp_path / "out", "--json", tmp_path / "copy.json", "--integrator", "euler"]
    status, out, err = dynssm("diagnose", laps, *arguments, *FEW, "--track", "road_course")
    assert status == 0
    assert all(line.startswith("diagnosing: ") for line in err.splitlines()), "nothing but how far it is"
    assert out.startswith("cause: The simulation lacks: steering_offset.\n")
    assert "What to do: Re-zero the steering sensor" in out
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["report.html", "results.json", "vehicle.yaml"]
    result = json.loads((tmp_path / "copy.json").read_text())
    assert result == json.loads((tmp_path / "out" / "results.json").read_text())
    assert result["vehicle"] == str(tmp_path / "out" / "vehicle.yaml")
    extended = load_vehicle(result["vehicle"])
    (effect,) = extended.effects
    assert effect.name == "steering_offset"
    assert effect.parameters["offset"] == pytest.approx(0.015, abs=0.003)

    status, _, err = dynssm("simulate", "--vehicle", result["vehicle"], "--track", "road_course", "--duration", 1, "--out",
                            tmp_path / "bag")  # fmt: skip
    assert (status, err) == (0, "")


@pytest.mark.slow
def test_several_processes_find_what_one_finds(dynssm: Run, offset: tuple[Path, Path], tmp_path: Path) -> None:
    laps, car = offset
    found = []
    for jobs in ("1", "2"):
        out = tmp_path / jobs
        status, _, _ = dynssm("diagnose", laps, "--vehicle", car, "--out", out, "--integrator", "euler", "--jobs", jobs)
        assert status == 0
        found.append(json.loads((out / "results.json").read_text()) | {"vehicle": ""})
    assert found[0] == found[1]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--vehicle", "orca"], "sampling time 0.04 s, but vehicle orca has 0.02 s"),
        (["--vehicle", "gone"], "'gone' is neither a file nor a shipped name"),
        (["--vehicle", "av21", "--holdout", "0.01"], "holdout 0.01: expected a share between 0.05 and 0.8"),
        (["--vehicle", "av21", "--track", "moon"], "track 'moon' is neither a file nor a built-in name"),
    ],
)
def test_what_does_not_fit_is_one_line_and_leaves_nothing(
    refused: Refused, offset: tuple[Path, Path], tmp_path: Path, options: list[str], words: str
) -> None:
    line = refused("diagnose", offset[0], *options, "--out", tmp_path / "out")
    assert words in line
    assert list(tmp_path.iterdir()) == []


def test_a_vehicle_file_without_a_needed_constant_is_one_line(
    refused: Refused, offset: tuple[Path, Path], tmp_path: Path
) -> None:
    text = offset[1].read_text()
    broken = tmp_path / "broken.yaml"
    broken.write_text(text.replace("l_f: 1.248,", ""))
    line = refused("diagnose", offset[0], "--vehicle", broken, "--out", tmp_path / "out")
    assert "constants.l_f" in line


def test_without_a_recording_is_one_line(dynssm: Run, tmp_path: Path) -> None:
    status, _, err = dynssm("diagnose", "--vehicle", "av21", "--out", tmp_path / "out")
    assert (status, err.strip()) == (1, "error: no recording given; expected R.parquet or --reference R.parquet")


@pytest.mark.slow
def test_reference_and_suspect_are_compared(dynssm: Run, offset: tuple[Path, Path], tmp_path: Path) -> None:
    straight = record(Case({}, 2, "euler", 70.0))[0]
    straight.save(tmp_path / "before.parquet")
    arguments = ["--vehicle", offset[1], "--out", tmp_path / "out", "--integrator", "euler", *FEW]
    status, out, _ = dynssm("diagnose", "--reference", tmp_path / "before.parquet", "--suspect", offset[0], *arguments)
    assert status == 0
    assert out.startswith(
        "cause: The simulation lacks: steering_offset (only in steering_offset/euler/road_course/25Hz/2).\n"
    )
    (cause,) = json.loads((tmp_path / "out" / "results.json").read_text())["causes"]
    assert cause["only_in"] == ["steering_offset/euler/road_course/25Hz/2"]
    (effect,) = load_vehicle(tmp_path / "out" / "vehicle.yaml").effects
    assert effect.parameters["offset"] == pytest.approx(0.015, abs=0.003)
