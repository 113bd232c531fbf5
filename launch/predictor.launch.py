"""Starts the predictor beside a car's stack: ``ros2 launch dynssm_ros predictor.launch.py model:=MODEL_DIR``."""

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare


def predictor(context: LaunchContext) -> list[Node]:
    """The node; an argument that was left empty does not override what the parameters file says."""
    names = ("model", "signals", "use_sim_time", "autostart", "respawn")
    given = {name: LaunchConfiguration(name).perform(context) for name in names}
    respawn = given.pop("respawn") == "true"
    overrides = {
        name: value == "true" if name in ("use_sim_time", "autostart") else value
        for name, value in given.items()
        if value
    }
    return [
        Node(
            package="dynssm_ros",
            executable="predictor",
            name="dynssm",
            namespace=LaunchConfiguration("namespace"),
            parameters=[LaunchConfiguration("params_file"), overrides],
            ros_arguments=["--log-level", LaunchConfiguration("log_level")],
            respawn=respawn,
            respawn_delay=1.0,
            output="screen",
        )
    ]


def generate_launch_description() -> LaunchDescription:
    parameters = PathJoinSubstitution([FindPackageShare("dynssm_ros"), "config", "predictor.yaml"])
    return LaunchDescription(
        [
            DeclareLaunchArgument("model", default_value="", description="Model folder."),
            DeclareLaunchArgument("signals", default_value="", description="Shipped signal map or file."),
            DeclareLaunchArgument(
                "use_sim_time",
                default_value="",
                choices=["", "true", "false"],
                description="Follow /clock, as when a bag is played with it.",
            ),
            DeclareLaunchArgument(
                "autostart",
                default_value="",
                choices=["", "true", "false"],
                description="false: a manager of life cycles configures and activates the node.",
            ),
            DeclareLaunchArgument("params_file", default_value=parameters, description="ROS parameters file."),
            DeclareLaunchArgument("namespace", default_value="", description="Namespace of the node."),
            DeclareLaunchArgument(
                "respawn", default_value="false", choices=["true", "false"], description="Start a node that ended anew."
            ),
            DeclareLaunchArgument("log_level", default_value="info", description="debug, info, warn or error."),
            OpaqueFunction(function=predictor),
        ]
    )
