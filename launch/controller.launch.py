"""Drives laps end to end: ``ros2 launch dynssm_ros controller.launch.py model:=MODEL_DIR track:=club``.

Starts the controller, the simulated car (``simulator:=false`` where there is a real one), and the predictor if it is given
a model. An argument that is left empty overrides neither the parameters file nor the node's own default.
"""

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

ARGUMENTS = {  # name: description, nodes that take it as a parameter
    "vehicle": ("Vehicle: shipped name or file.", ("controller", "simulator")),
    "track": ("Track: built-in name or CSV file.", ("controller", "simulator")),
    "scale": ("Size of the track.", ("controller", "simulator")),
    "rate": ("Speed of the simulated car's time over real time.", ("controller", "simulator")),
    "line": ("What is followed: centre, racing or a file with speeds.", ("controller",)),
    "speed_scale": ("Share of the car's limits in the line's speed.", ("controller",)),
    "objective": ("tracking or progress.", ("controller",)),
    "plant": ("How the car is simulated: euler, rk4 or double_track.", ("simulator",)),
    "effects": ("Physics that only the simulated car has: NAME[:k=v,...], apart by blanks.", ("simulator",)),
    "lockstep": ("true: the simulated car's time waits for the controller.", ("simulator",)),
    "model": ("Model folder; without one no predictor is started.", ("predictor",)),
    "use_sim_time": ("true: follow /clock, as when a bag is played with it.", ("controller", "simulator", "predictor")),
    "autostart": ("false: a manager of life cycles configures and activates the nodes.", ("controller", "predictor")),
}
SWITCHES = ("use_sim_time", "autostart", "lockstep")
NUMBERS = ("scale", "rate", "speed_scale")


def stack(context: LaunchContext) -> list[Node]:
    given = {
        name: LaunchConfiguration(name).perform(context) for name in (*ARGUMENTS, "simulator", "params_file", "respawn")
    }
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
            namespace=LaunchConfiguration("namespace"),
            parameters=[*([given["params_file"]] if given["params_file"] else []), _parameters(executable, given)],
            respawn=given["respawn"] == "true",
            respawn_delay=1.0,
            ros_arguments=["--log-level", LaunchConfiguration("log_level")],
            output="screen",
        )
        for executable, name in names.items()
    ]


def _parameters(executable: str, given: dict[str, str]) -> dict[str, str | float | bool]:
    values: dict[str, str | float | bool] = {
        name: _number(name, given[name]) if name in NUMBERS else given[name]
        for name, (_, nodes) in ARGUMENTS.items()
        if executable in nodes and given[name]
    }
    values |= {name: values[name] == "true" for name in SWITCHES if name in values}
    if executable == "controller" and given["lockstep"] == "true":
        values["max_late"] = 10.0  # the stamps of a car whose time waits fall behind
    return values | ({"driver": "external"} if executable == "simulator" else {})


def _number(name: str, text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise RuntimeError(f'argument "{name}": "{text}", expected a number') from None


def generate_launch_description() -> LaunchDescription:
    return LaunchDescription(
        [
            *(
                DeclareLaunchArgument(
                    name,
                    default_value="",
                    choices=["", "true", "false"] if name in SWITCHES else None,
                    description=description,
                )
                for name, (description, _) in ARGUMENTS.items()
            ),
            DeclareLaunchArgument(
                "simulator", default_value="true", choices=["true", "false"], description="Start the simulated car."
            ),
            DeclareLaunchArgument("params_file", default_value="", description="ROS parameters file of the nodes."),
            DeclareLaunchArgument("namespace", default_value="", description="Namespace of the nodes."),
            DeclareLaunchArgument(
                "respawn", default_value="false", choices=["true", "false"], description="Start a node that ended anew."
            ),
            DeclareLaunchArgument("log_level", default_value="info", description="debug, info, warn or error."),
            OpaqueFunction(function=stack),
        ]
    )
