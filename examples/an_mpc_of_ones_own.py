"""An MPC of one's own on ``/dynssm/parameters``: some lines of casadi that plan with the predictor's coefficients.

    simulator --ros-args -p driver:=external -p lockstep:=true &  # the car, whose time waits for the commands
    predictor --ros-args -p model:=MODEL -p max_age:=1.0 &        # a model trained for the 1:43 car
    python -m examples.an_mpc_of_ones_own

The car follows the centre line of the club track. Until coefficients arrive, those of the vehicle file are used.
"""

from __future__ import annotations

import casadi as ca
import numpy as np
from nav_msgs.msg import Odometry
from rclpy.node import Node
from sensor_msgs.msg import JointState

from dynssm_ros import load_vehicle
from dynssm_ros.nodes.support import NEWEST_QOS, SENSOR_QOS, actuators, run
from dynssm_ros.signals.decoding import header_stamp_ns
from dynssm_ros.track.tracks import load_track
from dynssm_ros.vehicle import COEFFICIENTS, Applied, CarModel, Coefficients, State
from dynssm_ros.vehicle.kinematics import Pose, advance_pose

STEPS = 15  # of T_s that are planned
SPEED = 1.3  # m/s
LAUNCH_SPEED = 0.9  # m/s below which the tyres' equations are too stiff for one step of T_s


class OwnMpc(Node):
    """Answers each odometry message with throttle and steering."""

    def __init__(self) -> None:
        super().__init__("own_mpc")
        self.car = load_vehicle("orca")
        self.centre = load_track("club").centre
        self.theta = self.car.nominal
        self.plan = np.tile([0.2, 0.0], (STEPS, 1))
        self.solver = self._program()
        self.commands = self.create_publisher(JointState, "/vehicle/actuator_command", SENSOR_QOS)
        self.create_subscription(JointState, "/dynssm/parameters", self._adapted, SENSOR_QOS)
        self.create_subscription(Odometry, "/vehicle/odometry", self._odometry, NEWEST_QOS)

    def _program(self) -> ca.Function:
        """The plan as a function of state, last command, coefficients, points to pass and a first guess."""
        opti, car = ca.Opti(), self.car
        physics = CarModel.of(car, xp=ca)
        u = opti.variable(STEPS, 2)
        start, last, theta, points = (opti.parameter(*shape) for shape in ((6, 1), (1, 2), (17, 1), (STEPS, 2)))
        pose, state = Pose(*ca.vertsplit(start[:3])), State(*ca.vertsplit(start[3:]))
        cost, before = ca.MX(0), last
        for k in range(STEPS + 1):
            # a command acts one step after the odometry that it answers: until then, the last one
            command = last if k == 0 else u[k - 1, :]
            applied, coefficients = Applied(command[0], command[1]), Coefficients(*ca.vertsplit(theta))
            after, _ = physics.step(state, applied, coefficients)
            pose, state = advance_pose(ca, pose, state, after, car.sampling_time), after
            if k > 0:
                away = ca.vertcat(pose.x, pose.y) - points[k - 1, :].T
                cost += ca.sumsqr(away) / 0.02**2 + ca.sumsqr(command - before) / 0.2**2
            before = command
        opti.minimize(cost)
        opti.subject_to(opti.bounded(car.inputs.throttle[0], u[:, 0], car.inputs.throttle[1]))
        opti.subject_to(opti.bounded(car.inputs.steering[0], u[:, 1], car.inputs.steering[1]))
        opti.solver(
            "ipopt", {"print_time": False, "error_on_fail": False}, {"print_level": 0, "sb": "yes", "max_iter": 25}
        )
        return opti.to_function("plan", [start, last, theta, points, u], [u])

    def _adapted(self, message: JointState) -> None:
        """Takes the coefficients by name."""
        values = dict(zip(message.name, message.position, strict=True))
        self.theta = np.array([values[name] for name in COEFFICIENTS])

    def _odometry(self, message: Odometry) -> None:
        """Plans from the measured state and sends the first command of the plan."""
        pose, twist = message.pose.pose, message.twist.twist
        heading = 2 * np.arctan2(pose.orientation.z, pose.orientation.w)
        state = [pose.position.x, pose.position.y, heading, twist.linear.x, twist.linear.y, twist.angular.z]
        (s,), _ = self.centre.project(np.array([state[:2]]))
        if twist.linear.x < LAUNCH_SPEED:
            steering = float(np.arctan(0.062 * self.centre.curvature(s + 0.05)))
            self.plan[:] = 0.5, steering
        else:
            ahead = s + SPEED * self.car.sampling_time * np.arange(2, STEPS + 2)
            guess = np.vstack([self.plan[1:], self.plan[-1:]])
            self.plan = np.array(self.solver(state, self.plan[:1], self.theta, self.centre.position(ahead), guess))
        acts = (header_stamp_ns(message) or 0) + round(self.car.sampling_time * 1e9)
        self.commands.publish(actuators(acts, Applied(*self.plan[0])))


def main() -> None:
    """Runs the node until it is interrupted."""
    run(OwnMpc)


if __name__ == "__main__":
    main()
