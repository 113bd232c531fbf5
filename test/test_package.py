"""What is installed is complete, consistent and valid: versions, dependencies, shared files, configuration."""

from __future__ import annotations

import ast
import importlib.util
import re
import sys
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import setuptools
import yaml

import dynssm_ros
from dynssm_ros.configuration import config_root
from dynssm_ros.extras import EXTRAS
from dynssm_ros.learning.models.registry import load_model_config
from dynssm_ros.runtime.artifact import model_folder, open_artifact, shipped_models
from dynssm_ros.runtime.registry import load_model
from dynssm_ros.signals.signal_map import load_signal_map
from dynssm_ros.vehicle.parameters import load_vehicle

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = "dynssm_ros"
PIP_NAMES = {
    "yaml": "pyyaml",
    "typing_extensions": "typing-extensions",
    "sklearn": "scikit-learn",
}
ROSDEP_KEYS = {
    "onnxruntime": "python3-onnxruntime-pip",
    "rosbags": "python3-rosbags-pip",
    "casadi": "casadi-pip",
    "mcap": "mcap-ros2-support",
}
FROM_ROS = ("rclpy", "_msgs", "_interfaces")  # of the ROS installation or the `ros` extra
NEEDED_BY_OTHERS = {"setuptools", "onnxscript"}  # by the console scripts; by torch's ONNX export


