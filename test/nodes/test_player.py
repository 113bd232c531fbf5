"""The player as its own process."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from nav_msgs.msg import Odometry

from benchmarks.endurance import live_run
from benchmarks.endurance.live_run import (
    PROFILES,
    LiveRun,
    collecting,
    isolated_environment,
    predictor_process,
    run_live,
    wait_for_the_last,
)
from dynssm_ros.nodes.support import SENSOR_QOS
from dynssm_ros.signals.decoding import header_stamp_ns
from dynssm_ros.signals.messages import COMMAND_TOPIC, FEEDBACK_TOPIC, ODOMETRY_TOPIC, PREDICTION_TOPIC

pytestmark = [pytest.mark.live, pytest.mark.timeout(120)]


def _player(*parameters: str) -> list[str]:
    arguments = [part for text in parameters for part in ("-p", text)]
    return [sys.executable, "-m", "dynssm_ros.nodes.player", "--ros-args", *arguments]


@pytest.mark.slow
def test_player_and_predictor_work_as_separate_processes(small_model: Path, laps_bag: Path) -> None:
    os.environ.update(isolated_environment())
    run = LiveRun(20_000_000)
    with predictor_process(small_model, {}, os.environ.copy()), collecting(run) as collector:
        assert collector.wait_for(lambda: collector.count_publishers(PREDICTION_TOPIC) > 0, 30.0)
        player = subprocess.Popen(_player(f"bag:={laps_bag}", "rate:=4.0"), env=os.environ.copy())
        assert player.wait(60) == 0
        last = 1_000_000_000_000_000_000 + 20_000_000_000 + run.T_s
        assert collector.wait_for(lambda: last in run.predicted, 5.0)
        assert collector.count_publishers(PREDICTION_TOPIC) == 1
        told = len(run.diagnostics)
        assert collector.wait_for(lambda: len(run.diagnostics) > told, 5.0)
    assert len(run.predicted) + run.passed_over == 1001 - 4


def test_a_part_of_a_bag_is_played_with_its_clock(laps_bag: Path) -> None:
    """The last second of the odometry alone; /clock has the times at which it was recorded."""
    from rosgraph_msgs.msg import Clock

    os.environ.update(isolated_environment())
    stamps: list[int] = []
    times: list[int] = []
    with collecting(LiveRun(20_000_000)) as collector:
        collector.create_subscription(
            Odometry, ODOMETRY_TOPIC, lambda m: stamps.append(header_stamp_ns(m) or 0), SENSOR_QOS
        )
        collector.create_subscription(
            Clock, "/clock", lambda m: times.append(m.clock.sec * 10**9 + m.clock.nanosec), 10
        )
        given = ("rate:=4.0", "start_offset:=19.0", f"topics:={ODOMETRY_TOPIC}", "clock:=true")
        player = subprocess.Popen(_player(f"bag:={laps_bag}", *given), env=os.environ.copy())
        assert player.wait(60) == 0
        assert collector.wait_for(lambda: len(stamps) == 51, 5.0), len(stamps)
        assert collector.wait_for(lambda: len(times) >= 40, 5.0), len(times)
    assert stamps[0] == 1_000_000_000_000_000_000 + 19 * 10**9
    assert set(times) <= {stamp + 2000 for stamp in stamps}, "odometry is logged 2 us after its stamp"


@pytest.mark.parametrize(
    ("parameters", "expected"),
    [
        ([], "parameter bag: not set"),
        (["bag:=/nowhere"], "/nowhere: no such file"),
    ],
)
def test_a_wrong_start_is_one_clear_line(parameters: list[str], expected: str) -> None:
    command = _player(*parameters) if parameters else [sys.executable, "-m", "dynssm_ros.nodes.player"]
    result = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert result.returncode == 1
    assert result.stderr.strip().splitlines() == [
        line for line in result.stderr.strip().splitlines() if expected in line
    ]


def test_a_bag_of_types_that_are_not_installed_names_the_way_out(putnam: Path) -> None:
    result = subprocess.run(_player(f"bag:={putnam}"), capture_output=True, text=True, timeout=60, check=False)
    assert result.returncode == 1
    assert "raptor_dbw_msgs" in result.stderr
    assert "dynssm extract" in result.stderr


@pytest.mark.slow
def test_a_predictor_that_is_held_up_for_two_seconds_and_listens_reliably_loses_nothing_and_goes_on_with_the_newest(
    small_model: Path, laps_bag: Path
) -> None:
    """With ``config/fastdds.xml``, as in all tests; best effort, such a stop can still cost what waits."""
    assert os.environ[PROFILES].endswith("fastdds.xml")
    topics = (ODOMETRY_TOPIC, FEEDBACK_TOPIC, COMMAND_TOPIC)
    reliable = {f"qos_overrides.{topic}.subscription.reliability": "reliable" for topic in topics}
    run = run_live(small_model, laps_bag, 0.02, rate=4.0, held_up=(6.0, 14.0), parameters=reliable)
    assert len(run.predicted) + len(run.missing()) == 1001 - 4
    refused = {name: int(count) for name, count in run.diagnostics[-1][2].items() if name.startswith("refused: ")}
    assert len(run.predicted) + sum(refused.values()) == 1001, "each is answered, or refused by name"
    assert {name for name, count in refused.items() if count} == {"refused: skipped", "refused: filling"}
    assert refused["refused: filling"] <= 4 + 4, "the first window, and at most one anew as topics are heard again"
    assert run.passed_over > 350, "of 8 s at 50 Hz"
    assert run.predicted.keys() & set(sorted(run.sent)[-100:]), "and it answers again"


def test_a_run_waits_for_a_predictor_that_was_held_up_as_long_as_it_answers() -> None:
    run = LiveRun(10, sent=dict.fromkeys((100, 110, 120, 130, 140), 0.0))

    def wait_for(condition: Callable[[], bool], _timeout: float) -> bool:
        if len(run.predicted) < answers:  # one in each while
            run.predicted[110 + 10 * len(run.predicted)] = (0.0, 0.0, 0.0)
        return condition()

    answers = 3
    wait_for_the_last(run, wait_for)
    assert run.missing() == [130, 140]
    answers = 5
    wait_for_the_last(run, wait_for)
    assert run.missing() == []


def test_a_domain_in_use_is_not_drawn_again() -> None:
    domain = int(isolated_environment()["ROS_DOMAIN_ID"])
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as participant:
        participant.bind(("", 7400 + 250 * domain + 10))
        assert all(int(isolated_environment()["ROS_DOMAIN_ID"]) != domain for _ in range(200))


def test_what_killed_participants_left_in_a_domain_is_removed(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(live_run, "_SHARED_MEMORY", tmp_path)
    left = [
        tmp_path / name.format(7400 + 250 * d + 11)
        for d in range(101)
        for name in ("fastrtps_port{}_el", "sem.fastrtps_port{}")
    ]
    for file in left:
        file.touch()
    domain = int(isolated_environment()["ROS_DOMAIN_ID"])
    assert {file for file in left if not file.exists()} == set(left[2 * domain : 2 * domain + 2])


def test_a_domain_is_reserved_before_anybody_takes_part_in_it() -> None:
    domain = isolated_environment()["ROS_DOMAIN_ID"]
    of_another_process = f"from benchmarks.endurance.live_run import _reserve; print(_reserve({domain}))"
    asked = subprocess.run([sys.executable, "-c", of_another_process], capture_output=True, text=True, check=True)
    assert asked.stdout.strip() == "False"
