"""Race logs to a recording: the signals as they were, and one clear line for whatever is wrong with them."""

from __future__ import annotations

import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dynssm_ros.errors import BagError, RecordingError
from dynssm_ros.signals import messages
from dynssm_ros.signals.extraction import clean, extract
from dynssm_ros.signals.recording import Recording
from dynssm_ros.signals.resampling import Stream
from dynssm_ros.signals.signal_map import SignalMap, load_signal_map

START = 1_700_000_000_123_456_789
SECOND = 1_000_000_000
DEFAULT = load_signal_map("default")
ODOMETRY, FEEDBACK, COMMAND = messages.ODOMETRY_TOPIC, messages.FEEDBACK_TOPIC, messages.COMMAND_TOPIC


def with_source(signal: str, **source: Any) -> SignalMap:
    content = DEFAULT.model_dump()
    content["signals"][signal] = {"topic": "/team", "type": "a/msg/B", "field": "c"} | source
    return SignalMap.model_validate(content)


def seconds(recording: Recording) -> np.ndarray:
    return (recording.time - START) / SECOND


def changed(records: list[Any], topic: str, index: int, message: Any) -> list[Any]:
    """The records with the message number ``index`` of ``topic`` exchanged; ``None`` leaves it out."""
    where = [k for k, record in enumerate(records) if record[0] == topic][index]
    name, kind, log_time, _ = records[where]
    return records[:where] + ([(name, kind, log_time, message)] if message is not None else []) + records[where + 1 :]


def assert_linear(recording: Recording) -> None:
    t = seconds(recording)
    expected = {
        "v_x": 10 + t,
        "v_y": 0.1 * t,
        "omega": -0.2 * t,
        "r_fb": 0.5,
        "delta_fb": 0.01 * t,
        "r_cmd": 0.05,
        "delta_cmd": 0.002,
    }
    for column, values in expected.items():
        np.testing.assert_allclose(recording[column], values + 0 * t, atol=1e-9)


@pytest.mark.parametrize("form", ["mcap", "sqlite"])
@pytest.mark.parametrize("rate", [25.0, 40.0, 130.0])
def test_the_signals_of_a_bag_come_out_as_they_went_in(make_bag: Any, drive: Any, form: str, rate: float) -> None:
    recording = extract([make_bag(drive(200), form=form)], DEFAULT, rate)
    assert_linear(recording)
    assert len(recording) == int(1.99 * rate) + 1
    assert recording.info.model_dump() == {
        "version": 1,
        "sampling_time": 1 / rate,
        "commands": "topics",
        "source": ("bag",),
        "signal_map": "default",
        "held": (),
        "held_periods": {},
        "stamped": dict.fromkeys(DEFAULT.signals, "header"),
        "interpolated": {},
        "standard_deviations": {},
        "notes": (),
        "findings": (),
        "set_point": "throttle",
    }
    t = seconds(recording)
    np.testing.assert_allclose(recording["x"], 10 * t, atol=1e-6)
    np.testing.assert_allclose(recording["theta"], 0.3, atol=1e-12)


def test_actuators_that_are_slower_than_the_rows_are_held_unless_the_map_says_otherwise(
    make_bag: Any, drive: Any
) -> None:
    """Rows between their samples would else look ahead of what a live node knows."""
    bag = make_bag([record for k, record in enumerate(drive(200)) if record[0] == ODOMETRY or k % 5 == 0])
    signals = DEFAULT.model_dump()["signals"]
    actuators = [name for name in signals if name.startswith(("throttle", "steering"))]
    recording = extract([bag], DEFAULT, 100.0)
    assert recording.info.held == tuple(actuators)
    assert recording.info.held_periods == pytest.approx(dict.fromkeys(actuators, 0.05))
    changes = np.flatnonzero(np.diff(recording["delta_fb"]))
    assert 0 < len(changes) <= len(recording) / 4
    assert set(np.diff(changes)) == {int(np.diff(changes)[0])}
    signals["steering_feedback"]["hold"] = "first"
    line = extract([bag], SignalMap(name="own", signals=signals), 100.0)
    assert line.info.held == tuple(name for name in actuators if name != "steering_feedback")
    np.testing.assert_allclose(line["delta_fb"], 0.01 * seconds(line), atol=1e-9)
    assert extract([bag], DEFAULT, 20.0).info.held == ()


def test_without_command_topics_commands_are_zero_or_look_ahead(make_bag: Any, drive: Any) -> None:
    bag = make_bag([record for record in drive(100) if record[0] != COMMAND])
    assert not extract([bag], DEFAULT.with_commands("none"), 25.0)["delta_cmd"].any()
    ahead = extract([bag], DEFAULT.with_commands("lookahead"), 25.0)
    np.testing.assert_allclose(ahead["delta_cmd"][:-1], np.diff(ahead["delta_fb"]), atol=1e-15)


