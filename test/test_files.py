"""Outputs: the old one or the new one, and nothing beside it."""

from __future__ import annotations

import errno
import json
import os
import resource
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path

import pytest

from dynssm_ros.errors import UserError
from dynssm_ros.files import protecting, replacing, write_json


def folder_of(path: Path, text: str) -> None:
    path.mkdir()
    (path / "content").write_text(text)


def text_of(path: Path) -> str:
    return (path / "content" if path.is_dir() else path).read_text()


@pytest.fixture(params=["file", "folder"])
def make(request: pytest.FixtureRequest) -> Callable[[Path, str], object]:
    return folder_of if request.param == "folder" else Path.write_text


def test_a_new_output_takes_its_place_and_leaves_nothing_beside(
    tmp_path: Path, make: Callable[[Path, str], object]
) -> None:
    target = tmp_path / "deep" / "out"
    for text in ("first", "second"):
        with replacing(target) as aside:
            make(aside, text)
            assert aside.name == "out"
        assert text_of(target) == text
        assert [p.name for p in target.parent.iterdir()] == ["out"]


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt, SystemExit])
def test_a_failure_leaves_the_older_output(
    tmp_path: Path, make: Callable[[Path, str], object], error: type[BaseException]
) -> None:
    target = tmp_path / "out"
    make(target, "old")

    def fail() -> None:
        with replacing(target) as aside:
            make(aside, "new")
            raise error

    with pytest.raises(error):
        fail()
    assert text_of(target) == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


def test_a_folder_that_cannot_be_put_in_place_leaves_the_older_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    target = tmp_path / "out"
    folder_of(target, "old")

    def fail(*_: object) -> None:
        raise OSError(5, "Input/output error")

    def run() -> None:
        with replacing(target) as aside:
            folder_of(aside, "new")
            monkeypatch.setattr("dynssm_ros.files._exchange", lambda *_: False)  # as on a file system that cannot
            monkeypatch.setattr("os.replace", fail)

    with pytest.raises(UserError, match=r"out: cannot be written .Input/output error"):
        run()
    assert text_of(target) == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


