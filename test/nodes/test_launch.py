"""The launch files start the nodes that are asked for, with parameters that these have."""

from __future__ import annotations

import os
import runpy
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest
import yaml
from rcl_interfaces.srv import GetParameters
from rclpy.parameter import parameter_value_to_python

from benchmarks.endurance.live_run import LiveRun, collecting, isolated_environment, node_process

ROOT = Path(__file__).resolve().parents[2]
ros2_is_there = pytest.mark.skipif(
    shutil.which("ros2") is None, reason="no ros2 on the path: source a ROS installation"
)


class Recorder:
    """Stands for a class of launch or launch_ros: keeps what it was made with.

    ``launch`` is not among the wheels, so this checks the structure of the launch file, not that it runs.
    """

    def __init__(self, *positional: Any, **named: Any) -> None:
        self.positional, self.named = positional, named

    def perform(self, context: SimpleNamespace) -> str:
        """As of a LaunchConfiguration."""
        return context.launch_configurations[self.positional[0]]


class NodeRecorder(Recorder):
    """A launch_ros Node, which refuses arguments that it does not have."""

    ARGUMENTS = (
        "package", "executable", "name", "namespace", "parameters", "remappings", "ros_arguments", "arguments", "output",
        "respawn", "respawn_delay",
    )  # fmt: skip

    def __init__(self, **named: Any) -> None:
        assert set(named) <= set(self.ARGUMENTS), named
        super().__init__(**named)


@pytest.fixture
def load_launch(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], SimpleNamespace]:
    """Loads a launch file over recording stand-ins of launch and launch_ros."""
    names = {
        "launch": ["LaunchContext", "LaunchDescription"],
        "launch.actions": ["DeclareLaunchArgument", "OpaqueFunction"],
        "launch.substitutions": ["LaunchConfiguration", "PathJoinSubstitution"],
        "launch_ros": [],
        "launch_ros.actions": ["Node"],
        "launch_ros.substitutions": ["FindPackageShare"],
    }
    for module_name, classes in names.items():
        module = ModuleType(module_name)
        for name in classes:
            setattr(module, name, type(name, (NodeRecorder if name == "Node" else Recorder,), {}))
        monkeypatch.setitem(sys.modules, module_name, module)
    return lambda name: SimpleNamespace(**runpy.run_path(str(ROOT / "launch" / name)))


@pytest.fixture
def launch_file(load_launch: Callable[[str], SimpleNamespace]) -> SimpleNamespace:
    return load_launch("predictor.launch.py")


def all_launched(launch_file: SimpleNamespace, **given: str) -> list[Recorder]:
    """The nodes that the launch file starts when these arguments are given."""
    *declared, function = launch_file.generate_launch_description().positional[0]
    values = {argument.positional[0]: argument.named["default_value"] for argument in declared}
    return function.named["function"](SimpleNamespace(launch_configurations=values | given))


def launched(launch_file: SimpleNamespace, **given: str) -> Recorder:
    (node,) = all_launched(launch_file, **given)
    return node


def test_launch_file_declares_described_arguments(launch_file: SimpleNamespace) -> None:
    *declared, function = launch_file.generate_launch_description().positional[0]
    assert [argument.positional for argument in declared] == [
        ("model",), ("signals",), ("use_sim_time",), ("autostart",), ("params_file",), ("namespace",), ("respawn",),
        ("log_level",),
    ]  # fmt: skip
    assert all(argument.named["description"] for argument in declared)
    assert type(function).__name__ == "OpaqueFunction"
    default = declared[4].named["default_value"].positional[0]
    assert default[0].positional == ("dynssm_ros",)
    assert ROOT.joinpath(*default[1:]).is_file()


def test_launch_file_starts_the_predictor_with_the_parameters_file(launch_file: SimpleNamespace) -> None:
    node = launched(launch_file).named
    assert (node["package"], node["executable"], node["name"]) == ("dynssm_ros", "predictor", "dynssm")
    parameters, overrides = node["parameters"]
    assert parameters.positional == ("params_file",)
    assert node["namespace"].positional == ("namespace",)
    assert [item if isinstance(item, str) else item.positional for item in node["ros_arguments"]] == [
        "--log-level",
        ("log_level",),
    ]
    assert overrides == {}, "an argument that is not given must not hide the parameters file"


def test_launch_arguments_override_the_parameters_file(launch_file: SimpleNamespace) -> None:
    node = launched(launch_file, model="out/model", signals="av21", use_sim_time="true").named
    assert node["parameters"][1] == {"model": "out/model", "signals": "av21", "use_sim_time": True}
    assert launched(launch_file, use_sim_time="false").named["parameters"][1] == {"use_sim_time": False}


