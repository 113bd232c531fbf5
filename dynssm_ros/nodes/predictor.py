"""The live predictor: ``ros2 run dynssm_ros predictor --ros-args -p model:=DIR``.

Every odometry message gets a prediction of the next state once the window is full; topics and parameters are those of
``docs/use/predictor.md``. All thinking is in :mod:`dynssm_ros.runtime`; this node converts, calls and publishes. Until it
is activated it already predicts and learns, but publishes only its diagnostics: a stand-by takes over with its window full.
"""

from __future__ import annotations

import os
import pathlib
import stat
import threading
import time
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry, Path
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.msg import SetParametersResult
from rclpy.parameter import Parameter
from rclpy.subscription import Subscription
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory

from dynssm_ros.arrays import Vector
from dynssm_ros.errors import ConfigurationError, UserError
from dynssm_ros.nodes.commands import candidate, rollout_as
from dynssm_ros.nodes.display import Markers, frame_sender
from dynssm_ros.nodes.executor import in_thread, let_wait, take
from dynssm_ros.nodes.managed import ManagedNode
from dynssm_ros.nodes.rivals import WatchedOutput
from dynssm_ros.nodes.support import (
    describe,
    diagnostics,
    expanded,
    listen,
    message_class,
    output,
    relative,
    repeat,
    run,
    set_pose,
    set_stamp,
    waited,
    waiting,
)
from dynssm_ros.runtime.artifact import parse_artifact, read_folder
from dynssm_ros.runtime.graph import try_graph
from dynssm_ros.runtime.health import Health, Level
from dynssm_ros.runtime.onnx_model import OnnxModel
from dynssm_ros.runtime.predictor import Prediction, Predictor
from dynssm_ros.runtime.trial import try_model
from dynssm_ros.runtime.wiring import Wiring
from dynssm_ros.signals.decoding import Frames, TopicDecoder, frames_of, header_stamp_ns, live_decoders
from dynssm_ros.signals.history import Refusal
from dynssm_ros.signals.inputs import WINDOW_COLUMNS
from dynssm_ros.signals.messages import (
    CANDIDATE_TOPIC,
    HORIZON_TOPIC,
    PARAMETERS_TOPIC,
    PREDICTION_TOPIC,
    ROLLOUT_TOPIC,
    planar_covariance,
)
from dynssm_ros.signals.signal_map import load_signal_map
from dynssm_ros.vehicle import COEFFICIENTS
from dynssm_ros.vehicle.kinematics import Pose

_SAVE_PERIOD_S = 10.0
_ROLLOUT = 0.8  # of T_s from the odometry's arrival, after which a rollout is cut off


