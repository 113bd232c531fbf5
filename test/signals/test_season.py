"""Seasons: logs to a data set, again after a change, and the sessions of its folders."""

from __future__ import annotations

import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import get_args

import numpy as np
import pyarrow.dataset as ds
import pytest
from dask import config
from distributed import LocalCluster

from dynssm_ros.errors import ConfigurationError, RecordingError, UserError
from dynssm_ros.parallel import Backend, Workers
from dynssm_ros.signals.extraction import extract
from dynssm_ros.signals.recording import Recording
from dynssm_ros.signals.season import MANIFEST, Season, is_season, recording_files, season_part
from dynssm_ros.signals.season_extraction import Log, extract_season, logs_of
from dynssm_ros.signals.signal_map import load_signal_map
from dynssm_ros.simulation.laps import simulate, write_run
from dynssm_ros.track.tracks import load_track
from dynssm_ros.vehicle import load_vehicle

MAP = load_signal_map("default")


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four short bags of one car on one track, of which the last is cut."""
    folder = tmp_path_factory.mktemp("bags")
    for k in range(3):
        run = simulate(load_vehicle("orca"), load_track("club"), duration=3.0 + k, seed=k)
        write_run(run, folder / f"run_{k}")
    shutil.copytree(folder / "run_0", folder / "broken")
    for file in (folder / "broken").glob("*.mcap"):
        file.write_bytes(file.read_bytes()[:100])
    return folder


@pytest.fixture
def bags(made: Path, tmp_path: Path) -> list[Path]:
    """The same, to be changed."""
    shutil.copytree(made, tmp_path / "bags")
    return [tmp_path / "bags" / name for name in ("run_0", "run_1", "broken", "run_2")]


def logs(bags: list[Path], track: str = "club") -> list[Log]:
    return logs_of(bags, "orca", track, MAP, rate=50.0, drop_bad=False)


def stamps(season: Season) -> dict[str, int]:
    """When each recording was written."""
    return {each.session: season.file(each.place).stat().st_mtime_ns for each in season.chosen()}


def test_each_bag_is_a_recording_and_a_broken_one_is_listed_with_its_reason(bags: list[Path], tmp_path: Path) -> None:
    season, new = extract_season(logs(bags), tmp_path / "season")
    assert {session.session for session in new} == {"run_0", "run_1", "run_2", "broken"}
    assert [session.session for session in season.chosen()] == ["run_0", "run_1", "run_2"]
    assert "broken" in season.sessions["orca", "club", "broken"].failure
    for bag in (bags[0], bags[3]):
        session = season.sessions["orca", "club", bag.name]
        alone = extract([bag], MAP, 50.0)
        there = Recording.load(season.file(session.place))
        np.testing.assert_array_equal(there.matrix, alone.matrix)
        assert (session.rows, session.segments, session.notes) == (len(alone), 1, alone.info.notes)
        assert session.seconds == pytest.approx(alone.duration)
    assert Season.load(tmp_path / "season").sessions == season.sessions


def test_an_unchanged_season_is_not_read_again_and_a_changed_bag_alone_is(bags: list[Path], tmp_path: Path) -> None:
    season, _ = extract_season(logs(bags), tmp_path / "season")
    before = stamps(season)
    again, new = extract_season(logs(bags), tmp_path / "season")
    assert (new, stamps(again)) == ([], before)
    for file in bags[0].iterdir():  # written anew with the same content
        file.write_bytes(file.read_bytes())
    assert extract_season(logs(bags), tmp_path / "season")[1] == []
    shutil.rmtree(bags[1])
    shutil.copytree(bags[3], bags[1])
    changed, new = extract_season(logs(bags), tmp_path / "season")
    assert [session.session for session in new] == ["run_1"]
    assert changed.sessions["orca", "club", "run_1"].rows == changed.sessions["orca", "club", "run_2"].rows
    assert {name for name, stamp in stamps(changed).items() if stamp != before[name]} == {"run_1"}


def test_other_settings_and_a_lost_recording_are_reasons_to_extract_again(bags: list[Path], tmp_path: Path) -> None:
    season, _ = extract_season(logs(bags[:2]), tmp_path / "season")
    season.file(("orca", "club", "run_0")).unlink()
    _, new = extract_season(logs(bags[:2]), tmp_path / "season")
    assert [session.session for session in new] == ["run_0"]
    finer = [replace(log, rate=100.0) for log in logs(bags[:2])]
    _, new = extract_season(finer, tmp_path / "season")
    assert {session.rate for session in new} == {100.0}


def test_a_bag_that_breaks_takes_its_recording_along(bags: list[Path], tmp_path: Path) -> None:
    """What is there must be of the log that the manifest names."""
    season, _ = extract_season(logs(bags[:2]), tmp_path / "season")
    (file,) = bags[0].glob("*.mcap")
    file.write_bytes(file.read_bytes()[:100])
    season, _ = extract_season(logs(bags[:2]), tmp_path / "season")
    assert [session.session for session in season.chosen()] == ["run_1"]
    assert not season.file(("orca", "club", "run_0")).exists()


def test_what_is_done_stays_done_after_an_interrupt(bags: list[Path], tmp_path: Path) -> None:
    def interrupt(done: int, total: int, words: str = "") -> None:
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        extract_season(logs(bags), tmp_path / "season", progress=interrupt)
    assert len(Season.load(tmp_path / "season").sessions) == 2
    season, new = extract_season(logs(bags), tmp_path / "season")
    assert (len(new), len(season.sessions)) == (2, 4)


@pytest.mark.parametrize(
    "backend",
    [pytest.param(name, marks=[] if name == "processes" else pytest.mark.slow) for name in get_args(Backend)],
)
def test_several_processes_give_the_same_though_one_is_killed(
    bags: list[Path], tmp_path: Path, backend: Backend
) -> None:
    killed: list[int] = []

    def kill(done: int, total: int, words: str = "") -> None:
        if not killed:
            killed.append(workers_of(backend)[0])
            os.kill(killed[0], signal.SIGKILL)

    one, _ = extract_season(logs(bags), tmp_path / "one")
    two, _ = extract_season(logs(bags), tmp_path / "two", Workers(2, backend), progress=kill)
    assert killed
    assert one.sessions == two.sessions
    for session in one.chosen():
        assert one.file(session.place).read_bytes() == two.file(session.place).read_bytes()


def workers_of(backend: Backend) -> list[int]:
    """Processes that this one and those below it have begun for joblib."""
    below, found = [str(os.getpid())], []
    while below:
        for task in Path("/proc", below.pop(), "task").glob("*/children"):
            for process in task.read_text().split():
                below.append(process)
                command = Path("/proc", process, "cmdline").read_text()
                if {"processes": "popen_loky", "ray": "ray::Pool", "dask": "spawn_main"}[backend] in command:
                    found.append(int(process))
    return found


@pytest.fixture(params=["ray", "dask"])
def cluster(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Workers]:
    """A cluster of two workers that runs on its own."""
    if request.param == "dask":
        with (
            config.set({"temporary-directory": str(tmp_path)}),
            LocalCluster(n_workers=2, dashboard_address=None) as local,
        ):
            yield Workers(None, "dask", local.scheduler_address)
        return
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    begin = ("start", "--head", f"--port={port}", "--num-cpus=2", "--include-dashboard=false", "--disable-usage-stats")
    with tempfile.TemporaryDirectory(dir="/tmp") as scratch:  # short, as the paths of sockets must be
        command = [Path(sys.executable).with_name("ray"), *begin, "--block", f"--temp-dir={scratch}"]
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as head:
            assert head.stdout is not None
            assert any("Ray runtime started" in line for line in head.stdout)
            yield Workers(None, "ray", f"127.0.0.1:{port}")
            head.terminate()


@pytest.mark.slow
def test_a_cluster_gives_the_same(bags: list[Path], tmp_path: Path, cluster: Workers) -> None:
    one, _ = extract_season(logs(bags), tmp_path / "one")
    two, _ = extract_season(logs(bags), tmp_path / "two", cluster)
    assert one.sessions == two.sessions


def test_others_read_it_as_a_partitioned_data_set(bags: list[Path], tmp_path: Path) -> None:
    season, _ = extract_season(logs(bags), tmp_path / "season")
    extract_season(logs(bags[:1], "oval"), tmp_path / "season")
    table = ds.dataset(tmp_path / "season", format="parquet", partitioning="hive")
    rows = table.count_rows(filter=(ds.field("track") == "club") & (ds.field("session") != "run_0"))
    assert rows == sum(season.sessions["orca", "club", name].rows for name in ("run_1", "run_2"))


def test_a_folder_in_a_season_stands_for_its_sessions(bags: list[Path], tmp_path: Path) -> None:
    """So do files, as a shell's ``season/car=*/track=club/*/*.parquet`` gives them."""
    extract_season(logs(bags[1:], "club"), tmp_path / "season")
    season, _ = extract_season(logs(bags[:1], "oval"), tmp_path / "season")
    oval, club = (season.path / "car=orca" / f"track={track}" for track in ("oval", "club"))
    assert [session.session for session in season_part(club)[1]] == ["run_1", "run_2"]
    assert recording_files([oval, *club.glob("*/*.parquet")]) == [*oval.glob("*/*"), *club.glob("*/*")]
    assert recording_files([season.path]) == season.files()
    (season.path / "car=av21").mkdir()
    with pytest.raises(RecordingError, match="none of 3 sessions"):
        recording_files([season.path / "car=av21"])


