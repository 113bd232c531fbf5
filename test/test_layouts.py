"""The layouts for PlotJuggler, Foxglove and RViz show what is published, under the names and with the bounds that it has."""

from __future__ import annotations

import json
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import yaml
from rosbags.typesys import Stores, get_typestore

from dynssm_ros.runtime.health import Health
from dynssm_ros.runtime.online import expert_weights
from dynssm_ros.signals import messages
from dynssm_ros.vehicle import COEFFICIENTS, load_vehicle

LAYOUTS = Path(__file__).resolve().parent.parent / "config" / "layouts"
CAR = load_vehicle("av21")
STATUS = f"/diagnostics/{CAR.name}//dynssm: prediction/"
TYPES = {
    messages.ODOMETRY_TOPIC: messages.ODOMETRY,
    messages.PREDICTION_TOPIC: messages.ODOMETRY,
    messages.PARAMETERS_TOPIC: messages.JOINT_STATE,
    messages.HORIZON_TOPIC: "nav_msgs/msg/Path",
    messages.MARKERS_TOPIC: "visualization_msgs/msg/MarkerArray",
    "/diagnostics": "diagnostic_msgs/msg/DiagnosticArray",
}
STORE = get_typestore(Stores.ROS2_JAZZY)


def is_number(topic: str, path: list[str]) -> bool:
    """Whether the path leads to a single number of the topic's type."""
    msgtype = TYPES[topic]
    for place, name in enumerate(path):
        fields = dict(STORE.fielddefs[msgtype][1])
        if name not in fields:
            return False
        kind, what = fields[name]
        msgtype = what if isinstance(what, str) else what[0]
        if place == len(path) - 1:
            return kind.name == "BASE" and msgtype in ("float64", "float32")
    return False


@pytest.fixture(scope="module")
def plotjuggler() -> ElementTree.Element:
    return ElementTree.parse(LAYOUTS / "plotjuggler.xml").getroot()


@pytest.fixture(scope="module")
def foxglove() -> dict[str, Any]:
    content: dict[str, Any] = json.loads((LAYOUTS / "foxglove.json").read_text(encoding="utf-8"))
    return content


@pytest.fixture(scope="module")
def said() -> set[str]:
    """Names of the values on ``/diagnostics``."""
    card = SimpleNamespace(features=["physics", "network"])
    experts = expert_weights(SimpleNamespace(card=card), np.zeros((3, 2)))  # type: ignore[arg-type]
    return {*Health((), 1.0, 0.04).values(0.0), *(f"online weight of the {name}" for name in experts)}


def published(name: str, said: set[str]) -> bool:
    """Whether PlotJuggler makes a curve of that name: field by field, joints by name, diagnostics by part and key."""
    if name.startswith(STATUS):
        return name.removeprefix(STATUS) in said
    topic = next(topic for topic in TYPES if name.startswith(f"{topic}/"))
    path = name.removeprefix(f"{topic}/").split("/")
    if TYPES[topic] == messages.JOINT_STATE:
        return path[0] in COEFFICIENTS and path[1] in ("position", "effort")
    return is_number(topic, path)


def test_plotjuggler_shows_curves_that_are_there(plotjuggler: ElementTree.Element, said: set[str]) -> None:
    snippets = {snippet.get("name"): snippet for snippet in plotjuggler.iter("snippet")}
    curves = [str(curve.get("name")) for curve in plotjuggler.iter("curve")]
    sources = [snippet.findtext("linked_source", "") for snippet in snippets.values()]
    sources += [element.text or "" for more in plotjuggler.iter("additional_sources") for element in more]
    assert {"/dynssm/prediction/twist/twist/linear/y", "/vehicle/odometry/twist/twist/linear/y"} <= set(curves)
    assert {f"/dynssm/parameters/{name}/position" for name in COEFFICIENTS} <= set(curves)
    for name in [*curves, *sources]:
        assert name in snippets or published(name, said), name
    assert set(snippets) <= set(curves)


def test_plotjuggler_draws_the_bounds_of_the_vehicle_file(plotjuggler: ElementTree.Element) -> None:
    drawn = {snippet.get("name"): snippet.findtext("function") for snippet in plotjuggler.iter("snippet")}
    for name in COEFFICIENTS:
        low, high = CAR.coefficients[name].bounds
        assert (drawn[f"{name} least"], drawn[f"{name} most"]) == (f"return {low:g}", f"return {high:g}")


def panels(layout: Any) -> Iterator[str]:
    """The panels of a part of Foxglove's layout."""
    if isinstance(layout, str):
        yield layout
    else:
        for part in ("first", "second"):
            yield from panels(layout[part])


def test_foxglove_shows_what_is_there_with_its_bounds(foxglove: dict[str, Any]) -> None:
    known = foxglove["configById"]
    shown = list(panels(foxglove["layout"]))
    shown += [name for key in known for tab in known[key].get("tabs", ()) for name in panels(tab["layout"])]
    assert sorted(shown) == sorted(known)
    for name in COEFFICIENTS:
        value, *bounds = known[f"Plot!{name}"]["paths"]
        assert value["value"] == f"/dynssm/parameters.position[{COEFFICIENTS.index(name)}]"
        assert [float(bound["value"]) for bound in bounds] == list(CAR.coefficients[name].bounds)
    for name in ("v_x", "v_y", "omega"):
        topics = []
        for each in known[f"Plot!{name}"]["paths"]:
            topic, *path = each["value"].split(".")
            topics.append(topic)
            assert is_number(topic, path), each["value"]
        assert topics == [messages.ODOMETRY_TOPIC, messages.PREDICTION_TOPIC]
    assert set(known["3D!car"]["topics"]) == {messages.MARKERS_TOPIC, messages.HORIZON_TOPIC}
    status = known["DiagnosticStatusPanel!prediction"]
    assert f"{status['topicToRender']}/{status['selectedHardwareId']}/{status['selectedName']}/" == STATUS


def test_rviz_shows_topics_in_the_displays_of_their_types() -> None:
    content = yaml.safe_load((LAYOUTS / "predictor.rviz").read_text(encoding="utf-8"))
    displays = [display for display in content["Visualization Manager"]["Displays"] if "Topic" in display]
    shown = {display["Topic"]["Value"]: display["Class"].partition("/")[2] for display in displays}
    assert shown == {topic: TYPES[topic].rpartition("/")[2] for topic in shown}
    assert set(shown) == set(TYPES) - {messages.PARAMETERS_TOPIC, "/diagnostics"}
    best_effort = {d["Topic"]["Value"] for d in displays if d["Topic"]["Reliability Policy"] == "Best Effort"}
    assert best_effort == {messages.ODOMETRY_TOPIC}  # sensors publish so; what we publish is reliable
