"""``dynssm extract``: a recording and a line about it, or one line of what is wrong and nothing written."""

from __future__ import annotations

import os
import random
import subprocess
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from dynssm_ros.signals import messages
from dynssm_ros.signals.bags import write_bag
from dynssm_ros.signals.recording import Recording

START = 1_700_000_000_000_000_000
SECOND = 1_000_000_000
REPOSITORY = Path(__file__).resolve().parent.parent.parent


def write(path: Path, n: int = 100, spoil: Callable[[int], dict[str, float]] = lambda k: {}) -> Path:
    """A drive at 50 Hz on the default topics; ``spoil`` changes stamp or v_x of the odometry message ``k``."""
    with write_bag(path) as bag:
        bag.add_topic(messages.ODOMETRY_TOPIC, messages.ODOMETRY)
        for topic in (messages.FEEDBACK_TOPIC, messages.COMMAND_TOPIC):
            bag.add_topic(topic, messages.JOINT_STATE)
        for k in range(n):
            stamp = START + k * SECOND // 50
            joints = {"throttle": 0.1, "steering": 0.02}
            for topic in (messages.FEEDBACK_TOPIC, messages.COMMAND_TOPIC):
                bag.write(topic, stamp, messages.joint_state(stamp, joints))
            spoilt = {"stamp": stamp, "v_x": 10 + k / 50} | spoil(k)
            odometry = messages.odometry(int(spoilt["stamp"]), (0.0, 0.0, 0.0), (spoilt["v_x"], 0.0, 0.0))
            bag.write(messages.ODOMETRY_TOPIC, stamp, odometry)
    return path


Run = Callable[..., tuple[int, str, str]]


@pytest.fixture
def run(dynssm: Run) -> Run:
    """Runs ``dynssm extract`` with the given arguments; gives exit status, stdout and stderr."""
    return partial(dynssm, "extract")


def assert_refused(ended: tuple[int, str, str], folder: Path, *said: str) -> None:
    """Exit status 1, one line on stderr, and no output nor anything beside it."""
    status, out, err = ended
    assert (status, out) == (1, "")
    assert err.startswith("error: ")
    assert err.endswith("\n")
    assert err.count("\n") == 1
    for part in said:
        assert part in err
    assert not folder.exists() or list(folder.iterdir()) == []


def test_a_bag_becomes_a_recording(tmp_path: Path, run: Run) -> None:
    out = tmp_path / "new" / "r.parquet"
    status, text, err = run(write(tmp_path / "bag"), "--signals", "default", "--rate", 25, "--out", out)
    assert (status, err) == (0, "")
    assert text == f"{out}: 50 rows at 25 Hz, 2.0 s in 1 segment, commands: topics\n"
    recording = Recording.load(out)
    np.testing.assert_allclose(recording["v_x"], 10 + 0.04 * np.arange(50), atol=1e-9)
    assert [p.name for p in out.parent.iterdir()] == ["r.parquet"]


def test_the_grid_can_also_be_had_as_a_bag(tmp_path: Path, run: Run) -> None:
    first, grid, again = tmp_path / "r.parquet", tmp_path / "grid", tmp_path / "again.parquet"
    assert run(write(tmp_path / "bag"), "--signals", "default", "--rate", 25, "--out", first, "--bag", grid)[0] == 0
    assert run(grid, "--signals", "default", "--rate", 25, "--out", again)[0] == 0
    np.testing.assert_allclose(Recording.load(again).matrix, Recording.load(first).matrix, atol=1e-12)


def test_a_bag_that_would_replace_something_else_is_refused_and_no_recording_written(tmp_path: Path, run: Run) -> None:
    (tmp_path / "thesis").mkdir()
    out = tmp_path / "out" / "r.parquet"
    arguments = ("--signals", "default", "--rate", 25, "--out", out, "--bag", tmp_path / "thesis")
    assert_refused(
        run(write(tmp_path / "bag"), *arguments), out.parent, "thesis: exists and is not a bag that dynssm wrote"
    )


def test_several_bags_make_one_recording(tmp_path: Path, run: Run) -> None:
    bags = write(tmp_path / "a", 50), write(tmp_path / "b", 50)
    status, text, _ = run(*bags, "--signals", "default", "--rate", 50, "--out", tmp_path / "r.parquet")
    assert status == 0
    assert "100 rows at 50 Hz, 2.0 s in 2 segments" in text


