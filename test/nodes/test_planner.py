"""A planner asks the predictor what comes of other inputs."""

from __future__ import annotations

import numpy as np
import pytest
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from dynssm_ros.signals.messages import CANDIDATE_TOPIC, ROLLOUT_TOPIC

pytestmark = [pytest.mark.live, pytest.mark.timeout(120)]


def test_a_planner_is_told_what_comes_of_its_inputs(car) -> None:
    car.drive_until_answered()
    answers: list[JointTrajectory] = []
    car.collector.create_subscription(JointTrajectory, ROLLOUT_TOPIC, answers.append, 10)
    ask = car.collector.create_publisher(JointTrajectory, CANDIDATE_TOPIC, 10).publish
    question = JointTrajectory(joint_names=["throttle", "steering"])
    for k in range(20):
        point = JointTrajectoryPoint(positions=[0.2, 0.01])
        point.time_from_start.nanosec = k * 20_000_000
        question.points.append(point)

    def comes() -> bool:
        assert car.answered(car.step())
        ask(question)
        return car.collector.wait_for(lambda: any(len(answer.points) == 20 for answer in answers), 0.3)

    assert any(comes() for _ in range(50))
    answer = next(answer for answer in answers if len(answer.points) == 20)
    assert list(answer.joint_names) == ["x", "y", "theta", "v_x", "v_y", "omega"]
    assert answer.points[19].time_from_start.nanosec == 400_000_000
    assert np.isfinite([point.positions for point in answer.points]).all()
    answers.clear()
    ask(JointTrajectory(joint_names=["torque"]))
    assert car.collector.wait_for(lambda: bool(answers), 5.0)
    assert not answers[-1].points
    assert car.answered(car.step()), "it goes on"
