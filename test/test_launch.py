"""The launch files start the nodes that are asked for, with parameters that these have."""

from __future__ import annotations

import runpy
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parent.parent


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
