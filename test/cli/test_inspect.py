"""``dynssm inspect``: the first command that a new user runs."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

from dynssm_ros.signals import messages
from dynssm_ros.signals.bags import write_bag
from dynssm_ros.signals.signal_map import load_signal_map

Run = Callable[..., tuple[int, str, str]]
Refused = Callable[..., str]


def test_a_log_is_shown_and_its_map_can_be_extracted_with(dynssm: Run, laps_bag: Path, tmp_path: Path) -> None:
    out, out_json = tmp_path / "inspection", tmp_path / "found.json"
    status, shown, err = dynssm("inspect", laps_bag, "--vehicle", "orca", "--out", out, "--json", out_json)
    assert (status, err) == (0, "")
    assert "/vehicle/odometry" in shown
    assert (out / "signals.yaml").read_text() in shown
    assert load_signal_map(out / "signals.yaml").commands == "topics"
    page = (out / "report.html").read_text()
    assert page.count("data:image/svg+xml") == 2
    found = json.loads(out_json.read_text())
    assert found["topics"]["/vehicle/odometry"]["count"] > 100
    assert found["missing"] == []
    laps = tmp_path / "laps.parquet"
    status, _, err = dynssm("extract", laps_bag, "--signals", out / "signals.yaml", "--rate", 50, "--out", laps)
    assert (status, err) == (0, "")


def test_a_log_of_poses_alone_is_shown(dynssm: Run, tmp_path: Path) -> None:
    """As of motion capture: the twist is not filled in, so nothing but the path can be drawn."""
    with write_bag(tmp_path / "bag") as bag:
        bag.add_topic(messages.ODOMETRY_TOPIC, messages.ODOMETRY)
        for k in range(300):
            stamp = 1_700_000_000_000_000_000 + 10_000_000 * k
            bag.write(messages.ODOMETRY_TOPIC, stamp, messages.odometry(stamp, (0.1 * k, 0.0, 0.0), (0.0, 0.0, 0.0)))
    status, _, err = dynssm("inspect", tmp_path / "bag", "--out", tmp_path / "inspection")
    assert (status, err) == (0, "")
    assert (tmp_path / "inspection" / "report.html").read_text().count("data:image/svg+xml") == 1


def test_a_table_is_shown_and_extracted_by_the_same_commands(dynssm: Run, refused: Refused, tmp_path: Path) -> None:
    log, out, laps = tmp_path / "log.csv", tmp_path / "inspection", tmp_path / "laps.parquet"
    cells = (f"{20 * k},{18 + k % 9},0.0{k % 7},1{k % 5},{k % 3},4{k % 9}\n" for k in range(300))
    log.write_text("t (ms),speed (km/h),v_y,yaw rate (deg/s),steering (deg),throttle (%)\n" + "".join(cells))
    status, shown, err = dynssm("inspect", log, "--out", out, "--json", tmp_path / "found.json")
    assert (status, err) == (0, "")
    assert "note: text, columns apart by comma, 1 line above the first row; time in ms from column 't (ms)'" in shown
    assert "v_x: {column: speed (km/h), unit: km/h}" in shown
    assert "column" in (out / "report.html").read_text()
    assert json.loads((tmp_path / "found.json").read_text())["topics"]["throttle (%)"]["unit"] == "%"
    status, shown, err = dynssm("extract", log, "--signals", out / "signals.yaml", "--rate", 50, "--out", laps)
    assert (status, err) == (0, "")
    assert "commands: none" in shown
    assert "names topics; expected one with columns" in refused(
        "extract", log, "--signals", "default", "--rate", 50, "--out", laps
    )


def test_what_is_no_bag_ends_in_one_line(refused: Refused, tmp_path: Path) -> None:
    line = refused("inspect", tmp_path / "nothing")
    assert "no such file" in line
