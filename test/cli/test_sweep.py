"""``dynssm sweep`` from the command line: it writes what it found, and goes on."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

from dynssm_ros.learning.models.registry import load_model_config
from dynssm_ros.simulation.laps import as_recording, simulate
from dynssm_ros.track.tracks import load_track
from dynssm_ros.vehicle import load_vehicle
from examples import what_a_sweep_tells


def test_a_sweep_finds_goes_on_and_refuses_what_the_model_file_lacks(
    tmp_path: Path, told: Callable[..., tuple[int, str]]
) -> None:
    laps = simulate(load_vehicle("orca"), load_track("club"), duration=12.0, noise=(0.01, 0.01, 0.03))
    as_recording(laps).save(tmp_path / "laps.parquet")
    space = tmp_path / "space.yaml"
    space.write_text("penalty: {low: 0.001, high: 10000.0, log: true}")
    out = tmp_path / "sweep"
    command = (tmp_path / "laps.parquet", "--vehicle", "orca", "--model", "ridge", "--space", space, "--out", out)
    status, said = told("sweep", *command, "--trials", 3)
    assert status == 0, said
    assert "of 3 is best: ADE" in said
    first = json.loads((out / "results.json").read_text())
    status, said = told("sweep", *command, "--trials", 6)
    assert status == 0, said
    found = json.loads((out / "results.json").read_text())
    assert found["trials"][:3] == first["trials"]
    assert len(found["trials"]) == 6
    assert found["trials"][0]["settings"] == {"penalty": 1.0}  # of the model file
    best = min(found["trials"], key=lambda trial: float(trial["ade"]))
    assert found["best"] == best["number"]
    assert load_model_config(out / "best.yaml").model_dump()["penalty"] == best["settings"]["penalty"]
    assert (out / "trials" / "005" / "model.yaml").is_file()
    assert what_a_sweep_tells.main(out, tmp_path / "sweep.png").stat().st_size > 10_000
    space.write_text("penalties: {low: 0.001, high: 10.0}")
    status, said = told("sweep", *command, "--trials", 3)
    assert (status, "penalties: no field of the model file" in said) == (1, True)
