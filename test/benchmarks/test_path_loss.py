"""A correction that is fitted to paths finds a planted bend, and the paths end nearer."""

from collections.abc import Callable
from typing import Any

import numpy as np

from benchmarks.network import Study
from benchmarks.path_loss import Fit
from dynssm_ros.signals.recording import Recording
from dynssm_ros.vehicle import Vehicle


def test_paths_end_nearer_with_what_was_fitted_to_them(
    drive: Any, orca: Vehicle, study_of: Callable[..., Study], pushed: Callable[..., Recording]
) -> None:
    laps = drive(orca, 700, seed=2, noise=(0.001, 0.001, 0.004))
    applied = laps["r_fb"] + laps["r_cmd"]
    bend = np.where(np.arange(len(laps)) % 40 < 20, 0.015, -0.015) * np.tanh((applied - 0.32) / 0.02)
    laps = pushed(laps, bend)
    study = study_of(laps, laps)
    features = study.base.features(False)
    _, stretches = study.fitted(features)
    signs = {row[3:].tobytes(): sign for row, sign in zip(laps.matrix, np.sign(np.roll(bend, -1)), strict=True)}

    def look(windows: np.ndarray, seen: object) -> np.ndarray:
        return np.array([[1.0, signs.get(window[-1, 3:].tobytes(), 0.0)] for window in windows])

    fit = Fit(study, features, look, np.array([0.01, 0.003, 0.01]))
    nothing = np.zeros((2, 3))
    W = fit.fitted(stretches)
    before, after = (
        sum(float(residuals @ residuals) for residuals, _ in fit.linearised(stretches, each)) for each in (nothing, W)
    )
    assert after < 0.9 * before
    assert W[1, 0] > np.abs(W[1, 1:]).max(), "the bend is one of v_x"
