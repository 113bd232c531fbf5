"""Messages to named SI values."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from dynssm_ros.errors import BagError
from dynssm_ros.signals.decoding import TopicDecoder, decoders, header_stamp_ns
from dynssm_ros.signals.messages import joint_state, odometry
from dynssm_ros.signals.signal_map import SignalMap, load_signal_map

DEFAULT = load_signal_map("default")
ODOMETRY = "nav_msgs/msg/Odometry"


def with_field(field: str, **more: Any) -> SignalMap:
    content = DEFAULT.model_dump()
    content["signals"]["v_x"] |= {"field": field} | more
    return SignalMap.model_validate(content)


def test_every_topic_has_a_decoder_and_odometry_comes_last() -> None:
    found = decoders(DEFAULT)
    assert [*found][-1] == "/vehicle/odometry"
    assert found["/vehicle/odometry"].signals == ("v_x", "v_y", "omega", "x", "y", "theta")
    assert found["/vehicle/actuator_command"].signals == ("throttle_command", "steering_command")
    assert [*decoders(DEFAULT.with_commands("none"))] == ["/vehicle/actuator_feedback", "/vehicle/odometry"]


def test_all_signals_of_a_message_come_out_in_si_units() -> None:
    message = odometry(0, (1.0, 2.0, 0.5), (3.0, 0.1, -0.2))
    values = decoders(DEFAULT)["/vehicle/odometry"].decode(message)
    assert values == pytest.approx({"v_x": 3.0, "v_y": 0.1, "omega": -0.2, "x": 1.0, "y": 2.0, "theta": 0.5})


def test_scale_and_offset_are_applied_in_this_order() -> None:
    signal_map = with_field("twist.twist.linear.x", scale=-2.0, offset=1.0)
    decoder = TopicDecoder("/vehicle/odometry", ODOMETRY, signal_map.signals)
    assert decoder.decode(odometry(0, (0, 0, 0), (3.0, 0.0, 0.0)))["v_x"] == -5.0


@pytest.mark.parametrize(
    ("measured", "throttle"), [(-1.0, -0.8), (-0.5, -0.4), (0.05, 0.0), (0.6, 0.25), (2.0, 0.5), (np.inf, np.inf)]
)
def test_a_curve_comes_before_scale_and_offset_and_holds_its_ends(measured: float, throttle: float) -> None:
    """A dead band up to 0.2; what is not finite stays so."""
    curve = [[-1.0, -1.6], [0.0, 0.0], [0.2, 0.0], [1.0, 1.0]]
    signal_map = with_field("twist.twist.linear.x", curve=curve, scale=0.5)
    decoder = TopicDecoder("/vehicle/odometry", ODOMETRY, signal_map.signals)
    assert decoder.decode(odometry(0, (0, 0, 0), (measured, 0.0, 0.0)))["v_x"] == pytest.approx(throttle)


def test_a_partial_joint_state_gives_what_it_has() -> None:
    decoder = decoders(DEFAULT)["/vehicle/actuator_feedback"]
    assert decoder.decode(joint_state(0, {"steering": 0.1})) == {"steering_feedback": 0.1}
    assert decoder.decode(joint_state(0, {})) == {}


def test_not_a_number_is_passed_on_for_others_to_judge() -> None:
    values = decoders(DEFAULT)["/vehicle/odometry"].decode(odometry(0, (0, 0, 0), (float("nan"), np.inf, 0.0)))
    assert np.isnan(values["v_x"])
    assert np.isinf(values["v_y"])


@pytest.mark.parametrize(
    ("field", "expected"),
    [
        ("twist.twist.linear.speed", ["no field 'twist.twist.linear.speed'", "at 'speed'", "there: x, y, z"]),
        ("velocity", ["no field 'velocity'", "child_frame_id, header, pose, twist"]),
        ("twist.twist.linear.x.value", ["no field 'twist.twist.linear.x.value'", "there: nothing"]),
        ("twist.twist.linear.x[0]", ["'twist.twist.linear.x[0]'", "not a number"]),
        ("header.frame_id", ["'header.frame_id'", "not a number"]),
        ("twist.twist", ["'twist.twist'", "not a number"]),
        ("twist.covariance", ["'twist.covariance'", "not a number"]),
        ("twist.covariance[steering]", ["no field 'twist.covariance[steering]'", "at 'name'"]),
        ("yaw(pose.pose.position)", ["no field 'yaw(pose.pose.position)'", "at 'w'"]),
    ],
)
def test_a_field_that_does_not_fit_names_topic_type_field_and_what_is_there(field: str, expected: list[str]) -> None:
    decoder = TopicDecoder("/vehicle/odometry", ODOMETRY, with_field(field).signals)
    with pytest.raises(BagError) as caught:
        decoder.decode(odometry(0, (0, 0, 0), (0, 0, 0)))
    for part in ("topic /vehicle/odometry", "signal v_x", *expected):
        assert part in str(caught.value)


def test_fields_of_live_messages_are_named_without_their_underscores() -> None:
    class Live:
        __slots__ = ("_check_fields", "_linear")

    with pytest.raises(BagError, match="there: linear"):
        TopicDecoder("/vehicle/odometry", ODOMETRY, with_field("angular").signals).decode(Live())


@pytest.mark.parametrize("stamp", [0, 1, 1_700_000_000_123_456_789, 2**31 * 10**9 - 1])
def test_header_stamps_are_exact_nanoseconds(stamp: int) -> None:
    assert header_stamp_ns(odometry(stamp, (0, 0, 0), (0, 0, 0))) == stamp


@pytest.mark.parametrize("message", [SimpleNamespace(), SimpleNamespace(header=3.0), SimpleNamespace(header=None)])
def test_a_message_without_a_header_has_no_stamp(message: Any) -> None:
    assert header_stamp_ns(message) is None