def test_messages_with_a_header_count_by_its_stamp_and_those_without_by_their_log_time(
    make_bag: Any, drive: Any, typestore: Any
) -> None:
    wheel, pedals = typestore.types["team_msgs/msg/Wheel"], typestore.types["team_msgs/msg/Pedals"]
    records = drive(100)
    for k in range(100):
        t = k / 100
        stamp = START + k * SECOND // 100
        records.append(("/wheel", "team_msgs/msg/Wheel", stamp, wheel(100 * t, "")))
        header = messages.joint_state(stamp, {}).header
        late = stamp + 70_000_000
        records.append(("/pedals", "team_msgs/msg/Pedals", late, pedals(header, 100 * t, np.array([27.0 * t]))))
    content = DEFAULT.model_dump()
    content["signals"]["steering_feedback"] = {
        "topic": "/wheel",
        "type": "team_msgs/msg/Wheel",
        "field": "angle_deg",
        "scale": 0.01,
        "offset": 1.0,
    }
    content["signals"]["throttle_feedback"] = {
        "topic": "/pedals",
        "type": "team_msgs/msg/Pedals",
        "field": "throttle_percent",
        "scale": 0.01,
    }
    recording = extract([make_bag(records)], SignalMap.model_validate(content), 25.0)
    np.testing.assert_allclose(recording["delta_fb"], 1 + seconds(recording), atol=1e-9)
    np.testing.assert_allclose(recording["r_fb"], seconds(recording), atol=1e-6)