def test_a_place_that_cannot_be_written_is_told(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    with (
        pytest.raises(UserError, match=r"file/out: cannot be written \(File exists: .*file\)"),
        replacing(tmp_path / "file" / "out"),
    ):
        pass
    folder_of(tmp_path / "folder", "x")

    def file_onto_folder() -> None:
        with replacing(tmp_path / "folder") as aside:
            aside.write_text("x")

    with pytest.raises(UserError, match=r"folder: cannot be written .Is a directory"):
        file_onto_folder()
    assert text_of(tmp_path / "folder") == "x"


def test_json_is_written_whole_or_not_at_all(tmp_path: Path) -> None:
    write_json(tmp_path / "a.json", {"rmse": {"v_x": 0.1}, "coverage_90": None})
    assert json.loads((tmp_path / "a.json").read_text()) == {"rmse": {"v_x": 0.1}, "coverage_90": None}
    with pytest.raises(ValueError, match="not JSON compliant"):
        write_json(tmp_path / "a.json", {"rmse": float("nan")})
    assert json.loads((tmp_path / "a.json").read_text())["rmse"] == {"v_x": 0.1}
    assert [p.name for p in tmp_path.iterdir()] == ["a.json"]


def test_an_input_is_never_replaced_by_whatever_name(tmp_path: Path) -> None:
    log = tmp_path / "laps" / "log.json"
    log.parent.mkdir()
    log.write_text("precious")
    (tmp_path / "link").symlink_to(log)
    os.link(log, tmp_path / "hard")
    with protecting([log], force=True):
        for name in (log, tmp_path / "link", tmp_path / "hard", log.parent):
            with pytest.raises(UserError, match=r"reads log\.json there; an output never replaces an input"):
                write_json(name, {})
        write_json(tmp_path / "other.json", {})
    assert log.read_text() == "precious"
    write_json(log, {})
    assert log.read_text() == "{}\n"


def test_a_log_and_a_device_are_not_replaced(tmp_path: Path) -> None:
    log = tmp_path / "race.mcap"
    log.write_text("precious")
    with pytest.raises(UserError, match=r"race\.mcap: exists and looks like a log; not replaced"):
        write_json(log, {})
    with protecting([], force=True):
        write_json(log, {})
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    with (
        protecting([], force=True),
        pytest.raises(UserError, match="pipe: is neither a file nor a folder; not replaced"),
    ):
        write_json(pipe, {})
    with pytest.raises(UserError, match="is neither a file nor a folder"):
        write_json("/dev/null", {})


def test_a_folder_that_holds_something_else_is_not_replaced(tmp_path: Path) -> None:
    folder = tmp_path / "model"
    folder_of(folder, "old")
    (folder / "notes.txt").write_text("mine")
    with pytest.raises(UserError, match=r"model: holds notes\.txt, which we did not write"), replacing(folder) as aside:
        folder_of(aside, "new")
    assert (folder / "notes.txt").read_text() == "mine"
    with replacing(folder, may_hold=("notes.txt",)) as aside:
        folder_of(aside, "new")
    assert text_of(folder) == "new"


def test_a_folder_is_there_at_every_instant_while_it_is_replaced(tmp_path: Path) -> None:
    target = tmp_path / "model"
    folder_of(target, "0")
    done, seen, missing = threading.Event(), set(), []

    def look() -> None:
        try:
            while not done.is_set():
                seen.add(text_of(target))
        except OSError as error:
            missing.append(error)

    reader = threading.Thread(target=look)
    reader.start()
    for number in range(200):
        with replacing(target) as aside:
            folder_of(aside, str(number))
    done.set()
    reader.join()
    assert missing == []
    assert len(seen) > 1
    assert [p.name for p in tmp_path.iterdir()] == ["model"]


def test_files_can_be_read_by_others_whoever_wrote_them(tmp_path: Path) -> None:
    with replacing(tmp_path / "model") as aside:
        folder_of(aside, "weights")
        (aside / "content").chmod(0o600)
    usual = tmp_path / "usual"
    usual.touch()
    assert (tmp_path / "model" / "content").stat().st_mode == usual.stat().st_mode


def test_what_a_killed_run_left_is_cleared_away(tmp_path: Path) -> None:
    code = (
        "import os, signal, sys\n"
        "from dynssm_ros.files import replacing\n"
        "with replacing(sys.argv[1]) as aside:\n"
        "    aside.write_text('half')\n"
        "    os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    target = tmp_path / "laps.json"
    killed = subprocess.run([sys.executable, "-c", code, str(target)], check=False)
    assert killed.returncode == -signal.SIGKILL
    (left,) = tmp_path.iterdir()
    assert left.name.startswith(".laps.json.")
    write_json(target, {})
    assert [p.name for p in tmp_path.iterdir()] == ["laps.json"]


def test_the_scratch_of_a_run_that_lives_is_left_alone(tmp_path: Path) -> None:
    target = tmp_path / "laps.json"
    with replacing(target) as aside:
        aside.write_text("slow")
        write_json(target, {})
        assert aside.read_text() == "slow"
    assert target.read_text() == "slow"


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT, errno.EFBIG])
def test_a_full_disk_is_named_and_leaves_what_was_there(
    make: Callable[[Path, str], object], tmp_path: Path, number: int
):
    target = tmp_path / "out"
    make(target, "old")

    def write() -> None:
        with replacing(target):
            raise OSError(number, "no room")

    with pytest.raises(UserError, match=rf"out: cannot be written \({os.strerror(number)}\)"):
        write()
    assert text_of(target) == "old"
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_a_full_disk_is_named_whatever_a_library_raises(tmp_path: Path) -> None:
    def write(error: type[Exception]) -> None:
        with replacing(tmp_path / "out") as aside:
            aside.write_bytes(b"half")
            raise error

    with pytest.raises(RuntimeError):
        write(RuntimeError)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, limits[1]))  # which stands for a full disk
    try:
        with pytest.raises(UserError, match=r"out: cannot be written \(File too large\)"):
            write(RuntimeError)
        with pytest.raises(UserError, match=r"^$"):
            write(UserError)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("out", ["bag", "laps.parquet"])
def test_a_command_that_runs_out_of_room_ends_in_one_line(laps_bag: Path, tmp_path: Path, out: str) -> None:
    """A limit on the size of files stands for a full disk: the same calls of the system fail."""
    commands = {
        "bag": ["simulate", "--vehicle", "orca", "--track", "club", "--duration", "20"],
        "laps.parquet": ["extract", str(laps_bag), "--signals", "default", "--rate", "50"],
    }
    run = [sys.executable, "-m", "dynssm_ros.cli.main", *commands[out], "--out", str(tmp_path / out)]
    ended = subprocess.run(
        ["bash", "-c", 'ulimit -f 16; exec "$@"', "bash", *run],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert ended.returncode == 1
    assert ended.stderr.splitlines()[-1] == f"error: {tmp_path / out}: cannot be written (File too large)"
    assert "Traceback" not in ended.stderr
    assert not list(tmp_path.iterdir())