@pytest.fixture
def arguments(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """What setup.py passes to setuptools."""
    passed: dict[str, Any] = {}
    monkeypatch.setattr(setuptools, "setup", passed.update)
    monkeypatch.chdir(ROOT)
    execute(ROOT / "setup.py")
    return passed


@pytest.fixture(scope="module")
def manifest() -> ElementTree.Element:
    return ElementTree.parse(ROOT / "package.xml").getroot()


def execute(path: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location(path.name.partition(".")[0], path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def third_party_imports() -> set[str]:
    """Top-level modules that the package imports, its own and the standard library's left out."""
    found: set[str] = set()
    for path in (ROOT / PACKAGE).rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                found.update(alias.name.partition(".")[0] for alias in node.names)
            elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
                found.add(node.module.partition(".")[0])
    return found - sys.stdlib_module_names - {PACKAGE}


def requirements(arguments: dict[str, Any]) -> dict[str, str]:
    """Floor of every distribution that the core or an extra of users requires, by lower-case name; empty without one."""
    wanted = {*arguments["install_requires"], *arguments["extras_require"]["all"]}
    pairs = (requirement.partition(">=") for requirement in wanted if not requirement.startswith("ros-"))
    return {name.lower(): floor for name, _, floor in pairs}


def pip_only(manifest_text: str) -> set[str]:
    """The distributions that package.xml names as having no rosdep key."""
    match = re.search(r"without a rosdep key[^:]*: ([\w -]+?) -->", manifest_text)
    assert match is not None
    return set(match[1].split())


def shipped(kind: str) -> list[str]:
    return sorted(path.stem for path in (ROOT / "config" / kind).glob("*.yaml"))


def test_versions_agree(arguments: dict[str, Any], manifest: ElementTree.Element) -> None:
    assert arguments["version"] == manifest.findtext("version") == dynssm_ros.__version__


def test_setup_and_manifest_tell_the_same(arguments: dict[str, Any], manifest: ElementTree.Element) -> None:
    maintainer = manifest.find("maintainer")
    assert maintainer is not None
    assert arguments["name"] == manifest.findtext("name") == PACKAGE
    assert arguments["license"] == manifest.findtext("license")
    assert (arguments["maintainer"], arguments["maintainer_email"]) == (maintainer.text, maintainer.get("email"))
    assert manifest.findtext("export/build_type") == "ament_python"


def test_every_import_is_required_by_pip(arguments: dict[str, Any]) -> None:
    imported = {PIP_NAMES.get(name, name) for name in third_party_imports() if not name.endswith(FROM_ROS)}
    assert imported - requirements(arguments).keys() == set()


def test_nothing_is_required_that_is_not_used(arguments: dict[str, Any]) -> None:
    imported = {PIP_NAMES.get(name, name) for name in third_party_imports()}
    assert requirements(arguments).keys() - imported == NEEDED_BY_OTHERS


def test_every_import_is_declared_to_ros(manifest: ElementTree.Element) -> None:
    declared = {depend.text for depend in manifest.findall("exec_depend")}
    undeclared = pip_only((ROOT / "package.xml").read_text(encoding="utf-8"))
    for name in third_party_imports():
        key = name if name.endswith(FROM_ROS) else ROSDEP_KEYS.get(name, f"python3-{name.replace('_', '-')}")
        assert key in declared or PIP_NAMES.get(name, name) in undeclared, f"{name}: no {key} in package.xml"


def test_manifest_repeats_the_requirements(arguments: dict[str, Any], manifest: ElementTree.Element) -> None:
    modules = {distribution: module for module, distribution in PIP_NAMES.items()}
    keys = {
        ROSDEP_KEYS.get(name, f"python3-{modules.get(name, name).replace('_', '-')}"): floor
        for name, floor in requirements(arguments).items()
    }
    floors = {depend.text: depend.get("version_gte", "") for depend in manifest.findall("exec_depend")}
    undeclared = {f"python3-{name}" for name in pip_only((ROOT / "package.xml").read_text(encoding="utf-8"))}
    assert keys.keys() - floors.keys() == undeclared
    assert {key: floors[key] for key in keys.keys() & floors.keys()} == {
        key: floor for key, floor in keys.items() if key in floors
    }


def test_extras_hold_what_the_package_says_of_them(arguments: dict[str, Any]) -> None:
    for extra, libraries in EXTRAS.items():
        required = {re.split(r"[\[><=]", each)[0] for each in arguments["extras_require"][extra]}
        names = {f"ros-jazzy-{name}" if extra == "ros" else PIP_NAMES.get(name, name) for name in libraries}
        assert names <= required
    core = {re.split(r"[><=]", each)[0] for each in arguments["install_requires"]}
    assert not core & {"torch", "casadi", "matplotlib", "scipy", "onnx", "jinja2"}


def test_every_requirement_is_pinned(arguments: dict[str, Any]) -> None:
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    pinned = {line.partition("==")[0] for line in lines if "==" in line}
    wanted = [
        *arguments["install_requires"],
        *(item for extra in arguments["extras_require"].values() for item in extra),
    ]
    assert {re.split(r"[\[><=]", requirement)[0].lower() for requirement in wanted} - pinned == set()
    assert "torch==2.13.0" in lines


def test_every_shared_file_is_installed_where_the_package_looks(arguments: dict[str, Any]) -> None:
    installed = {
        f"{folder}/{Path(source).name}": source for folder, sources in arguments["data_files"] for source in sources
    }
    expected = {
        f"share/{PACKAGE}/{path.relative_to(ROOT).as_posix()}": path.relative_to(ROOT).as_posix()
        for folder in ("config", "launch")
        for path in (ROOT / folder).rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    expected[f"share/{PACKAGE}/package.xml"] = "package.xml"
    expected[f"share/ament_index/resource_index/packages/{PACKAGE}"] = f"resource/{PACKAGE}"
    assert installed == expected


def test_every_module_and_template_is_installed(arguments: dict[str, Any]) -> None:
    folders = {path.parent.relative_to(ROOT).as_posix() for path in (ROOT / PACKAGE).rglob("*.py")}
    assert {package.replace(".", "/") for package in arguments["packages"]} == folders
    patterns = arguments["package_data"][PACKAGE]
    data = {path for pattern in patterns for path in (ROOT / PACKAGE).glob(pattern)}
    others = {
        path for path in (ROOT / PACKAGE).rglob("*") if path.is_file() and path.suffix not in (".py", ".pyc", ".so")
    }
    assert data == others


def test_commands_lead_to_functions(arguments: dict[str, Any]) -> None:
    targets = dict(script.split(" = ") for script in arguments["entry_points"]["console_scripts"])
    assert targets.keys() == {"dynssm", "predictor", "player", "simulator", "controller"}
    for target in targets.values():
        module, _, function = target.partition(":")
        path = (ROOT / module.replace(".", "/")).with_suffix(".py")
        tree = ast.parse(path.read_text(encoding="utf-8"))
        assert function in {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}


def test_configuration_is_found_in_the_source_tree() -> None:
    assert config_root() == ROOT / "config"


@pytest.mark.parametrize("name", shipped("vehicles"))
def test_shipped_vehicles_are_valid(name: str) -> None:
    assert load_vehicle(name).name


@pytest.mark.parametrize("name", shipped("signals"))
def test_shipped_signal_maps_are_valid(name: str) -> None:
    assert load_signal_map(name).name == name


@pytest.mark.parametrize("name", shipped("models"))
def test_shipped_models_are_valid(name: str) -> None:
    assert load_model_config(name).name == name


def test_shipped_model_folders_open_by_name_and_are_small() -> None:
    for name in (found := shipped_models()):
        artifact = open_artifact(name)
        assert artifact.card.name == name
        assert load_model(name).online is not None
        assert sum(path.stat().st_size for path in artifact.path.iterdir()) < 100_000
    assert found
    assert model_folder("nothing") == Path("nothing")
    assert model_folder(Path("here") / next(iter(found))) == Path("here") / next(iter(found)), "a path is no name"


# what the policy files of SROS 2 consist of: the parts of an element, and its attributes
POLICY = {
    "policy": (["enclaves"], ["version"]),
    "enclaves": (["enclave"], []),
    "enclave": (["profiles"], ["path"]),
    "profiles": (["profile"], []),
    "profile": (["topics", "services", "actions"], ["ns", "node"]),
    "topics": (["topic"], ["publish", "subscribe"]),
    "services": (["service"], ["reply", "request"]),
    "actions": (["action"], ["call", "execute"]),
}  # fmt: skip


def test_the_security_policy_is_one_of_sros_2_and_its_player_publishes_the_default_topics() -> None:
    root = ElementTree.parse(ROOT / "config" / "sros2" / "policy.xml").getroot()
    assert (root.tag, root.get("version")) == ("policy", "0.2.0")
    for element in root.iter():
        parts, attributes = POLICY.get(element.tag, ([], []))
        assert {part.tag for part in element} <= set(parts), element.tag
        if element.tag in ("topics", "services", "actions"):  # one kind of use each
            assert len(element.attrib) == 1
            assert set(element.attrib.values()) <= {"ALLOW", "DENY"}
            assert element.attrib.keys() <= set(attributes)
        else:
            assert list(element.attrib) == attributes, element.tag
        if element.tag not in POLICY:
            assert re.fullmatch(r"(/|~/)?[A-Za-z]\w*(/[A-Za-z]\w*)*", element.text or ""), element.text
    (player,) = (profile for profile in root.iter("profile") if profile.get("node") == "player")
    published = {topic.text for topic in player.iterfind("topics[@publish]/topic")}
    recorded = {source.recorded.removeprefix("/") for source in load_signal_map("default").signals.values()}
    assert published == recorded | {"/clock", "/parameter_events", "/rosout"}


MUST_BE_SET = {"predictor": "model", "player": "bag"}
"""Parameters without a usable default. A shipped file leaves them out: it would reset what was said before it."""
NAMES = {"predictor": "dynssm", "controller": "controller", "simulator": "simulator", "player": "player"}


def parameters_file(node: str) -> dict[str, object]:
    """What a shipped parameters file says, of its node alone."""
    content = yaml.safe_load((ROOT / "config" / f"{node}.yaml").read_text(encoding="utf-8"))
    assert list(content) == [f"/**/{NAMES[node]}"], "a launch file hands one file to several nodes"
    return content[f"/**/{NAMES[node]}"]["ros__parameters"]


@pytest.mark.parametrize("node", ["predictor", "controller", "simulator", "player"])
def test_each_node_has_a_parameters_file_with_its_defaults(
    declared_parameters: Callable[[str], dict[str, object]], node: str
) -> None:
    content = parameters_file(node)
    declared = declared_parameters(node)
    if (needed := MUST_BE_SET.get(node)) is not None:
        assert declared.pop(needed) == ""
        assert f"    # {needed}: " in (ROOT / "config" / f"{node}.yaml").read_text(encoding="utf-8"), (
            "explained all the same"
        )
    assert content == declared
    assert {name: type(value) for name, value in content.items()} == {n: type(v) for n, v in declared.items()}


def test_the_aggregator_takes_the_status_of_each_node_once() -> None:
    content = yaml.safe_load((ROOT / "config" / "aggregator.yaml").read_text(encoding="utf-8"))
    analyzers = [a for a in content["analyzers"]["ros__parameters"].values() if isinstance(a, dict)]
    said = {}
    for file in sorted((ROOT / "dynssm_ros" / "nodes").glob("*.py")):
        source = file.read_text(encoding="utf-8")
        node, part = (
            re.search(pattern, source) for pattern in (r'super\(\).__init__\("(\w+)"', r'diagnostics\(\s*self, "(\w+)"')
        )
        if node and part:
            said[file.stem] = f"/car1/{node[1]}: {part[1]}"  # as nodes/support.py writes it
    assert set(said) == {"controller", "predictor", "simulator"}
    for status in said.values():
        assert len([a for a in analyzers if any(part in status for part in a["contains"])]) == 1, status
    assert {a["type"] for a in analyzers} == {"diagnostic_aggregator/GenericAnalyzer"}


@pytest.mark.parametrize("node", NAMES)
@pytest.mark.parametrize("namespace", ["", "car1"])
def test_of_all_parameters_files_a_node_takes_its_own_alone(
    monkeypatch: pytest.MonkeyPatch, node: str, namespace: str
) -> None:
    """The same parser as the node's reads them, in any namespace, with the types that the node declares."""
    rclpy = pytest.importorskip("rclpy")
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "OFF")
    files = [part for each in NAMES for part in ("--params-file", str(ROOT / "config" / f"{each}.yaml"))]
    context, expected = rclpy.Context(), parameters_file(node)
    rclpy.init(args=["--ros-args", *files], context=context)
    try:
        options = {"namespace": namespace, "automatically_declare_parameters_from_overrides": True}
        made = rclpy.create_node(NAMES[node], context=context, **options)
        read = {name: parameter.value for name, parameter in made.get_parameters_by_prefix("").items()}
        made.destroy_node()
    finally:
        context.try_shutdown()
    of_every_node = ("use_sim_time", "start_type_description_service")
    read = {name: list(v) if name.endswith("noise") else v for name, v in read.items() if name not in of_every_node}
    assert read == expected
    assert {name: type(value) for name, value in read.items()} == {name: type(v) for name, v in expected.items()}


@pytest.mark.parametrize("node", MUST_BE_SET)
@pytest.mark.parametrize("first", [True, False])
def test_a_shipped_file_resets_nothing_that_must_be_set(
    monkeypatch: pytest.MonkeyPatch, node: str, first: bool
) -> None:
    rclpy = pytest.importorskip("rclpy")
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "OFF")
    said, file = ["-p", f"{MUST_BE_SET[node]}:=mine"], ["--params-file", str(ROOT / "config" / f"{node}.yaml")]
    context = rclpy.Context()
    rclpy.init(args=["--ros-args", *(said + file if first else file + said)], context=context)
    try:
        made = rclpy.create_node(NAMES[node], context=context, automatically_declare_parameters_from_overrides=True)
        assert made.get_parameter(MUST_BE_SET[node]).value == "mine"
        made.destroy_node()
    finally:
        context.try_shutdown()