class PredictorNode(ManagedNode):
    """Subscribes to the topics of the signal map and publishes the predicted state and the adapted coefficients."""

    def __init__(self, **options: Any) -> None:
        super().__init__("dynssm", **options)
        describe(self, "model", "", "Model folder; setting it anew swaps the model after it was checked.")
        self._root = describe(
            self, "model_root", "", "Folder below which model folders must be; empty: anywhere.", read_only=True
        )
        self._signals = describe(self, "signals", "default", "Signal map: shipped name or file.", read_only=True)
        self._max_age = describe(
            self,
            "max_age",
            0.2,
            "Oldest actuator sample that a prediction may rest on (s).",
            (0.01, 10.0),
            read_only=True,
        )
        self._frames = (
            describe(self, "frame_id", "", "Frame of the odometry's pose; empty: as it comes first.", read_only=True),
            describe(
                self, "child_frame_id", "", "Frame of the odometry's twist; empty: as it comes first.", read_only=True
            ),
        )
        self._horizon = describe(
            self, "horizon", 0.0, "Length of the rollout on /dynssm/horizon (s); 0 switches it off.", (0.0, 10.0)
        )
        self._online = describe(
            self, "online", True, "Whether the model's online layer learns and corrects, if it has one.", read_only=True
        )
        self._state = describe(
            self,
            "online_state",
            "",
            "File of what the online layer has learned: read at the start if it is there, written while driving.",
            read_only=True,
        )
        self._draws = describe(
            self, "markers", False, "Whether the predicted car and its way are drawn for RViz.", read_only=True
        )
        self._sends_frame = describe(
            self, "tf", False, "Whether the predicted pose is sent to TF (needs tf2_ros).", read_only=True
        )
        self._period = describe(
            self, "diagnostics_period", 1.0, "Time between /diagnostics (s).", (0.1, 60.0), read_only=True
        )
        self._writing: threading.Thread | None = None
        self._swap: OnnxModel | None = None
        self._tried: dict[str, OnnxModel | UserError] = {}
        let_wait(self, self._try_models)
        self._prediction = Odometry()
        self._prediction.pose.covariance = planar_covariance(None)
        self._adapted = JointState(name=list(COEFFICIENTS))
        self.add_on_set_parameters_callback(self._check_parameters)
        self.add_post_set_parameters_callback(self._apply_parameters)
        self.start()

    def prepare(self) -> None:
        """Opens the model and listens."""
        path = expanded(self.get_parameter("model").value)
        if not path:
            raise ConfigurationError("parameter model: not set; expected a model folder, e.g. -p model:=out/model")
        self._predictor = Predictor(
            self._open(path), load_signal_map(self._signals), self._max_age, self._online, frames=self._frames
        )
        self._notice = self._load_state(pathlib.Path(self._state)) if self._state else ""
        self._output = WatchedOutput(self, Odometry, PREDICTION_TOPIC)
        self._publish_parameters = output(self, JointState, PARAMETERS_TOPIC).publish
        self._publish_horizon = output(self, Path, HORIZON_TOPIC).publish
        self._publish_rollout = output(self, JointTrajectory, ROLLOUT_TOPIC).publish
        self._markers = Markers(self) if self._draws else None
        self._send_frame = frame_sender(self) if self._sends_frame else None
        self._publish_diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10).publish

        self._set_wiring()
        self._listen()
        repeat(self, self._period, self._diagnose)
        if self._state:
            repeat(self, _SAVE_PERIOD_S, self._keep_aside)
        model = self._predictor.model
        self.get_logger().info(
            f"{model.name} ({model.parameters} parameters): {model.H} rows of {model.T_s:g} s, commands {model.commands}"
        )

    def _open(self, path: str, rows: Vector | None = None) -> OnnxModel:
        """The model in a folder.

        Args:
            path: of the folder.
            rows: that it is tried on before, to take the place of the present model; without them it is only opened before.
                Both in a process of its own.

        Raises:
            ConfigurationError: the folder is not below ``model_root``.
            ArtifactError: there is no usable model in it.
        """
        if self._root and not pathlib.Path(os.path.realpath(path)).is_relative_to(os.path.realpath(self._root)):
            raise ConfigurationError(
                f"{path}: is not below {self._root}; expected a folder in it (parameter model_root)"
            )
        files = read_folder(path, self._root)
        if rows is not None:
            try_model(pathlib.Path(path), files, self._predictor.model.card, rows)
        artifact = parse_artifact(pathlib.Path(path), files)
        if rows is None and artifact.card.network:
            try_graph(artifact.onnx, artifact.graph, artifact.card.window, len(WINDOW_COLUMNS))
        return OnnxModel(artifact)

    async def _try_models(self, parameters: list[ParameterMessage]) -> None:
        """Opens and tries the models that are asked for, while the node goes on predicting."""
        self._tried.clear()  # of a request that was refused before it came to the model
        for parameter in parameters:
            if parameter.name == "model" and self.prepared:
                path = expanded(parameter.value.string_value)
                self._tried[path] = await in_thread(self, partial(self._try, path, self._predictor.recent()))

    def _try(self, path: str, rows: Vector) -> OnnxModel | UserError:
        try:
            return self._open(path, rows)
        except UserError as error:
            return error

    def _listen(self) -> None:
        """Subscribes to what the signal map names, none of which may be silent for longer than ``max_age`` or its gap."""
        signal_map = self._predictor.signal_map
        by_topic = live_decoders(signal_map)
        self._names = {topic: self.resolve_topic_name(decoder.subscribed) for topic, decoder in by_topic.items()}
        self._health = Health(
            tuple(self._names.values()), max(self._max_age, signal_map.max_gap), self._predictor.model.T_s
        )
        self._subscribed: dict[TopicDecoder, Subscription] = {}
        # actuators come first: when several messages wait, the executor serves subscriptions in this order
        for topic, decoder in by_topic.items():
            receive = self._on_odometry if topic == signal_map.odometry_topic else self._on_actuator
            subscription = listen(self, message_class(decoder.msgtype), decoder.subscribed, partial(receive, decoder))
            self._subscribed[decoder] = subscription
        actuators = [each for each in self._subscribed.items() if each[0].topic != signal_map.odometry_topic]
        self._following = {decoder: actuators[k + 1 :] for k, (decoder, _) in enumerate(actuators)}
        listen(self, JointTrajectory, relative(CANDIDATE_TOPIC), self._on_candidate)

    def _on_candidate(self, message: JointTrajectory) -> None:
        """Answers a planner: what comes of these inputs. What cannot be answered has no points."""
        T_s, rollout = self._predictor.model.T_s, None
        if not self.active:
            return
        try:
            inputs = candidate(message, self._predictor.vehicle.inputs.set_point, T_s)
            rollout = self._predictor.rollout(inputs, deadline=time.monotonic() + _ROLLOUT * T_s)
        except UserError as error:
            self.get_logger().warning(str(error), throttle_duration_sec=1.0)
        self._publish_rollout(rollout_as(rollout, T_s, self._prediction.header.frame_id))

    def _arrived(self, decoder: TopicDecoder, message: Any, times: Mapping[str, int]) -> tuple[int, float]:
        """Notes a message; returns its stamp (ns) and when it arrived (s)."""
        stamp, arrived = self._stamp(message), time.monotonic() - waited(times)
        self._health.arrived(self._names[decoder.topic], arrived, stamp)
        return stamp, arrived

    def _on_actuator(self, decoder: TopicDecoder, message: Any, times: Mapping[str, int]) -> None:
        """Takes a message, and one from each actuator topic after its own: those of one instant come together, and another
        wake-up of the executor takes as long as a prediction.
        """
        self._observe(decoder, message, times, None)
        for other, subscription in self._following[decoder]:
            if taken := take(subscription):
                self._observe(other, *taken, None)

    def _observe(self, decoder: TopicDecoder, message: Any, times: Mapping[str, int], frames: Frames | None) -> None:
        """Takes a message into the history."""
        stamp, _ = self._arrived(decoder, message, times)
        refusal = self._predictor.observe(stamp, decoder.decode(message, stamp), frames)
        if refusal is not None:
            self._health.refused(refusal)

    def _on_odometry(self, decoder: TopicDecoder, message: Any, times: Mapping[str, int]) -> None:
        if waited(times) > self._predictor.model.T_s:  # the instant that it would predict has passed
            message, times = self._newest(decoder, message, times)
        stamp, arrived = self._arrived(decoder, message, times)
        outcome = self._predictor.predict(stamp, decoder.decode(message, stamp), frames_of(message))
        if not isinstance(outcome, Prediction):
            self._health.refused(outcome)
            return
        if self.active:
            self._publish(outcome, message, arrived + _ROLLOUT * self._predictor.model.T_s)
        late = self._health.delivery(self._names[decoder.topic]).newest
        self._health.predicted(time.monotonic() - arrived, outcome.residual_share, late)
        self._predictor.finish()
        self._wiring.add(stamp, self._predictor.row)

    def _newest(self, decoder: TopicDecoder, message: Any, times: Mapping[str, int]) -> tuple[Any, Mapping[str, int]]:
        """Takes all that waits into the history but the newest odometry, which it returns."""
        older = [(message, times), *waiting(self._subscribed[decoder])]  # first: its actuators are there then
        for other, subscription in self._subscribed.items():
            if other is not decoder:
                for each in waiting(subscription):
                    self._observe(other, *each, None)
        newest = older.pop()
        for each, when in older:
            self._observe(decoder, each, when, frames_of(each))
            self._health.refused(Refusal.SKIPPED)
        return newest

    def _set_wiring(self) -> None:
        self._wiring = Wiring(self._predictor.vehicle, self._predictor.model.T_s)

    def _publish(self, prediction: Prediction, message: Any, deadline: float) -> None:
        odometry = self._prediction
        set_stamp(odometry.header, prediction.stamp)
        if isinstance(message, Odometry):
            odometry.header.frame_id = message.header.frame_id
            odometry.child_frame_id = getattr(message, "child_frame_id", "")
        twist = odometry.twist.twist
        twist.linear.x, twist.linear.y, twist.angular.z = prediction.state.tolist()
        odometry.twist.covariance = planar_covariance(prediction.variance)
        if prediction.pose is not None:
            set_pose(odometry.pose.pose, *prediction.pose)
        self._output.publish(odometry)
        if prediction.theta is not None:
            self._adapted.header.stamp = odometry.header.stamp
            self._adapted.position = prediction.theta.tolist()
            self._adapted.effort = [] if prediction.theta_std is None else prediction.theta_std.tolist()
            self._publish_parameters(self._adapted)
        ahead: list[Pose] = []
        if self._horizon > 0:
            steps = max(1, round(self._horizon / self._predictor.model.T_s))
            ahead = self._predictor.horizon(prediction, steps, deadline=deadline)
            self._publish_horizon(self._path(prediction, ahead))
        if prediction.pose is not None and self._markers is not None:
            self._markers.draw(odometry.header, self._predictor.vehicle, prediction.pose, ahead)
        if prediction.pose is not None and self._send_frame is not None:
            self._send_frame(odometry)

    def _path(self, prediction: Prediction, ahead: list[Pose]) -> Path:
        period = self._predictor.model.T_s
        path = Path(header=self._prediction.header)
        for k, pose in enumerate(ahead):
            stamped = PoseStamped()
            stamped.header.frame_id = path.header.frame_id
            set_stamp(stamped.header, prediction.stamp + round(k * period * 1e9))
            set_pose(stamped.pose, *pose)
            path.poses.append(stamped)
        return path

    def _stamp(self, message: Any) -> int:
        stamp = header_stamp_ns(message)
        return int(self.get_clock().now().nanoseconds) if stamp is None else stamp

    def _check_parameters(self, parameters: list[Parameter]) -> SetParametersResult:
        """Accepts a new model that was opened and tried; a bad one changes nothing."""
        self._swap = None  # what was refused with others is not to be installed by a later set
        for parameter in parameters:
            if parameter.name == "model" and self.prepared:
                path = expanded(parameter.value)
                try:
                    model = self._tried.pop(path, None) or self._try(path, self._predictor.recent())
                    if isinstance(model, UserError):
                        raise model
                    self._predictor.check_swap(model)
                except UserError as error:
                    self.get_logger().error(str(error))
                    return SetParametersResult(successful=False, reason=str(error))
                self._swap = model
        return SetParametersResult(successful=True)

    def _apply_parameters(self, parameters: list[Parameter]) -> None:
        for parameter in parameters:
            if parameter.name == "horizon":
                self._horizon = parameter.value
        if self._swap is not None and any(parameter.name == "model" for parameter in parameters):
            self._predictor.swap(self._swap)
            self._swap = None
            self._set_wiring()
            self.get_logger().info(
                f"model swapped: {self._predictor.model.name} from {self._predictor.model.artifact.path}"
            )

    def _load_state(self, path: pathlib.Path) -> str:
        """Goes on from what was learned before, if that is there; else from the prior, and says why.

        What was learned is a convenience: a file that cannot be used is set aside, and the node predicts.
        """
        if not os.path.lexists(path):
            return ""
        try:
            self._predictor.load_online(path)
        except UserError as error:
            words = f"{error}; learns from the prior"
            if self._predictor.online is not None:
                try:
                    kind = os.stat(path).st_mode
                    if stat.S_ISREG(kind) or stat.S_ISFIFO(kind):
                        path.rename(f"{path}.bad")
                        words += f"; set aside as {path.name}.bad"
                except OSError as refusal:
                    words += f"; cannot be set aside ({refusal.strerror})"
            self.get_logger().warning(words)
            return words
        return ""

    def keep(self) -> None:
        """Writes what the online layer has learned, if a file is named for it."""
        if self._state:
            if self._writing is not None:
                self._writing.join()
            self._write(self._predictor.online_writer(pathlib.Path(self._state)))

    def _keep_aside(self) -> None:
        """The same in a thread of its own, so that no prediction waits for a disk."""
        if self._writing is None or not self._writing.is_alive():
            write = self._predictor.online_writer(pathlib.Path(self._state))
            self._writing = threading.Thread(target=self._write, args=(write,), daemon=True)
            self._writing.start()

    def _write(self, write: Callable[[], None]) -> None:
        try:
            write()
        except UserError as error:
            self.get_logger().error(str(error))

    def _diagnose(self) -> None:
        now = time.monotonic()
        self._health.wiring = self._wiring.verdict()
        self._health.hindsight = self._predictor.hindsight()
        self._health.publishers = {topic: self.count_publishers(topic) for topic in self._health.topics}
        level, words = self._health.verdict(now)
        if (rival := self._output.rival()) and self.active:
            level, words = Level.ERROR, f"{words}; {rival}"
        if self._notice:
            level, words = max(level, Level.WARN), f"{words}; {self._notice}"
        if not self.active:
            words = f"inactive, publishes nothing: {words}"
        values = self._predictor.figures() | self._health.values(now)
        vehicle = self._predictor.vehicle.name
        self._publish_diagnostics(diagnostics(self, "prediction", vehicle, level=level, words=words, values=values))


def main(args: list[str] | None = None) -> None:
    """Runs the node; a user error is one line and exit status 1."""
    run(PredictorNode, args)


if __name__ == "__main__":
    main()
