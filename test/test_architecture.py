"""The house keeps its floors: imports run downwards, and heavy libraries stay in their rooms."""

from __future__ import annotations

import ast
import graphlib
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

PACKAGE = "dynssm_ros"
ROOT = Path(__file__).resolve().parent.parent

FLOORS = (  # lowest first; a room imports itself and the floors below, never another room of its own floor
    {"vehicle"},
    {"signals"},
    {"track"},
    {"runtime", "simulation"},
    {"identification", "learning"},
    {"control", "evaluation"},
    {"reporting", "nodes"},
    {"api"},
    {"cli"},
)
FLOOR = {room: level for level, rooms in enumerate(FLOORS) for room in rooms}
GROUND = {
    "arrays",
    "compiled",
    "configuration",
    "errors",
    "extras",
    "files",
    "parallel",
    "progress",
}  # for all rooms, so they import none
TOP = {"__init__"}  # the names of the Python API

ROS = {
    "builtin_interfaces", "diagnostic_msgs", "geometry_msgs", "launch", "launch_ros", "nav_msgs",
    "rcl_interfaces", "rclpy", "rosgraph_msgs", "sensor_msgs", "std_msgs", "trajectory_msgs",
}  # fmt: skip
OWNERS = {
    "torch": {"learning"}, "casadi": {"control"}, "matplotlib": {"reporting"}, "plotly": {"reporting"},
    "jinja2": {"reporting"}, "joblib": {"parallel"}, "ray": {"parallel"}, "distributed": {"parallel"},
    "optuna": {"evaluation"}, "sklearn": {"identification", "evaluation"}, "typer": {"cli"}, "rich": {"cli", "reporting"},
}  # fmt: skip
OWNERS |= {module: {"nodes"} for module in ROS}
MOST_BY_POSITION, LONGEST_FILE = 5, 450
LOOKED_UP = {
    f"is_{kind}" for kind in ("file", "dir", "symlink", "fifo", "socket", "mount", "block_device", "char_device")
}


def imports(source: str, module: str, is_package: bool = False) -> Iterator[tuple[str, int]]:
    """Yields the absolute dotted name and the line of every import, wherever it stands."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            yield from ((alias.name, node.lineno) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = module.split(".")
            base = base[: len(base) - node.level + is_package] if node.level else []
            origin = ".".join([*base, *([node.module] if node.module else [])])
            yield from ((f"{origin}.{alias.name}", node.lineno) for alias in node.names)


def floor_of(module: str) -> int:
    """The floor of a module; those beside the rooms are below all, the package itself is above them."""
    room = [*module.split("."), "__init__"][1]
    if room in TOP:
        return FLOOR["cli"]
    return FLOOR.get(room, -1)


def violations(source: str, module: str, is_package: bool = False) -> list[str]:
    """What ``source``, as the text of ``module``, imports against the rules; one line each."""
    parts = module.split(".")
    room = parts[1] if len(parts) > 1 else ""
    found = []
    for name, line in imports(source, module, is_package):
        top, _, rest = name.partition(".")
        other = rest.split(".")[0]
        where = f"{module}:{line}: imports {name}"
        if top == PACKAGE and other in FLOOR and other != room and FLOOR[other] >= floor_of(module):
            found.append(f"{where}, which is not on a floor below {room or PACKAGE}")
        if room not in OWNERS.get(top, {room}):
            found.append(f"{where} outside {' and '.join(sorted(OWNERS[top]))}")
    return found


def modules() -> Iterator[tuple[str, Path]]:
    """Yields every module of the package by dotted name."""
    for path in sorted((ROOT / PACKAGE).rglob("*.py")):
        parts = path.relative_to(ROOT).with_suffix("").parts
        yield ".".join(parts[:-1] if parts[-1] == "__init__" else parts), path


def test_every_room_has_a_floor() -> None:
    rooms = {path.parent.name for path in (ROOT / PACKAGE).glob("*/__init__.py")}
    assert rooms <= FLOOR.keys()
    assert {path.stem for path in (ROOT / PACKAGE).glob("*.py")} == GROUND | TOP


def test_imports_run_downwards_and_stay_in_their_rooms() -> None:
    found = [
        violation
        for module, path in modules()
        for violation in violations(path.read_text(encoding="utf-8"), module, path.name == "__init__.py")
    ]
    assert not found, "\n".join(found)


@pytest.mark.parametrize(
    ("module", "source"),
    [
        ("dynssm_ros.vehicle.effects", "import dynssm_ros.signals.bags"),
        ("dynssm_ros.vehicle.effects", "from dynssm_ros import signals"),
        ("dynssm_ros.vehicle.effects", "from ..signals import bags"),
        ("dynssm_ros.vehicle.effects", "from .. import signals"),
        ("dynssm_ros.runtime.predictor", "def f():\n    from dynssm_ros.nodes import predictor"),
        ("dynssm_ros.files", "from dynssm_ros.vehicle import Vehicle"),
        ("dynssm_ros.files", "from .vehicle import Vehicle"),
        ("dynssm_ros.runtime.contract", "import torch"),
        ("dynssm_ros.runtime.contract", "def f():\n    from torch import nn"),
        ("dynssm_ros.cli.train", "def train():\n    import torch"),
        ("dynssm_ros.signals.bags", "from nav_msgs.msg import Odometry"),
        ("dynssm_ros.cli.replay", "import rclpy"),
        ("dynssm_ros.simulation.plant", "import casadi as ca"),
        ("dynssm_ros.errors", "import torch.nn"),
        ("dynssm_ros.learning.stages", "from dynssm_ros.identification import problem"),
        ("dynssm_ros.evaluation.metrics", "import matplotlib.pyplot as plt"),
        ("dynssm_ros.control.live", "def f():\n    from dynssm_ros.reporting import tables"),
        ("dynssm_ros.api", "from dynssm_ros.cli import main"),
    ],
)
def test_a_planted_violation_is_caught(module: str, source: str) -> None:
    assert len(violations(source, module)) == 1


@pytest.mark.parametrize(
    ("module", "source"),
    [
        ("dynssm_ros.signals.bags", "from dynssm_ros.vehicle import Vehicle"),
        ("dynssm_ros.signals.bags", "from . import messages"),
        ("dynssm_ros.cli.main", "from dynssm_ros import __version__\nfrom ..nodes import predictor"),
        ("dynssm_ros.learning.stages", "import torch"),
        ("dynssm_ros.nodes.predictor", "import rclpy\nfrom nav_msgs.msg import Odometry"),
        ("dynssm_ros.cli.train", "def train():\n    from dynssm_ros.learning import training"),
    ],
)
def test_what_the_architecture_allows_passes(module: str, source: str) -> None:
    assert violations(source, module) == []


def test_a_package_resolves_relative_imports_from_itself() -> None:
    assert [name for name, _ in imports("from .bags import Bag", "dynssm_ros.signals", is_package=True)] == [
        "dynssm_ros.signals.bags.Bag"
    ]


def test_no_room_but_learning_pulls_in_torch() -> None:
    """The live node and the command line start without torch, also through what they import."""
    wanted = [name for name, _ in modules() if name.split(".")[1:2] != ["learning"]]
    script = f"""
