"""No output of a command destroys a log: each of these ended with status 0 once."""

from __future__ import annotations

import errno
import hashlib
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from dynssm_ros.cli.main import app, paths

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


INSIDE = {
    "inspect": ["inspect", "R"],
    "simulate": ["simulate", "--vehicle", "R/car.yaml", "--track", "R"],
    "extract": ["extract", "R", "--signals", "default", "--rate", "50"],
    "calibrate": ["calibrate", "R", "--vehicle", "orca"],
    "learn": ["learn", "R", "--vehicle", "orca"],
    "train": ["train", "R", "--vehicle", "orca"],
    "sweep": ["sweep", "laps.parquet", "--vehicle", "orca", "--validation", "R"],
    "evaluate": ["evaluate", "laps.parquet", "--model", "R"],
    "residuals": ["residuals", "R", "--vehicle", "orca"],
    "replay": ["replay", "bag", "--model=R"],
    "diagnose": ["diagnose", "--reference", "laps.parquet", "--suspect", "R", "--vehicle", "orca"],
    "season": ["season", "R", "--vehicle", "orca"],
    "race": ["race", "--vehicle", "orca", "--track", "oval", "--model", "R"],
    "vehicle": ["vehicle", "new", "--like", "R/car.yaml", "--mass", "3", "--front-mass", "1", "--wheelbase", "0.3"],
    "export": ["export", "--vehicle", "R/car.yaml"],
}  # R: a folder or file that the command reads
OF_FILES = ("simulate", "vehicle", "export")  # which read no folder
WITHOUT_JSON = ("learn", "vehicle", "export")


@pytest.mark.parametrize("command", sorted(command.callback.__name__ for command in app.registered_commands))
def test_no_output_of_any_command_lies_inside_its_inputs(
    command: str, dynssm: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    read = Path("R/car.yaml") if command in OF_FILES else Path("R")
    Path("R/inner").mkdir(parents=True)
    Path("link").symlink_to("R/inner", target_is_directory=True)
    (read / "old" if read.is_dir() else read).touch()
    before = sorted(tmp_path.rglob("*"))
    outputs = [read] if command in OF_FILES else [Path("R"), Path("R/new"), Path("R/inner/deep/new"), Path("link/new")]
    for output in outputs:
        for option in ("--out", "--json") if command not in WITHOUT_JSON else ("--out",):
            ways = {"--out": "elsewhere"} | {option: str(output)}
            status, _, err = dynssm(*INSIDE[command], *(word for pair in ways.items() for word in pair))
            assert status == 1
            assert err == f"error: {output}: the command reads {read.name} there; an output never replaces an input\n"
    assert sorted(tmp_path.rglob("*")) == before


def test_what_a_command_reads_is_all_but_its_outputs_and_folders_called_like_a_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("laps.parquet", "car.yaml", "out"):
        Path(name).touch()
    for name in ("orca", "oval", "rls"):
        Path(name).mkdir()
    laps, car, out, rls = (Path(name) for name in ("laps.parquet", "car.yaml", "out", "rls"))
    assert paths(["diagnose", "laps.parquet", "--vehicle", "car.yaml", "--out", "out"]) == ([laps, car], [out])
    assert paths(["diagnose", "laps.parquet", "--vehicle=car.yaml", "--out=out", "--exclude", "drag"])[0] == [laps, car]
    assert paths(["train", "laps.parquet", "--vehicle", "orca", "--model", "rls", "--out", "rls"]) == ([laps], [rls])
    assert paths(["race", "--vehicle", "orca", "--track", "oval", "--model", "rls"])[0] == [rls]


def test_an_argument_that_no_file_can_note_is_refused(dynssm: Run) -> None:
    status, _, err = dynssm("inspect", "caf\udce9.mcap")
    assert (status, err) == (1, "error: argument 'caf\\udce9.mcap': expected UTF-8\n")


@pytest.mark.parametrize("name", [300 * "m", "loop", "file/below", "forbidden"])
@pytest.mark.parametrize("command", sorted(set(INSIDE) - {"simulate", "sweep"}))
def test_a_path_at_which_nothing_can_be_is_told_in_one_line(
    command: str, name: str, dynssm: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("loop").symlink_to("loop")
    Path("file").touch()
    stat = os.stat

    def look(path: Any, *rest: Any, **more: Any) -> os.stat_result:
        if str(path).endswith("forbidden"):
            raise PermissionError(errno.EACCES, "Permission denied", str(path))
        return stat(path, *rest, **more)

    monkeypatch.setattr("os.stat", look)
    status, _, err = dynssm(*(word.replace("R", name) for word in INSIDE[command]), "--out", "out.parquet")
    assert status == 1
    assert err.startswith("error: ")
    assert err.count("\n") == 1