def test_controller_launch_file_starts_the_stack_that_is_asked_for(
    load_launch: Callable[[str], SimpleNamespace],
) -> None:
    file = load_launch("controller.launch.py")
    *declared, _ = file.generate_launch_description().positional[0]
    assert all(argument.named["description"] for argument in declared)
    choices = {argument.positional[0]: argument.named.get("choices") for argument in declared}
    for switch in ("use_sim_time", "autostart", "lockstep"):
        assert choices[switch] == ["", "true", "false"], "True must not be taken for false"
    nodes = {node.named["executable"]: node.named for node in all_launched(file, model="out/model", speed_scale="0.7")}
    assert {name: node["name"] for name, node in nodes.items()} == {
        "controller": "controller",
        "simulator": "simulator",
        "predictor": "dynssm",
    }
    assert nodes["predictor"]["parameters"] == [{"model": "out/model"}]
    assert nodes["simulator"]["parameters"][0]["driver"] == "external"
    assert nodes["controller"]["parameters"][0]["speed_scale"] == 0.7
    held = {node.named["executable"]: node.named["parameters"][-1] for node in all_launched(file, lockstep="true")}
    assert held["simulator"]["lockstep"] is True
    assert "lockstep" not in held["controller"]
    with pytest.raises(RuntimeError, match='"scale": "big", expected a number'):
        all_launched(file, scale="big")
    (alone,) = all_launched(file, simulator="false")
    assert alone.named["executable"] == "controller"


def test_controller_launch_file_passes_only_parameters_that_there_are(
    load_launch: Callable[[str], SimpleNamespace], declared_parameters: Callable[[str], dict[str, object]]
) -> None:
    for node in all_launched(load_launch("controller.launch.py"), model="out/model"):
        known = declared_parameters(node.named["executable"])
        assert set(node.named["parameters"][0]) <= {"driver", "model"}, "what is left empty overrides nothing"
        for name, value in node.named["parameters"][0].items():
            assert type(value) is type(known[name]), name


def test_controller_launch_file_has_namespace_parameters_file_time_and_respawn(
    load_launch: Callable[[str], SimpleNamespace],
) -> None:
    given = {"params_file": "mine.yaml", "use_sim_time": "true", "autostart": "false", "respawn": "true", "rate": "0.5"}
    for node in all_launched(load_launch("controller.launch.py"), model="out/model", **given):
        assert node.named["namespace"].positional == ("namespace",)
        assert node.named["respawn"] is True
        file, parameters = node.named["parameters"]
        assert file == "mine.yaml"
        assert parameters["use_sim_time"] is True
        assert parameters.get("autostart", False) is False
        assert ("autostart" in parameters) == (node.named["executable"] != "simulator")
        if node.named["executable"] != "predictor":
            assert parameters["rate"] == 0.5


@contextmanager
def started(commands: list[list[str]]) -> Iterator[None]:
    """Runs processes; interrupts them in the end, on which nodes must end well."""
    with ExitStack() as stack:
        processes = [stack.enter_context(subprocess.Popen(command)) for command in commands]
        try:
            yield
        finally:
            for process in processes:
                process.send_signal(signal.SIGINT)
            codes = {process.args[0]: process.wait(30.0) for process in processes}
    assert not codes.get(sys.executable), codes


def command_line(node: Recorder, given: dict[str, str], folder: Path) -> list[str]:
    """As launch_ros's Node makes it: files of parameters in order, those of the launch file under the node's full name."""
    named = node.named
    namespace = f"/{given['namespace']}"
    command = [sys.executable, "-m", f"dynssm_ros.nodes.{named['executable']}", "--ros-args", "--log-level", "info"]
    command += ["--ros-args", "-r", f"__node:={named['name']}", "-r", f"__ns:={namespace}"]
    for each in named["parameters"]:
        path = given["params_file"]
        if isinstance(each, dict):
            path = str(folder / f"{named['name']}.yaml")
            Path(path).write_text(yaml.dump({f"{namespace}/{named['name']}": {"ros__parameters": each}}))
        command += ["--params-file", path]
    return command