@pytest.mark.parametrize("commands", ["lookahead", "none", "topics"])
def test_the_source_of_commands_can_be_chosen(tmp_path: Path, run: Run, commands: str) -> None:
    out = tmp_path / "r.parquet"
    bag = write(tmp_path / "bag", 20)
    assert run(bag, "--signals", "default", "--rate", 50, "--out", out, "--commands", commands)[0] == 0
    assert Recording.load(out).info.commands == commands


def test_names_with_brackets_are_printed_as_they_are(tmp_path: Path, run: Run) -> None:
    out = tmp_path / "[bold]" / "r[1].parquet"
    status, text, _ = run(write(tmp_path / "bag", 20), "--signals", "default", "--rate", 50, "--out", out)
    assert (status, text.startswith(f"{out}: 20 rows")) == (0, True)


def test_what_was_recovered_is_noted(tmp_path: Path, run: Run) -> None:
    bag = write(tmp_path / "bag")
    file = bag / "bag.mcap"
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    status, text, err = run(bag, "--signals", "default", "--rate", 25, "--out", tmp_path / "r.parquet")
    assert (status, err) == (0, "")
    assert "note: bag.mcap is cut off (" in text
    assert "messages up to the cut\n" in text


def test_an_older_recording_is_kept_when_extraction_fails(tmp_path: Path, run: Run) -> None:
    out = tmp_path / "out" / "r.parquet"
    arguments = ("--signals", "default", "--rate", 25, "--out", out)
    assert run(write(tmp_path / "bag"), *arguments)[0] == 0
    before = out.read_bytes()
    status, _, err = run(tmp_path / "missing", *arguments)
    assert (status, err) == (1, f"error: {tmp_path}/missing: no such file\n")
    assert out.read_bytes() == before
    assert [p.name for p in out.parent.iterdir()] == ["r.parquet"]


def bad_bags(folder: Path) -> dict[str, tuple[Path, str]]:
    """For each kind of damage a bag, and what must be said of it."""
    noise = random.Random(2).randbytes(3000)
    (folder / "empty folder").mkdir()
    (folder / "noise.mcap").write_bytes(noise)
    (folder / "noise.db3").write_bytes(noise)
    (folder / "text.txt").write_text("hello")
    cut = write(folder / "cut early")
    (cut / "cut early.mcap").write_bytes((cut / "cut early.mcap").read_bytes()[:200])
    with write_bag(folder / "empty"):
        pass
    return {
        "missing": (folder / "nowhere", "no such file"),
        "empty folder": (
            folder / "empty folder",
            "not a bag; expected a rosbag2 folder, a .mcap or .db3 file, or a ROS 1 bag",
        ),
        "noise in mcap": (folder / "noise.mcap", "not a bag, or cut off before its first message"),
        "noise in db3": (folder / "noise.db3", "not a bag, or cut off before its first message"),
        "text": (folder / "text.txt", "neither a table nor a bag; expected columns of numbers"),
        "empty": (folder / "empty", "is missing; the bag has no topics"),
        "cut early": (cut, "not a bag, or cut off before its first message"),
        "nan": (write(folder / "nan", spoil=lambda k: {"v_x": np.nan} if k == 7 else {}), "is not finite (1 such)"),
        "inf": (write(folder / "inf", spoil=lambda k: {"v_x": -np.inf} if k == 7 else {}), "value -inf, is not finite"),
        "repeated": (write(folder / "repeated", spoil=lambda k: {"stamp": START}), "repeated stamp (99 such)"),
        "backwards": (
            write(folder / "backwards", spoil=lambda k: {"stamp": START - SECOND} if k == 9 else {}),
            "is with a stamp that runs backwards (1 such)",
        ),
        "apart": (
            write(folder / "apart", spoil=lambda k: {"stamp": START + (60 + k) * SECOND}),
            "no instant is covered by all signals",
        ),
    }


