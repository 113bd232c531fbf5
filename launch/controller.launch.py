"""Drives laps end to end: ``ros2 launch dynssm_ros controller.launch.py model:=MODEL_DIR track:=club``.

Starts the controller, the simulated car (``simulator:=false`` where there is a real one), and the predictor if it is given
a model.
"""

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

ARGUMENTS = {  # name: default, description, nodes that take it as a parameter
    "vehicle": ("orca", "Vehicle: shipped name or file.", ("controller", "simulator")),
    "track": ("club", "Track: built-in name or CSV file.", ("controller", "simulator")),
    "scale": ("1.0", "Size of the track.", ("controller", "simulator")),
    "rate": ("1.0", "Speed of the simulated car's time over real time.", ("controller", "simulator")),
    "line": ("racing", "What is followed: centre, racing or a file with speeds.", ("controller",)),
    "speed_scale": ("0.9", "Share of the car's limits in the line's speed.", ("controller",)),
    "objective": ("tracking", "tracking or progress.", ("controller",)),
    "plant": ("euler", "How the car is simulated: euler, rk4 or double_track.", ("simulator",)),
    "effects": ("", "Physics that only the simulated car has: NAME[:k=v,...], apart by blanks.", ("simulator",)),
    "model": ("", "Model folder; without one no predictor is started.", ("predictor",)),
}
NUMBERS = ("scale", "rate", "speed_scale")


def stack(context: LaunchContext) -> list[Node]:
    given = {name: LaunchConfiguration(name).perform(context) for name in (*ARGUMENTS, "simulator")}
    names = {"controller": "controller"}
    if given["simulator"] == "true":
        names["simulator"] = "simulator"
    if given["model"]:
        names["predictor"] = "dynssm"
    return [
        Node(
            package="dynssm_ros",
            executable=executable,
            name=name,
            namesspeed_scale=LaunchConfiguration("namesspeed_scale"),
            parameters=[_parameters(executable, given)],
            ros_arguments=["--log-level", LaunchConfiguration("log_level")],
            output="screen",
        )
        for executable, name in names.items()
    ]


def _parameters(executable: str, given: dict[str, str]) -> dict[str, str | float]:
    values: dict[str, str | float] = {
        name: float(given[name]) if name in NUMBERS else given[name]
        for name, (_, _, nodes) in ARGUMENTS.items()
        if executable in nodes
    }
    return values | ({"driver": "external"} if executable == "simulator" else {})


def generate_launch_description() -> LaunchDescription:
    return LaunchDescription(
        [
            *(
                DeclareLaunchArgument(name, default_value=default, description=description)
                for name, (default, description, _) in ARGUMENTS.items()
            ),
            DeclareLaunchArgument(
                "simulator", default_value="true", choices=["true", "false"], description="Start the simulated car."
            ),
            DeclareLaunchArgument("namesspeed_scale", default_value="", description="Namesspeed_scale of the nodes."),
            DeclareLaunchArgument("log_level", default_value="info", description="debug, info, warn or error."),
            OpaqueFunction(function=stack),
        ]
    )
