"""What the README says is what the code does."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest
import yaml

from dynssm_ros.cli.main import app
from dynssm_ros.signals import messages
from dynssm_ros.signals.signal_map import SIGNALS, load_signal_map
from dynssm_ros.vehicle.effects import EFFECTS

ROOT = Path(__file__).resolve().parent.parent
README = (ROOT / "README.md").read_text(encoding="utf-8")


def table(head: str, text: str = README) -> dict[str, list[str]]:
    """The table of ``text`` whose first column is headed ``head``: cells by the code in the first cell."""
    lines = text.splitlines()
    start = next(k for k, line in enumerate(lines) if line.startswith(f"| {head} |"))
    rows = {}
    for line in lines[start + 2 :]:
        if not line.startswith("|"):
            break
        first, *rest = (cell.strip() for cell in line.strip("|").split("|"))
        rows[first.strip("`")] = rest
    return rows


def test_every_command_is_described_and_every_described_one_exists() -> None:
    described = {name.removeprefix("dynssm ") for name in table("command")}
    registered = {command.callback.__name__ for command in app.registered_commands if command.callback}
    assert described == registered


def declared_parameters(node: str) -> dict[str, object]:
    """What a node declares: default values by name."""
    tree = ast.parse((ROOT / "dynssm_ros" / "nodes" / f"{node}.py").read_text(encoding="utf-8"))
    return {
        call.args[1].value: call.args[2].value
        for call in ast.walk(tree)
        if isinstance(call, ast.Call) and ast.unparse(call.func) in ("describe", "choose")
        if isinstance(call.args[1], ast.Constant) and isinstance(call.args[2], ast.Constant)
    }


def test_the_parameters_of_the_node_are_those_of_the_table_and_of_the_shipped_file() -> None:
    declared = declared_parameters("predictor")
    assert {name: cells[0].strip("`") for name, cells in table("parameter").items()} == {
        name: str(value) for name, value in declared.items()
    }
    shipped = yaml.safe_load((ROOT / "config" / "predictor.yaml").read_text())["/**"]["ros__parameters"]
    assert shipped == declared


def test_the_parameters_of_the_controller_are_those_of_its_page() -> None:
    page = (ROOT / "docs" / "controller.md").read_text(encoding="utf-8")
    described = {name: cells[0].strip("`") for name, cells in table("parameter", page).items()}
    declared = declared_parameters("controller")
    as_ros_writes = {
        name: str(value).lower() if isinstance(value, bool) else str(value) for name, value in declared.items()
    }
    assert described == as_ros_writes


def test_the_topics_are_those_of_the_default_signal_map_and_of_the_node() -> None:
    topics = {cells[0].strip("`"): cells[1].strip("`") for cells in _topic_rows()}
    default = {source.topic: source.type for source in load_signal_map("default").signals.values()}
    published = {messages.PREDICTION_TOPIC, messages.PARAMETERS_TOPIC, messages.HORIZON_TOPIC, "/diagnostics"}
    assert {topic: kind for topic, kind in topics.items() if topic in default} == default
    assert set(topics) == set(default) | published


def test_every_signal_and_shipped_file_is_named() -> None:
    text = " ".join(README.split())
    for name in SIGNALS:
        assert re.search(rf"\b{name}\b", text), name
    for kind in ("vehicles", "signals"):
        for path in (ROOT / "config" / kind).glob("*.yaml"):
            assert f"`{path.stem}`" in text, path.stem


@pytest.mark.parametrize("target", re.findall(r"^    make (\w+)", README, flags=re.M))
def test_the_make_targets_exist(target: str) -> None:
    assert re.search(rf"^{target}:", (ROOT / "Makefile").read_text(), flags=re.M)


def _topic_rows() -> list[list[str]]:
    lines = README.splitlines()
    start = next(k for k, line in enumerate(lines) if line.startswith("| direction |"))
    rows = []
    for line in lines[start + 2 :]:
        if not line.startswith("|"):
            return rows
        rows.append([cell.strip() for cell in line.strip("|").split("|")][1:])
    return rows


def test_the_effects_of_the_document_are_those_of_the_code() -> None:
    rows = [line for line in (ROOT / "docs" / "effects.md").read_text(encoding="utf-8").splitlines() if "| `" in line]
    cells = [[cell.strip() for cell in row.strip("|").split("|")] for row in rows]
    described = {name.strip("`"): (what, re.findall(r"`(\w+)`", how), advice) for name, what, how, advice in cells}
    assert described == {
        name: (effect.SUMMARY, list(effect.PARAMETERS), effect.ADVICE) for name, effect in EFFECTS.items()
    }