def test_what_is_no_season_is_not_replaced_and_names_are_unique(bags: list[Path], tmp_path: Path) -> None:
    other = tmp_path / "other"
    other.mkdir()
    (other / "thesis.tex").write_text("years of work")
    with pytest.raises(UserError, match="exists and is not a season"):
        extract_season(logs(bags), other)
    assert not is_season(other)
    (tmp_path / "day").mkdir()
    shutil.copytree(bags[0], tmp_path / "day" / "run_0")
    same = logs_of([bags[0], tmp_path / "day" / "run_0"], "orca", "club", MAP, rate=50.0, drop_bad=False)
    assert [log.session for log in same] == ["bags-run_0", "day-run_0"]
    with pytest.raises(ConfigurationError, match=r"^track 'a/b': expected letters"):
        logs_of(bags, "orca", "a/b", MAP, rate=50.0, drop_bad=False)


def test_another_log_of_the_same_name_takes_nothing_away(bags: list[Path], tmp_path: Path) -> None:
    """It is named after its folder too, also when it comes again; a log that moved is the same one."""
    season, _ = extract_season(logs(bags[:1]), tmp_path / "season")
    before = stamps(season)
    other = tmp_path / "day_2" / "run_0"
    shutil.copytree(bags[3], other)
    for expected in (["day_2-run_0"], []):
        season, new = extract_season(logs([other]), tmp_path / "season")
        assert [session.session for session in new] == expected
    assert stamps(season)["run_0"] == before["run_0"]
    moved = tmp_path / "archive" / "run_0"
    moved.parent.mkdir()
    shutil.move(bags[0], moved)
    season, new = extract_season(logs([moved]), tmp_path / "season")
    assert (new, set(stamps(season))) == ([], {"run_0", "day_2-run_0"})
    third = tmp_path / "other" / "day_2" / "run_0"
    shutil.copytree(bags[1], third)
    with pytest.raises(UserError, match="has a session 'run_0' of another log"):
        extract_season(logs([third]), tmp_path / "season")