def installed(folder: Path) -> dict[str, str]:
    """An environment whose ament index knows the package: its executables are those of this interpreter."""
    (folder / "share/ament_index/resource_index/packages").mkdir(parents=True)
    (folder / "share/ament_index/resource_index/packages/dynssm_ros").touch()
    (folder / "share/dynssm_ros").symlink_to(ROOT)
    (folder / "lib").mkdir()
    (folder / "lib/dynssm_ros").symlink_to(Path(sys.executable).parent)
    return os.environ | {"AMENT_PREFIX_PATH": f"{folder}:{os.environ.get('AMENT_PREFIX_PATH', '')}"}


@pytest.mark.live
@pytest.mark.slow
@pytest.mark.timeout(240)
@pytest.mark.parametrize("tool", ["command lines", pytest.param("ros2 launch", marks=ros2_is_there)])
def test_parameters_reach_every_node_of_the_stack(
    tool: str, load_launch: Callable[[str], SimpleNamespace], call_service: Callable[..., Any],
    monkeypatch: pytest.MonkeyPatch, small_model: Path, tmp_path: Path,
) -> None:  # fmt: skip
    """A file for all three nodes, what the launch file's arguments override, and a namespace."""
    for name, value in isolated_environment().items():
        monkeypatch.setenv(name, value)
    file = tmp_path / "mine.yaml"
    mine = {"dynssm": {"max_age": 0.3, "model": "none"}, "controller": {"max_late": 0.4, "scale": 9.0},
            "simulator": {"noise": [0.1, 0.0, 0.0], "driver": "pure_pursuit"}}  # fmt: skip
    file.write_text(yaml.dump({f"/**/{node}": {"ros__parameters": values} for node, values in mine.items()}))
    given = {"model": str(small_model), "scale": "1", "rate": "0.5", "vehicle": "orca", "autostart": "false",
             "use_sim_time": "false", "namespace": "car1", "params_file": str(file)}  # fmt: skip
    expected = {
        "dynssm": {"max_age": 0.3, "model": str(small_model), "autostart": False, "use_sim_time": False},
        "controller": {"max_late": 0.4, "scale": 1.0, "rate": 0.5, "vehicle": "orca", "autostart": False},
        "simulator": {"noise": [0.1, 0.0, 0.0], "driver": "external", "rate": 0.5, "use_sim_time": False},
    }
    path = ROOT / "launch" / "controller.launch.py"
    if tool == "ros2 launch":
        monkeypatch.setenv("AMENT_PREFIX_PATH", installed(tmp_path / "prefix")["AMENT_PREFIX_PATH"])
        commands = [
            ["ros2", "launch", "--noninteractive", str(path), *(f"{name}:={value}" for name, value in given.items())]
        ]
    else:
        commands = [command_line(node, given, tmp_path) for node in all_launched(load_launch(path.name), **given)]
    with started(commands), collecting(LiveRun(20_000_000)) as collector:
        for node, values in expected.items():
            answer = call_service(collector, GetParameters, f"/car1/{node}/get_parameters", names=list(values))
            got = dict(zip(values, map(parameter_value_to_python, answer.values), strict=True))
            assert got | {"noise": list(got.get("noise", ()))} == {"noise": []} | values, node


@ros2_is_there
@pytest.mark.live
@pytest.mark.slow
@pytest.mark.timeout(240)
def test_ros2_commands_understand_the_predictor(monkeypatch: pytest.MonkeyPatch, small_model: Path) -> None:
    for name, value in isolated_environment().items():
        monkeypatch.setenv(name, value)

    def ros2(*words: str) -> str:
        found = ("--no-daemon", "--spin-time", "5")
        return subprocess.run(["ros2", *words, *found], capture_output=True, text=True, check=True, timeout=60).stdout

    with node_process("predictor", {"model": small_model, "autostart": False}, os.environ.copy()):
        assert "/dynssm" in ros2("node", "list").splitlines()
        assert "unconfigured" in ros2("lifecycle", "get", "/dynssm")
        for transition, state in (("configure", "inactive"), ("activate", "active"), ("deactivate", "inactive")):
            assert "successful" in ros2("lifecycle", "set", "/dynssm", transition)
            assert state in ros2("lifecycle", "get", "/dynssm")
        assert "0.2" in ros2("param", "get", "/dynssm", "max_age")
        assert "successful" in ros2("param", "set", "/dynssm", "max_age", "0.3")
        assert "0.3" in ros2("param", "get", "/dynssm", "max_age")
        assert str(small_model) in ros2("param", "dump", "/dynssm")
        assert "nav_msgs/msg/Odometry" in ros2("topic", "info", "/dynssm/prediction")
        assert "/dynssm/prediction" in ros2("topic", "list")
        assert "/vehicle/odometry: nav_msgs/msg/Odometry" in ros2("node", "info", "/dynssm")
