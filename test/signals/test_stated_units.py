"""Units that headings name count, or the log is refused, or it is told: none is passed over."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dynssm_ros.errors import BagError
from dynssm_ros.signals.extraction import extract
from dynssm_ros.signals.inspection import inspect
from dynssm_ros.signals.recording import Recording
from dynssm_ros.signals.signal_map import SignalMap, load_signal_map

SIGNALS = {
    "v_x": "v_x", "v_y": "v_y", "omega": "omega", "throttle_feedback": "throttle", "steering_feedback": "steering",
}  # fmt: skip


def extracted(folder: Path, signal: str, heading: str, factor: float, **said: Any) -> Recording:
    """A drive whose column of ``signal`` has another heading and is multiplied by ``factor``; ``said``: in the map."""
    time = np.arange(400) / 50
    turns, surges = np.sin(time / 2), np.cos(time)
    columns = {
        "v_x": 3 + np.sin(time), "v_y": 0.1 * turns, "omega": 0.5 * turns, "throttle": 0.3 + 0.1 * surges,
        "steering": 0.05 * turns,
    }  # fmt: skip
    column = SIGNALS[signal]
    columns[column] = factor * columns[column]
    headings = ["t", *(heading if name == column else name for name in columns)]
    rows = np.column_stack([time, *columns.values()])
    np.savetxt(folder / "log.csv", rows, delimiter=",", header=",".join(headings), comments="")
    sources: dict[str, Any] = {name: {"column": one} for name, one in SIGNALS.items()}
    sources[signal] = {"column": heading, **said}
    return extract([folder / "log.csv"], SignalMap.model_validate({"name": "own", "signals": sources}), 50.0)


FOREIGN = [
    ("v_x", "v [km/h]", "km/h", 3.6), ("v_x", "v_kmh", "km/h", 3.6), ("v_y", "vy (ft/s)", "ft/s", 1 / 0.3048),
    ("omega", "gyro [°/s]", "deg/s", 57.29578), ("steering_feedback", "steering_deg", "deg", 57.29578),
    ("throttle_feedback", "tps [%]", "%", 100.0),
]  # fmt: skip


@pytest.mark.parametrize(("signal", "heading", "unit", "factor"), FOREIGN)
def test_a_unit_that_the_map_passes_over_is_refused_and_one_that_it_says_counts(
    tmp_path: Path, signal: str, heading: str, unit: str, factor: float
) -> None:
    with pytest.raises(BagError, match=rf"for {signal} is in {unit} by its name.*expected `unit: '{unit}'`, or"):
        extracted(tmp_path, signal, heading, factor)
    right = extracted(tmp_path, signal, heading, factor, unit=unit)
    assert right.info.notes == ()
    scaled = extracted(tmp_path, signal, heading, factor, scale=1 / factor)
    assert scaled.info.notes == ()
    name = {"throttle_feedback": "r_fb", "steering_feedback": "delta_fb"}.get(signal, signal)
    np.testing.assert_allclose(right[name], scaled[name], rtol=1e-4)


def test_a_heading_that_the_map_says_to_be_wrong_is_told(tmp_path: Path) -> None:
    found = extracted(tmp_path, "v_x", "v [km/h]", 1.0, unit="m/s")
    assert found.info.notes == ("column 'v [km/h]' for v_x: its name says km/h, the map m/s, which counts",)
    assert found["v_x"].max() == pytest.approx(4.0, abs=0.01)


@pytest.mark.parametrize(
    ("signal", "heading", "told"),
    [
        ("v_x", "v [dm/s]", "dm/s, and it is read in m/s"),
        ("omega", "yaw (mrad/s)", "mrad/s, and it is read in rad/s"),
        ("omega", "heading [deg]", "deg, and it is read in rad/s"),
        ("throttle_feedback", "plate [deg]", "deg, and it is read in shares of 1"),
    ],
)
def test_a_unit_that_is_none_of_the_signal_is_told(tmp_path: Path, signal: str, heading: str, told: str) -> None:
    (note,) = extracted(tmp_path, signal, heading, 1.0).info.notes
    assert note == f"column '{heading}' for {signal}: its name says {told}; else give its scale"
    assert extracted(tmp_path, signal, heading, 1.0, scale=1.0).info.notes == ()


@pytest.mark.parametrize("heading", ["v [m/s]", "v_mps", "v (GPS)", "v [FL]", "v_m", "v_s", "v[0]", "speed_ref"])
def test_what_is_no_unit_or_the_right_one_is_nothing_to_tell(tmp_path: Path, heading: str) -> None:
    assert extracted(tmp_path, "v_x", heading, 1.0).info.notes == ()


def test_a_suggested_map_says_which_unit_it_does_not_know(tmp_path: Path) -> None:
    extracted(tmp_path, "v_x", "v_x [dm/s]", 10.0)
    text = inspect(tmp_path / "log.csv").signal_map()
    assert "in dm/s by its name: scale it to m/s" in text


@pytest.mark.parametrize(("topic", "factor", "unit"), [("steering_deg", 57.29578, "deg"), ("steering_pct", 1.0, "")])
def test_a_topic_states_the_unit_of_its_data(
    make_bag: Any, drive: Any, typestore: Any, topic: str, factor: float, unit: str
) -> None:
    number, records = typestore.types["std_msgs/msg/Float64"], drive()
    steers = [
        (f"/{topic}", "std_msgs/msg/Float64", stamp, number(factor * 0.01 * (stamp - records[0][2]) / 1e9))
        for _, msgtype, stamp, _ in records
        if msgtype == "nav_msgs/msg/Odometry"
    ]
    bag = make_bag([*records, *steers])

    def extracted_with(**said: Any) -> Recording:
        content = load_signal_map("default").with_commands("none").model_dump(exclude_unset=True)
        source = {"topic": topic, "type": "std_msgs/msg/Float64", "field": "data", **said}
        content["signals"] |= {"steering_feedback": source}
        return extract([bag], SignalMap.model_validate(content), 50.0)

    if not unit:
        (note,) = (one for one in extracted_with().info.notes if "by its name" in one or "its name says" in one)
        assert (
            note
            == "/steering_pct data for steering_feedback: its name says pct, and it is read in rad; else give its scale"
        )
        return
    with pytest.raises(BagError, match=rf"/{topic} data for steering_feedback is in {unit} by its name"):
        extracted_with()
    found = extracted_with(unit=unit)
    assert found["delta_fb"].max() == pytest.approx(0.02, abs=2e-3)
