"""What a predictor shows on a screen: the predicted frame on TF, and the car and the way ahead of it as RViz markers."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterable

from builtin_interfaces.msg import Duration
from geometry_msgs.msg import Point, TransformStamped
from nav_msgs.msg import Odometry
from rclpy.node import Node
from std_msgs.msg import ColorRGBA, Header
from visualization_msgs.msg import Marker, MarkerArray

from dynssm_ros.errors import ConfigurationError
from dynssm_ros.nodes.support import output, set_pose
from dynssm_ros.signals.messages import MARKERS_TOPIC
from dynssm_ros.vehicle import Vehicle
from dynssm_ros.vehicle.kinematics import Pose

_ASPECT = 0.5  # width of the drawn car over its wheelbase
_LINE = 0.06  # width of a line over the wheelbase
_LIFE = Duration(sec=1)  # of a marker that is not renewed
_ORANGE = ColorRGBA(r=0.9, g=0.45, b=0.0, a=0.9)
_BLUE = ColorRGBA(r=0.1, g=0.35, b=0.8, a=0.9)
_PREDICTED = "_predicted"  # what the frame of the predicted car has behind the name of the car's frame


def frame_sender(node: Node) -> Callable[[Odometry], None]:
    """Sends a predicted pose to TF: from the odometry's frame to the car's with ``_predicted`` behind its name.

    Raises:
        ConfigurationError: ``tf2_ros`` is not installed.
    """
    try:
        tf2_ros = importlib.import_module("tf2_ros")
    except ImportError as error:
        raise ConfigurationError(
            "parameter tf: needs tf2_ros, which comes with a ROS installation; source one"
        ) from error
    broadcaster = tf2_ros.TransformBroadcaster(node)

    def send(prediction: Odometry) -> None:
        pose = prediction.pose.pose
        transform = TransformStamped(header=prediction.header)
        transform.child_frame_id = (prediction.child_frame_id or "base_link") + _PREDICTED
        transform.transform.translation.x, transform.transform.translation.y = pose.position.x, pose.position.y
        transform.transform.rotation = pose.orientation
        broadcaster.sendTransform(transform)

    return send


class Markers:
    """Draws the predicted car from axle to axle, and the way ahead as a line, on ``/dynssm/markers``.

    Args:
        node: whose publisher sends them.
    """

    def __init__(self, node: Node) -> None:
        self._publish = output(node, MarkerArray, MARKERS_TOPIC).publish

    def draw(self, header: Header, car: Vehicle, pose: Pose, ahead: Iterable[Pose]) -> None:
        """Sends the markers of one prediction.

        Args:
            header: stamp and frame of the prediction.
            car: whose axles are drawn.
            pose: predicted centre of gravity.
            ahead: poses of the rollout; nothing is drawn without any.
        """
        front, rear = car.constants.l_f, car.constants.l_r
        wheelbase = front + rear
        half = _ASPECT * wheelbase / 2
        corners = [(front, half), (front, -half), (-rear, -half), (-rear, half), (front, 0.0), (front, half)]
        body = self._line(header, 0, _ORANGE, wheelbase, corners)
        set_pose(body.pose, *pose)
        way = [(float(x), float(y)) for x, y, _ in ahead]
        self._publish(MarkerArray(markers=[body, *([self._line(header, 1, _BLUE, wheelbase, way)] if way else [])]))

    @staticmethod
    def _line(
        header: Header, number: int, color: ColorRGBA, wheelbase: float, points: list[tuple[float, float]]
    ) -> Marker:
        marker = Marker(header=header, ns="dynssm", id=number, type=Marker.LINE_STRIP, action=Marker.ADD)
        marker.pose.orientation.w = 1.0
        marker.scale.x = _LINE * wheelbase
        marker.color, marker.lifetime = color, _LIFE
        marker.points = [Point(x=float(x), y=float(y)) for x, y in points]
        return marker
