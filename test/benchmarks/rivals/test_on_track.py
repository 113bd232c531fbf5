"""On-track identification: planted tyres are found from laps, those that are right stay."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from benchmarks.rivals.on_track import TYRES, OnTrack
from dynssm_ros.evaluation.open_loop import evaluate
from dynssm_ros.learning.export import save_artifact
from dynssm_ros.learning.models.base import ModelConfig
from dynssm_ros.learning.stages import train
from dynssm_ros.runtime.baselines import SingleTrack
from dynssm_ros.runtime.onnx_model import OnnxModel
from dynssm_ros.signals.recording import Recording
from dynssm_ros.vehicle import COEFFICIENTS, Coefficients, Vehicle
from dynssm_ros.vehicle.single_track import front_force, rear_force

MakeConfig = Callable[..., ModelConfig]
ON_TRACK = {"kind": "on_track", "history": 0.08, "physics": {"nominal": "vehicle", "integrator": "euler"}}


@pytest.mark.slow
def test_tyres_that_the_file_has_wrong_are_found(
    make_fitted: MakeConfig, drive: Callable[..., Recording], orca: Vehicle, tmp_path: Path
) -> None:
    wrong = {name: c.model_copy(update={"nominal": {"D": 0.8, "B": 1.2}.get(name[0], 1.0) * c.nominal}) if name in TYRES
             else c for name, c in orca.coefficients.items()}  # fmt: skip
    believed = orca.model_copy(update={"coefficients": wrong})
    laps, held = drive(orca, 4000).split_last(0.3)
    trained = train(laps, make_fitted(**ON_TRACK), believed, tmp_path / "c.pt")
    assert isinstance(trained.model, OnTrack)
    model = OnnxModel(save_artifact(trained, tmp_path / "model"))  # which compares the graph with torch
    scores = evaluate(held, {"found": model, "file": SingleTrack(believed, "euler")}, calls=1).scores
    assert np.all(scores["found"].rmse[1:] < 0.3 * scores["file"].rmse[1:])
    slips = np.linspace(-0.15, 0.15, 31)
    found = Coefficients(*trained.model.theta.numpy())
    for force in (front_force, rear_force):
        true, identified = (force(np, theta, slips) for theta in (Coefficients(*orca.nominal), found))
        np.testing.assert_allclose(identified, true, atol=0.1 * np.abs(true).max())


@pytest.mark.slow
def test_tyres_that_are_right_stay_and_all_else_too(
    make_fitted: MakeConfig, drive: Callable[..., Recording], orca: Vehicle, tmp_path: Path
) -> None:
    trained = train(drive(orca, 1500), make_fitted(**ON_TRACK), orca, tmp_path / "c.pt")
    assert isinstance(trained.model, OnTrack)
    others = [k for k, name in enumerate(COEFFICIENTS) if name not in TYRES]
    theta = trained.model.theta.numpy()
    np.testing.assert_allclose(theta[others], orca.nominal[others], rtol=1e-6)
    assert np.all(np.array(trained.validation_rmse) < 1e-5)
