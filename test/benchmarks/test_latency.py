"""`python -m benchmarks.latency` on the small model."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from benchmarks.latency import latency, open_artifacts
from dynssm_ros.learning.export import save_artifact
from dynssm_ros.learning.models.registry import load_model_config
from dynssm_ros.learning.stages import train
from dynssm_ros.signals.extraction import extract
from dynssm_ros.signals.signal_map import load_signal_map
from dynssm_ros.vehicle import load_vehicle

pytestmark = [pytest.mark.live, pytest.mark.timeout(120)]


def test_bench_writes_what_the_contract_promises(small_model: Path, tmp_path: Path) -> None:
    out = tmp_path / "bench.json"
    latency([small_model], 100.0, 3.0, 200, out)
    figures = json.loads(out.read_text())
    assert 0 < figures["predictor_us"]["p50"] <= figures["predictor_us"]["p99"]
    assert 0 < figures["node_latency_ms"]["p50"] <= figures["node_latency_ms"]["p99"]
    assert figures["rate_hz"] == pytest.approx(100.0, rel=0.05)
    assert figures["dropped"] == 0
    assert figures["torch_over_predictor"] > 1
    assert figures.pop("models") == {"small": figures}


def test_models_are_set_beside_the_first(
    small_model: Path, tmp_path: Path, laps_bag: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recording = extract([laps_bag], load_signal_map("default"), 50.0)
    (tmp_path / "small_ddm.yaml").write_text("{base: ddm_orca, name: small_ddm, dense: {layers: 2, width: 8}}")
    config = load_model_config(tmp_path / "small_ddm.yaml").with_training(epochs=1)
    ddm = save_artifact(train(recording, config, load_vehicle("orca"), tmp_path / "c.pt"), tmp_path / "ddm").path
    out = tmp_path / "bench.json"
    latency([small_model, ddm], 100.0, 2.0, 200, out)
    figures = json.loads(out.read_text())
    first, second = figures["models"]["small"], figures["models"]["small_ddm"]
    assert {name: figures[name] for name in first} == first
    assert second.keys() == first.keys()
    (row,) = (line.split() for line in capsys.readouterr().out.splitlines() if line.split()[:1] == ["small_ddm"])
    assert float(row[3]) == pytest.approx(second["predictor_us"]["p50"] / first["predictor_us"]["p50"], rel=0.01)


def test_models_of_the_same_name_are_told_apart_by_their_folders(small_model: Path, tmp_path: Path) -> None:
    other = shutil.copytree(small_model, tmp_path / "other")
    assert list(open_artifacts([small_model])) == ["small"]
    assert list(open_artifacts([small_model, other])) == [str(small_model), str(other)]