def test_every_kind_of_bad_bag_ends_with_one_line_and_no_output(tmp_path: Path, run: Run) -> None:
    for kind, (bag, said) in bad_bags(tmp_path).items():
        out = tmp_path / f"out of {kind}" / "r.parquet"
        ended = run(bag, "--signals", "default", "--rate", 25, "--out", out)
        assert_refused(ended, out.parent, said, bag.name)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (("vehicle/odometry", "odom"), "topic /odom is missing; the bag has /vehicle/actuator_command"),
        (("nav_msgs/msg/Odometry", "nav_msgs/msg/Path"), "the signal map expects nav_msgs/msg/Path"),
        (("linear.x", "linear.speed"), "has no field 'twist.twist.linear.speed' for signal v_x"),
        (("position[throttle]", "position[gas]"), "never carries 'position[gas]', needed for throttle"),
        (("v_x:", "v_z:"), "unknown 'v_z'"),
        (("max_gap: 0.25", "max_gap: -1"), "max_gap: Input should be greater than 0 (got -1)"),
        (("signals:", "- signals"), "not valid YAML"),
    ],
)
def test_a_wrong_signal_map_ends_with_one_line_and_no_output(
    tmp_path: Path, run: Run, change: tuple[str, str], said: str
) -> None:
    text = (REPOSITORY / "config" / "signals" / "default.yaml").read_text(encoding="utf-8")
    signals = tmp_path / "map.yaml"
    signals.write_text(text.replace(*change), encoding="utf-8")
    out = tmp_path / "out" / "r.parquet"
    ended = run(write(tmp_path / "bag", 10), "--signals", signals, "--rate", 25, "--out", out)
    assert_refused(ended, out.parent, said)


def test_an_unknown_signal_map_lists_the_shipped_ones(tmp_path: Path, run: Run) -> None:
    out = tmp_path / "out" / "r.parquet"
    ended = run(write(tmp_path / "bag", 10), "--signals", "porsche", "--rate", 25, "--out", out)
    assert_refused(
        ended,
        out.parent,
        "'porsche' is neither a file nor a shipped name (autoware, av21, default, default_speed,",
    )


def test_commands_that_the_map_does_not_have_are_refused(tmp_path: Path, run: Run) -> None:
    out = tmp_path / "out" / "r.parquet"
    ended = run(tmp_path / "bag", "--signals", "av21", "--rate", 25, "--out", out, "--commands", "topics")
    assert_refused(ended, out.parent, "missing throttle_command, steering_command")


def test_an_output_that_cannot_be_written_is_told(tmp_path: Path, run: Run) -> None:
    (tmp_path / "file").write_text("precious")
    out = tmp_path / "file" / "r.parquet"
    status, _, err = run(write(tmp_path / "bag", 10), "--signals", "default", "--rate", 25, "--out", out)
    assert (status, err.count("\n")) == (1, 1)
    assert err.startswith(f"error: {out}: cannot be written")
    assert (tmp_path / "file").read_text() == "precious"


@pytest.mark.parametrize("kind", ["nan", "repeated", "backwards"])
def test_bad_samples_can_be_left_out(tmp_path: Path, run: Run, kind: str) -> None:
    spoilt = {"nan": {"v_x": np.nan}, "repeated": {"stamp": START}, "backwards": {"stamp": START - SECOND}}[kind]
    bag = write(tmp_path / "bag", spoil=lambda k: spoilt if k == 50 else {})
    status, text, _ = run(bag, "--signals", "default", "--rate", 25, "--out", tmp_path / "r.parquet", "--drop-bad")
    assert status == 0
    assert text.startswith("note: v_x: dropped 1 samples")
    np.testing.assert_allclose(Recording.load(tmp_path / "r.parquet")["v_x"], 10 + 0.04 * np.arange(50), atol=1e-9)


def test_as_its_own_process_the_error_is_one_line_too(tmp_path: Path) -> None:
    command = [sys.executable, "-c", "from dynssm_ros.cli.main import main; main()", "extract", str(tmp_path / "none")]
    ended = subprocess.run(
        [*command, "--signals", "default", "--rate", "25", "--out", str(tmp_path / "r.parquet")],
        capture_output=True,
        text=True,
        check=False,
        env=os.environ | {"PYTHONPATH": str(REPOSITORY)},
    )
    assert (ended.returncode, ended.stdout) == (1, "")
    assert ended.stderr == f"error: {tmp_path}/none: no such file\n"
    assert list(tmp_path.iterdir()) == []