def test_a_damaged_manifest_is_named(bags: list[Path], tmp_path: Path) -> None:
    extract_season(logs(bags[:1]), tmp_path / "season")
    (tmp_path / "season" / MANIFEST).write_text("{")
    with pytest.raises(RecordingError, match=MANIFEST):
        Season.load(tmp_path / "season")


@pytest.mark.slow
def test_the_commands_take_a_season(bags: list[Path], tmp_path: Path, told: Callable[..., tuple[int, str]]) -> None:
    season = tmp_path / "season"
    extracting = ("extract", *bags, "--signals", "default", "--rate", 50, "--out", season)
    status, said = told(*extracting)
    assert (status, "--car and --track" in said) == (1, True)
    status, said = told(*extracting, "--car", "orca", "--track", "club")
    assert status == 0
    assert "broken: not extracted:" in said
    assert "4 sessions; of 4 bags 3 extracted, 0 as they were, 1 not readable" in said
    (tmp_path / "day_2").mkdir()
    shutil.copytree(bags[2], tmp_path / "day_2" / "run_0")
    again = ("extract", tmp_path / "day_2" / "run_0", bags[0], *extracting[1 + len(bags) :])
    status, said = told(*again, "--car", "orca", "--track", "club")
    assert status == 0, said
    assert "of 2 bags 0 extracted, 1 as they were, 1 not readable" in said
    status, said = told("inspect", season, "--json", tmp_path / "listed.json")
    assert status == 0
    assert len(json.loads((tmp_path / "listed.json").read_text())["sessions"]) == 5
    evaluating = ("evaluate", "--model", "single_track", "--vehicle", "orca", "--out", tmp_path / "report")
    club = season / "car=orca" / "track=club"
    status, said = told(*evaluating, club / "session=run_1", club / "session=run_2" / "recording.parquet")
    assert status == 0, said
    text = (tmp_path / "report" / "results.md").read_text()
    assert "run_1, run_2" in text
    assert "run_0" not in text