def test_a_field_called_header_that_is_none_is_no_stamp(make_bag: Any, drive: Any, typestore: Any) -> None:
    odd = typestore.types["team_msgs/msg/Odd"]
    records = drive(100) + [
        ("/team", "team_msgs/msg/Odd", START + k * SECOND // 100, odd(5.0, k / 100)) for k in range(100)
    ]
    signal_map = with_source("steering_feedback", type="team_msgs/msg/Odd", field="value")
    recording = extract([make_bag(records)], signal_map, 25.0)
    np.testing.assert_allclose(recording["delta_fb"], seconds(recording), atol=1e-9)


def test_partial_joint_states_make_whole_signals(make_bag: Any, drive: Any) -> None:
    records = [record for record in drive(200) if record[0] != FEEDBACK]
    for k in range(200):
        stamp = START + k * SECOND // 100
        joint = [{"steering": 0.01 * k / 100}, {"throttle": 0.5}, {"throttle": 0.5, "steering": 0.01 * k / 100}][k % 3]
        records.append((FEEDBACK, messages.JOINT_STATE, stamp, messages.joint_state(stamp, joint)))
    assert_linear(extract([make_bag(records)], DEFAULT, 25.0))


@pytest.mark.parametrize(("gap", "segments"), [(25, 1), (26, 2), (80, 2)])
def test_gaps_longer_than_max_gap_split_segments(make_bag: Any, drive: Any, gap: int, segments: int) -> None:
    """At 100 Hz, leaving out n - 1 messages makes a gap of n / 100 s; max_gap is 0.25 s."""
    start, end = START + SECOND, START + SECOND + gap * SECOND // 100
    records = [r for r in drive(300) if r[0] != ODOMETRY or not start < r[2] - 3000 < end]
    recording = extract([make_bag(records)], DEFAULT, 100.0)
    assert len(np.unique(recording.segment)) == segments
    assert_linear(recording)


def test_max_gap_is_the_maps(make_bag: Any, drive: Any) -> None:
    bag = make_bag(drive(40, rate=10.0))
    assert len(np.unique(extract([bag], DEFAULT, 25.0).segment)) == 1
    tight = SignalMap.model_validate(DEFAULT.model_dump() | {"max_gap": 0.09})
    recording = extract([bag], tight, 25.0)
    assert len(np.unique(recording.segment)) == len(recording) == 20, "only instants on samples are left"


def test_bags_are_joined_in_the_order_given(make_bag: Any, drive: Any) -> None:
    second, first = make_bag(drive(100, start=START + 9 * SECOND), "second"), make_bag(drive(50), "first")
    recording = extract([first, second], DEFAULT, 25.0)
    assert recording.info.source == ("first", "second")
    assert recording.segment.tolist() == [0] * 13 + [1] * 25


@pytest.mark.parametrize("form", ["mcap", "sqlite"])
def test_a_cut_off_bag_is_extracted_up_to_the_cut_and_the_recording_says_so(
    make_bag: Any, drive: Any, form: str
) -> None:
    bag = make_bag(drive(200), form=form)
    (file,) = (f for f in bag.iterdir() if f.name != "metadata.yaml")
    file.write_bytes(file.read_bytes()[: int(0.6 * file.stat().st_size)])
    recording = extract([bag], DEFAULT, 25.0)
    assert_linear(recording)
    assert 20 < len(recording) < 40
    assert "messages up to the cut" in recording.info.notes[-1]


def test_progress_counts_every_message_that_is_read(make_bag: Any, drive: Any) -> None:
    told: list[tuple[int, int]] = []
    extract([make_bag(drive(20))], DEFAULT, 25.0, progress=lambda done, total: told.append((done, total)))
    assert told == [(k, 60) for k in range(1, 61)]


# --- what is wrong ------------------------------------------------------------------------------


def refused(bag: Path, signal_map: SignalMap, drop_bad: bool = False) -> str:
    with pytest.raises(BagError) as caught:
        extract([bag], signal_map, 25.0, drop_bad)
    message = str(caught.value)
    assert message.startswith(f"{bag}: ")
    assert "\n" not in message
    return message


def test_a_map_that_does_not_fit_the_bag_is_told_before_reading(make_bag: Any, drive: Any) -> None:
    bag = make_bag(drive(5))
    assert "topic /team is missing; the bag has /vehicle/act" in refused(bag, with_source("x"))
    wrong = with_source("brake_feedback", topic="/brake", type="a/msg/B")
    assert "topic /brake is missing" in refused(bag, wrong)
    content = DEFAULT.model_dump()
    for signal in ("throttle_feedback", "steering_feedback"):
        content["signals"][signal]["type"] = "team_msgs/msg/Pedals"
    wrong_type = SignalMap.model_validate(content)
    expected = f"topic {FEEDBACK} has type sensor_msgs/msg/JointState; the signal map expects team_msgs/msg/Pedals"
    assert expected in refused(bag, wrong_type)


def test_a_field_that_the_messages_do_not_have_is_told(make_bag: Any, drive: Any) -> None:
    content = DEFAULT.model_dump()
    content["signals"]["v_x"]["field"] = "twist.twist.linear.speed"
    said = refused(make_bag(drive(5)), SignalMap.model_validate(content))
    assert f"topic {ODOMETRY}: nav_msgs/msg/Odometry has no field 'twist.twist.linear.speed' for signal v_x" in said


def test_a_topic_without_messages_is_told(make_bag: Any, drive: Any) -> None:
    records = [record for record in drive(5) if record[0] != ODOMETRY]
    said = refused(make_bag(records, topics={ODOMETRY: messages.ODOMETRY}), DEFAULT)
    assert f"topic {ODOMETRY} has no messages, needed for v_x" in said


@pytest.mark.parametrize("signal", ["steering_command", "throttle_feedback"])
def test_a_joint_that_never_comes_is_told_if_the_model_needs_it(make_bag: Any, drive: Any, signal: str) -> None:
    content = DEFAULT.model_dump()
    content["signals"][signal]["field"] = "position[other]"
    said = refused(make_bag(drive(5)), SignalMap.model_validate(content))
    assert f"never carries 'position[other]', needed for {signal}" in said


def test_a_brake_that_never_comes_is_told_instead_of_driven_without(make_bag: Any, drive: Any) -> None:
    brake = with_source("brake_feedback", topic=FEEDBACK, type=messages.JOINT_STATE, field="position[brake]")
    assert "never carries 'position[brake]', needed for brake_feedback" in refused(make_bag(drive(5)), brake)


def test_a_message_that_is_damaged_is_told(make_bag: Any, drive: Any) -> None:
    records = changed(drive(20), FEEDBACK, 7, b"\x00\x01\x00\x00\xff\xff")
    assert f"topic {FEEDBACK}: a message is not a sensor_msgs/msg/JointState" in refused(make_bag(records), DEFAULT)


def test_an_empty_bag_is_told(make_bag: Any) -> None:
    assert "topic /vehicle/actuator_feedback is missing; the bag has no topics" in refused(make_bag([]), DEFAULT)


def bad_odometry(kind: str, k: int = 50) -> Any:
    """The odometry message number ``k`` of the drive, spoilt."""
    t, stamp = k / 100, START + k * SECOND // 100
    v_x = {"nan": np.nan, "inf": np.inf, "vast": 1e13}.get(kind, 10 + t)
    stamp += {"repeated": -SECOND // 100, "backwards": -SECOND // 5}.get(kind, 0)
    return messages.odometry(stamp, (10 * t, 1.0, 0.3), (v_x, 0.1 * t, -0.2 * t))


@pytest.mark.parametrize(
    ("kind", "said"),
    [
        ("nan", "v_x: sample 50 at 1700000000.623 s, value nan, is not finite (1 such)"),
        ("inf", "v_x: sample 50 at 1700000000.623 s, value inf, is not finite (1 such)"),
        ("vast", "v_x: sample 50 at 1700000000.623 s, value 1e+13, is larger than any signal (1 such)"),
        ("repeated", "v_x: sample 50 at 1700000000.613 s, value 10.5, is with a repeated stamp (1 such)"),
        ("backwards", "v_x: sample 50 at 1700000000.423 s, value 10.5, is with a stamp that runs backwards (1 such)"),
    ],
)
def test_bad_samples_are_refused_or_left_out(make_bag: Any, drive: Any, kind: str, said: str) -> None:
    bag = make_bag(changed(drive(200), ODOMETRY, 50, bad_odometry(kind)))
    message = refused(bag, DEFAULT)
    assert said in message
    assert "--drop-bad leaves such samples out" in message
    recording = extract([bag], DEFAULT, 25.0, drop_bad=True)
    assert_linear(recording)
    affected = ["v_x"] if kind in ("nan", "inf", "vast") else ["v_x", "v_y", "omega", "x", "y", "theta"]
    assert [note.split(":")[0] for note in recording.info.notes] == affected
    assert "dropped 1 samples" in recording.info.notes[0]


def test_time_that_starts_again_leaves_the_first_run(make_bag: Any, drive: Any) -> None:
    """A bag that was played twice into the recorder: log times go on, header stamps start again."""
    first = drive(150)
    again = [(topic, kind, log + 2 * SECOND, message) for topic, kind, log, message in drive(150)]
    bag = make_bag(first + again)
    assert "with a repeated stamp (1 such)" in refused(bag, DEFAULT) or "runs backwards" in refused(bag, DEFAULT)
    recording = extract([bag], DEFAULT, 25.0, drop_bad=True)
    assert_linear(recording)
    assert len(recording) == 38


def test_a_pose_that_is_never_good_is_left_out_and_the_rest_kept(make_bag: Any, drive: Any) -> None:
    records = [
        (topic, kind, log, messages.odometry(START + k * SECOND // 300, (np.nan,) * 3, (1.0, 0.0, 0.0)))
        if topic == ODOMETRY
        else (topic, kind, log, message)
        for k, (topic, kind, log, message) in enumerate(drive(100))
    ]
    bag = make_bag(records)
    recording = extract([bag], DEFAULT, 25.0)
    assert not recording.has_pose
    assert any("x: topic /vehicle/odometry has no good sample" in note for note in recording.info.notes)


def test_a_needed_signal_without_any_good_sample_is_told(make_bag: Any, drive: Any) -> None:
    records = drive(3)
    for k in range(3):
        records = changed(records, ODOMETRY, k, bad_odometry("nan", k))
    said = refused(make_bag(records), DEFAULT, drop_bad=True)
    assert "has no good sample of 'twist.twist.linear.x', needed for v_x" in said


def test_signals_that_never_overlap_are_told(make_bag: Any, drive: Any) -> None:
    records = [r for r in drive(20) if r[0] != ODOMETRY] + [
        r for r in drive(20, start=START + 60 * SECOND) if r[0] == ODOMETRY
    ]
    with pytest.raises(RecordingError, match=r"bag: no instant is covered by all signals within 0.25 s"):
        extract([make_bag(records)], DEFAULT, 25.0)


def test_a_sample_that_is_not_finite_does_not_set_the_clock() -> None:
    stamps, values = np.array([0, 10, 500, 20, 20, 15, 30]), np.array([0.0, 1.0, np.nan, 2.0, 9.0, 9.0, 3.0])
    kept, dropped = clean(Stream(stamps, values), "here", drop_bad=True)
    assert kept.stamps.tolist() == [0, 10, 20, 30]
    assert kept.values.tolist() == [0.0, 1.0, 2.0, 3.0]
    expected = "1 samples not finite, 1 samples with a repeated stamp, 1 samples with a stamp that runs backwards"
    assert dropped == expected


# --- memory -------------------------------------------------------------------------------------


def peak(bag: Path) -> int:
    """Largest memory that Python held while extracting (bytes)."""
    tracemalloc.start()
    extract([bag], DEFAULT, 25.0)
    _, highest = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    return highest


@pytest.mark.parametrize("form", ["mcap", "sqlite"])
def test_memory_does_not_grow_with_topics_that_are_not_mapped(make_bag: Any, drive: Any, form: str) -> None:
    records = drive(100)
    image = bytes(200_000)
    camera = [("/camera", "sensor_msgs/msg/Image", START + k * SECOND // 100, image) for k in range(150)]
    peak(make_bag(records, "warm", form))  # what is loaded once
    alone, beside = peak(make_bag(records, "alone", form)), peak(make_bag(records + camera, "beside", form))
    assert beside - alone < 6_000_000, "30 MB of images lie in this bag"


@pytest.mark.slow
def test_memory_grows_with_the_signals_only(make_bag: Any, drive: Any) -> None:
    """A step is 1050 bytes of messages and 10 samples of 16 bytes."""
    # both longer than a chunk, and than the 80 s from which on the search for late inputs takes no more; far apart, as a peak
    # varies by some 40 kB from run to run
    steps = (8000, 16000)
    short, long = (make_bag(drive(n), f"bag{n}") for n in steps)
    peak(short)  # what is loaded once
    assert (peak(long) - peak(short)) / (steps[1] - steps[0]) < 2 * 10 * 16


# --- measured data ------------------------------------------------------------------------------


def test_the_putnam_log_is_extracted_to_the_values_of_its_table(putnam: Path) -> None:
    recording = extract([putnam], load_signal_map("av21"), 25.0)
    table = np.genfromtxt(putnam.parent / "putnam_park_run4_2.csv", delimiter=",", skip_header=1)
    with (putnam.parent / "putnam_park_run4_2.csv").open() as file:
        names = [name.split("(")[0] for name in file.readline().removeprefix("# ").split(",")]
    columns = dict(zip(names, table.T, strict=True))
    first = int(np.searchsorted(columns["time"], recording.time[0] / 1e9 - 0.02))
    csv = {name: values[first : first + len(recording)] for name, values in columns.items()}
    assert len(recording) >= len(table) - 2
    assert set(recording.segment) == {0}
    assert np.abs(recording.time / 1e9 - csv["time"]).max() < 1e-3
    throttle = np.where(csv["brake_ped_cmd"] > 0, -csv["brake_ped_cmd"] / 2757.9, csv["throttle_ped_cmd"] / 100)
    for column, values, tolerance in (
        ("v_x", csv["vx"], 0.003),
        ("v_y", csv["vy"], 0.002),
        ("omega", csv["omega"], 0.001),
        ("delta_fb", csv["delta"], 0.003),
    ):
        assert np.abs(recording[column] - values).max() < tolerance, column
    assert np.sqrt(np.mean((recording["r_fb"] - throttle) ** 2)) < 0.01
    assert not recording["r_cmd"].any()
    assert recording.info.notes == ()


def test_the_orca_run_is_extracted_to_the_inputs_that_drove_it(orca_bag: Path) -> None:
    recording = extract([orca_bag], DEFAULT, 50.0)
    run = np.load(orca_bag.parent / "ethz_pure_pursuit.npz")
    n = len(recording)
    np.testing.assert_allclose(recording.matrix[:, :3], run["dstates"][3:6, :n].T, atol=1e-9)
    np.testing.assert_allclose(recording.matrix[:, 3:5] + recording.matrix[:, 5:], run["inputs"][:, :n].T, atol=1e-9)
    assert n == 1000


def test_gear_and_engine_speed_are_kept_over_gaps_and_left_out_where_a_log_lacks_them(
    make_bag: Any, drive: Any
) -> None:
    joints = {
        name: {"topic": "/engine", "type": messages.JOINT_STATE, "field": f"position[{name}]"} for name in ("gear",)
    }
    joints["engine_speed"] = joints["gear"] | {"field": "position[speed]", "unit": "rpm"}
    content = DEFAULT.model_dump()
    content["signals"] |= joints
    signal_map = SignalMap.model_validate(content)
    engine = [
        ("/engine", messages.JOINT_STATE, START + at, messages.joint_state(START + at, {"gear": gear, "speed": 300.0}))
        for at, gear in ((SECOND // 2, 1.0), (3 * SECOND // 2, 2.0))
    ]
    recording = extract([make_bag([*drive(200), *engine])], signal_map, 50.0)
    assert len(recording) == 100, "a second without a message is no gap of the others"
    assert recording["gear"].tolist() == [1.0 + (t >= 1.5 - 1e-9) for t in seconds(recording)]
    np.testing.assert_allclose(recording["engine_speed"], 10 * np.pi)
    without = extract([make_bag(drive(200), name="without")], signal_map, 50.0)
    assert "gear" not in without.columns
    assert [note for note in without.info.notes if "gear" in note] == ["gear: no topic /engine in the log; left out"]
