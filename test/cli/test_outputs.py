"""No output of a command destroys a log: each of these ended with status 0 once."""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from dynssm_ros.cli.main import inputs

Run = Callable[..., tuple[int, str, str]]


def checksums(folder: Path) -> dict[str, str]:
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


@pytest.fixture
def race(laps_bag: Path, tmp_path: Path) -> Path:
    """A folder with a bag of somebody else's."""
    bag = tmp_path / "R"
    shutil.copytree(laps_bag, bag)
    metadata = bag / "metadata.yaml"
    metadata.write_text(metadata.read_text().replace("dynssm_ros", "recorder"))
    return bag


COMMANDS = {
    "extract onto its bag": [
        "extract",
        "R",
        "--signals",
        "default",
        "--rate",
        50,
        "--out",
        "laps.parquet",
        "--bag",
        "R",
    ],
    "extract onto its file": ["extract", "R/club.mcap", "--signals", "default", "--rate", 50, "--out", "R/club.mcap"],
    "replay onto its bag": ["replay", "R", "--model", "MODEL", "--out", "R"],
    "simulate onto a bag": ["simulate", "--vehicle", "orca", "--track", "club", "--duration", 1, "--out", "R"],
    "onto a device": ["extract", "R", "--signals", "default", "--rate", 50, "--out", "/dev/null"],
}


@pytest.mark.parametrize("what", sorted(COMMANDS))
@pytest.mark.parametrize("forced", [False, True])
def test_a_raw_bag_survives_every_command(
    what: str, forced: bool, race: Path, small_model: Path, dynssm: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(race.parent)
    before = checksums(race)
    words = [small_model if word == "MODEL" else word for word in COMMANDS[what]]
    forces = forced and what != "simulate onto a bag"  # which reads nothing: there --force means it
    status, _, err = dynssm(*words, *(["--force"] if forces else []))
    assert status == 1
    assert err.startswith("error: ")
    assert err.count("\n") == 1
    assert checksums(race) == before


def test_force_replaces_what_others_wrote(race: Path, dynssm: Run) -> None:
    before = checksums(race)
    status, _, _ = dynssm("simulate", "--vehicle", "orca", "--track", "club", "--duration", 1, "--out", race, "--force")
    assert status == 0
    assert checksums(race) != before


def test_a_recording_replaces_a_recording_and_nothing_else(race: Path, dynssm: Run, tmp_path: Path) -> None:
    out = tmp_path / "laps.parquet"
    for _ in range(2):
        assert dynssm("extract", race, "--signals", "default", "--rate", 50, "--out", out)[0] == 0
    out.write_text("a thesis")
    status, _, err = dynssm("extract", race, "--signals", "default", "--rate", 50, "--out", out)
    assert (status, out.read_text()) == (1, "a thesis")
    assert "exists and is not a recording; not replaced (another name, or --force)" in err


def test_what_a_command_reads_is_all_but_its_outputs(tmp_path: Path) -> None:
    for name in ("laps.parquet", "car.yaml", "out"):
        (tmp_path / name).touch()
    laps, car, out = (str(tmp_path / name) for name in ("laps.parquet", "car.yaml", "out"))
    assert inputs(["diagnose", laps, "--vehicle", car, "--out", out]) == [Path(laps), Path(car)]
    assert inputs(["diagnose", laps, f"--vehicle={car}", f"--out={out}", "--exclude", "drag"]) == [
        Path(laps),
        Path(car),
    ]
