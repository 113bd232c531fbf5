"""``dynssm replay``: counts and reasons, and what is refused before anything is lost."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
import yaml

from dynssm_ros.configuration import config_root
from dynssm_ros.signals.bags import open_bag

Run = Callable[..., tuple[int, str, str]]
Refused = Callable[..., str]


def test_it_tells_how_many_predictions_there_are_and_why_not_more(
    dynssm: Run, laps_bag: Path, small_model: Path, tmp_path: Path
) -> None:
    status, out, err = dynssm("replay", laps_bag, "--model", small_model, "--out", tmp_path / "out")
    assert (status, err) == (0, "")
    assert out.strip() == f"{tmp_path / 'out'}: 997 predictions; none for: 4 x the window is filling"
    with open_bag(tmp_path / "out") as bag:
        assert bag.counts == {"/dynssm/prediction": 997, "/dynssm/parameters": 997}


def test_a_cut_bag_is_replayed_up_to_the_cut_and_says_so(
    dynssm: Run, laps_bag: Path, small_model: Path, tmp_path: Path
) -> None:
    (file,) = laps_bag.glob("*.mcap")
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    status, out, _ = dynssm("replay", cut, "--model", small_model, "--out", tmp_path / "out")
    assert status == 0
    note, summary = out.strip().splitlines()
    assert note.startswith("note: cut.mcap is cut off")
    assert 0 < int(summary.split(": ")[1].split()[0]) < 997


@pytest.mark.parametrize("named", ["folder", "file"])
def test_the_bag_itself_is_never_replaced(refused: Refused, laps_bag: Path, small_model: Path, named: str) -> None:
    (file,) = laps_bag.glob("*.mcap")
    before = file.read_bytes()
    bag = laps_bag if named == "folder" else file
    line = refused("replay", bag, "--model", small_model, "--out", laps_bag.parent / "x" / ".." / laps_bag.name)
    assert ("reads club there" if named == "folder" else "is the bag that is replayed") in line
    assert file.read_bytes() == before


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"model": "gone"}, "gone: no such model folder; `dynssm train` writes one"),
        ({"bag": "gone"}, "gone: no such file"),
        ({"bag": "log.csv"}, "log.csv: not a bag; expected a rosbag2 folder"),
        ({"bag": "log.csv"}, "`dynssm extract --bag` makes one of a table"),
        (
            {"signals": "gone"},
            "'gone' is neither a file nor a shipped name (autoware, av21, default, default_speed, ",
        ),
        ({"signals": "av21"}, "missing throttle_command, steering_command"),
        ({"signals": "other.yaml"}, "topic /other/odometry is missing; the bag has /vehicle/actuator_command"),
    ],
)
def test_what_is_not_there_is_one_line_and_leaves_nothing(
    refused: Refused,
    laps_bag: Path,
    small_model: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    changes: dict[str, str],
    words: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    other = yaml.safe_load((config_root() / "signals" / "default.yaml").read_text())
    for source in other["signals"].values():
        source["topic"] = source["topic"].replace("vehicle/odometry", "/other/odometry")
    Path("other.yaml").write_text(yaml.safe_dump(other))
    Path("log.csv").write_text("t,v_x\n0.0,1.0\n0.1,1.1\n")
    given = {"bag": str(laps_bag), "model": str(small_model), "signals": "default"} | changes
    options = ("--model", given["model"], "--signals", given["signals"], "--out", "out")
    line = refused("replay", given["bag"], *options)
    assert words in line
    assert sorted(path.name for path in tmp_path.iterdir()) == ["log.csv", "other.yaml"]


def test_an_age_below_zero_is_refused(refused: Refused, laps_bag: Path, small_model: Path, tmp_path: Path) -> None:
    line = refused("replay", laps_bag, "--model", small_model, "--out", tmp_path / "o", "--max-age", "-1")
    assert "--max-age" in line