import importlib, importlib.util, sys
for name in {wanted!r}:
    if name.startswith("dynssm_ros.nodes") and importlib.util.find_spec("rclpy") is None:
        continue
    importlib.import_module(name)
    assert "torch" not in sys.modules, f"importing {{name}} imports torch"
"""
    result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, cwd=ROOT, check=False)
    assert result.returncode == 0, result.stderr


def test_identification_poses_then_searches_then_reports() -> None:
    order = ("problem", "search", "result")
    for module, path in modules():
        parts = module.split(".")[1:]
        if parts[:1] == ["identification"] and len(parts) > 2:
            above = order[order.index(parts[1]) + 1 :]
            prefixes = tuple(f"{PACKAGE}.identification.{room}" for room in above)
            assert not [
                name for name, _ in imports(path.read_text(encoding="utf-8"), module) if name.startswith(prefixes)
            ]


def test_no_file_is_in_a_circle_of_imports() -> None:
    """Counted is every import, wherever it stands, but not that of the version from the package itself."""
    paths = dict(modules())
    graph: dict[str, set[str]] = {}
    for module, path in paths.items():
        named = {name for name, _ in imports(path.read_text(encoding="utf-8"), module, path.name == "__init__.py")}
        meant = {name if name in paths else name.rpartition(".")[0] for name in named}
        graph[module] = (meant & paths.keys()) - {module, PACKAGE}
    assert {*graphlib.TopologicalSorter(graph).static_order()} == paths.keys() | {PACKAGE}


def looked_up(source: str) -> list[str]:
    """Where a path is asked with its own methods what it is; in contrast to os.path's they raise where they may not look."""
    return [
        f"{node.func.attr}() in line {node.lineno}"
        for node in ast.walk(ast.parse(source))
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute)
        if (node.func.attr == "exists" and ast.unparse(node.func.value) != "os.path") or node.func.attr in LOOKED_UP
    ]  # fmt: skip


def test_what_a_path_is_never_raises() -> None:
    """Names of more than 255 letters, links in a circle and folders that may not be entered are nothing."""
    found = [f"{path}: {each}" for _, path in modules() for each in looked_up(path.read_text("utf-8"))]
    assert not found, "\n".join(found)
    assert looked_up("Path(x).is_dir()\npath.parent.exists()\nos.path.exists(x)\nos.path.isfile(x)") == [
        "is_dir() in line 1",
        "exists() in line 2",
    ]


def by_position(function: ast.FunctionDef | ast.AsyncFunctionDef, in_class: bool) -> int:
    """Parameters that a call may give by position, ``self`` and ``cls`` left out."""
    names = [each.arg for each in (*function.args.posonlyargs, *function.args.args)]
    return len(names) - (in_class and names[:1] in (["self"], ["cls"]))


def with_many_by_position(source: str) -> list[str]:
    """Public functions and methods with more than ``MOST_BY_POSITION`` parameters by position."""
    found: list[str] = []

    def walk(node: ast.AST, in_class: bool) -> None:
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.ClassDef) and not child.name.startswith("_"):
                walk(child, True)
            elif isinstance(child, (ast.FunctionDef, ast.AsyncFunctionDef)):
                public = child.name == "__init__" or not child.name.startswith("_")
                if public and by_position(child, in_class) > MOST_BY_POSITION:
                    found.append(f"{child.name} in line {child.lineno}")

    walk(ast.parse(source), False)
    return found


def test_what_comes_after_the_inputs_is_given_by_name() -> None:
    found = [f"{path}: {each}" for _, path in modules() for each in with_many_by_position(path.read_text("utf-8"))]
    assert not found, "\n".join(found)


def test_many_parameters_by_position_are_caught() -> None:
    assert with_many_by_position("def f(a, b, c, d, e, g): ...\nclass A:\n    def m(self, a, b, c, d, e, f): ...")
    assert not with_many_by_position("def f(a, b, c, d, e, *, g): ...\nclass A:\n    def m(self, a, b, c, d, e): ...")
    assert not with_many_by_position("def _f(a, b, c, d, e, g): ...")


def test_files_are_no_longer_than_a_reader_holds() -> None:
    long = [str(path) for _, path in modules() if path.read_text("utf-8").count("\n") > LONGEST_FILE]
    assert not long, "\n".join(long)
