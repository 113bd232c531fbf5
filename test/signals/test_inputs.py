"""Raw actuator signals to the model's inputs."""

from __future__ import annotations

import numpy as np

from dynssm_ros.signals.inputs import WINDOW_COLUMNS, applied_inputs, lookahead_commands, model_inputs, signed_throttle

THROTTLE = np.array([0.0, 0.4, 0.4, 1.0])
BRAKE = np.array([0.0, 0.0, 0.3, 1.0])


def test_the_brake_wins_over_the_throttle_and_is_negative() -> None:
    np.testing.assert_array_equal(signed_throttle(THROTTLE, BRAKE), [0.0, 0.4, -0.3, -1.0])


def test_without_a_brake_the_throttle_is_taken_as_it_is() -> None:
    np.testing.assert_array_equal(signed_throttle(np.array([-0.5, 0.5]), None), [-0.5, 0.5])


def test_a_negative_brake_signal_is_no_brake() -> None:
    np.testing.assert_array_equal(signed_throttle(np.array([0.2]), np.array([-0.01])), [0.2])


def test_commands_become_increments_on_top_of_the_feedback() -> None:
    signals = {
        "throttle_feedback": THROTTLE,
        "brake_feedback": BRAKE,
        "steering_feedback": np.array([0.0, 0.1, 0.2, 0.3]),
        "throttle_command": np.array([0.1, 0.0, 0.5, 0.0]),
        "brake_command": np.array([0.0, 0.2, 0.0, 0.0]),
        "steering_command": np.array([0.1, 0.1, 0.1, 0.1]),
    }
    inputs = model_inputs(signals)
    np.testing.assert_allclose(inputs.r_fb + inputs.r_cmd, [0.1, -0.2, 0.5, 0.0], atol=1e-15)
    np.testing.assert_allclose(inputs.delta_fb + inputs.delta_cmd, 0.1, atol=1e-15)


def test_without_commands_the_increments_are_zero() -> None:
    inputs = model_inputs({"throttle_feedback": THROTTLE, "steering_feedback": THROTTLE})
    np.testing.assert_array_equal([inputs.r_cmd, inputs.delta_cmd], np.zeros((2, 4)))


def test_the_applied_inputs_of_window_rows_are_feedback_plus_command() -> None:
    rows = np.arange(14.0).reshape(7, 2)
    applied = applied_inputs(rows)
    columns = dict(zip(WINDOW_COLUMNS, rows, strict=True))
    np.testing.assert_array_equal(applied.r, columns["r_fb"] + columns["r_cmd"])
    np.testing.assert_array_equal(applied.delta, columns["delta_fb"] + columns["delta_cmd"])


def test_lookahead_takes_the_next_feedback_inside_a_segment_only() -> None:
    feedback, segment = np.array([1.0, 2.0, 4.0, 8.0, 16.0]), np.array([0, 0, 0, 1, 1], dtype=np.int32)
    np.testing.assert_array_equal(lookahead_commands(feedback, segment), [1.0, 2.0, 0.0, 8.0, 0.0])
    np.testing.assert_array_equal(lookahead_commands(feedback[:1], segment[:1]), [0.0])
