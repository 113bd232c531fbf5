"""The SROS 2 policy allows what the running nodes do, and nothing else."""

from __future__ import annotations

import os
import threading
import time
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest

from benchmarks.endurance.live_run import LiveRun, collecting, isolated_environment, node_process

pytestmark = [pytest.mark.live, pytest.mark.timeout(240)]

POLICY = Path(__file__).parents[2] / "config" / "sros2" / "policy.xml"
# allowed, but used only with a parameter - simulated time, frames, markers, a driver of its own - or while another node
# publishes the same
ON_REQUEST = {
    "dynssm": {"/clock", "/tf", "/dynssm/markers", "/dynssm/prediction"},
    "controller": {"/clock", "/vehicle/actuator_command"},
    "simulator": {"/clock", "/vehicle/actuator_command"},
}


def allowed(node: str) -> dict[str, set[str]]:
    """Absolute names that the policy allows a node: to publish, to subscribe, to reply."""
    names: dict[str, set[str]] = {"publish": set(), "subscribe": set(), "reply": set()}
    (profile,) = (p for p in ET.parse(POLICY).iter("profile") if p.get("node") == node)
    for group in profile:
        (kind,) = group.attrib
        assert group.attrib[kind] == "ALLOW"
        for each in group:
            text = each.text or ""
            names[kind].add(f"/{node}{text[1:]}" if text.startswith("~") else f"/{text.removeprefix('/')}")
    return names


def test_each_node_has_an_enclave_of_its_own() -> None:
    enclaves = [enclave.get("path") for enclave in ET.parse(POLICY).iter("enclave")]
    assert enclaves == [f"/dynssm_ros/{node}" for node in ("predictor", "controller", "simulator", "player")]


@pytest.mark.parametrize(
    ("module", "node"), [("predictor", "dynssm"), ("controller", "controller"), ("simulator", "simulator")]
)
def test_the_policy_is_what_a_node_does(small_model: Path, module: str, node: str) -> None:
    os.environ.update(isolated_environment())
    given = {"predictor": {"model": small_model}, "simulator": {"driver": "external"}}.get(module, {})
    with node_process(module, given, os.environ.copy()), collecting(LiveRun(20_000_000)) as collector:
        expected, pause, deadline = allowed(node), threading.Event(), time.monotonic() + 30

        def done() -> dict[str, set[str]]:
            return {
                "publish": {name for name, _ in collector.get_publisher_names_and_types_by_node(node, "/")},
                "subscribe": {name for name, _ in collector.get_subscriber_names_and_types_by_node(node, "/")},
                "reply": {name for name, _ in collector.get_service_names_and_types_by_node(node, "/")},
            }

        def missing() -> dict[str, set[str]]:
            found = done()
            return {kind: expected[kind] - found[kind] - ON_REQUEST[node] for kind in expected}

        while node not in collector.get_node_names() or any(missing().values()):
            assert time.monotonic() < deadline, f"allowed but not done: {missing()}"
            pause.wait(0.1)  # nobody sets it: discovery raises no event in rclpy
        found = done()
        for kind in expected:
            assert found[kind] - expected[kind] == set(), f"done but not allowed to {kind}"
