"""`dynssm bench` on the small model."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from dynssm_ros.cli.main import app

pytestmark = [pytest.mark.xdist_group("dds"), pytest.mark.timeout(120)]


def test_bench_writes_what_the_contract_promises(small_model: Path, tmp_path: Path) -> None:
    out = tmp_path / "bench.json"
    arguments = ["bench", "--model", str(small_model), "--duration", "3", "--calls", "200", "--json", str(out)]
    result = CliRunner().invoke(app, arguments, catch_exceptions=False)
    assert result.exit_code == 0
    figures = json.loads(out.read_text())
    assert 0 < figures["predictor_us"]["p50"] <= figures["predictor_us"]["p99"]
    assert 0 < figures["node_latency_ms"]["p50"] <= figures["node_latency_ms"]["p99"]
    assert figures["rate_hz"] == pytest.approx(100.0, rel=0.05)
    assert figures["dropped"] == 0
    assert figures["torch_over_predictor"] > 1
