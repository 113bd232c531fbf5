"""A linear correction beside the online layer, fitted to paths instead of single steps.

    python -m benchmarks.path_loss [--out out/network] [--only putnam] [--data DIR]

The folds, inputs and scores are those of :mod:`benchmarks.network`. There learners are fitted one step ahead, and on the
1:10 car what takes errors off one step makes paths worse. Here weights of the operating point are fitted to where rollouts
end, through the layer with what it had learned at their start: Gauss-Newton, derivatives by differences.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch

from benchmarks.fold_tables import tables
from benchmarks.logs import add_data_option
from benchmarks.network import (
    Look,
    Stretches,
    Study,
    corrected,
    folds,
    judged,
    kept,
    learned,
    left_of,
    limited,
    ratios,
    ridge,
    score,
)
from dynssm_ros.arrays import Vector
from dynssm_ros.learning.online import LayerDrive
from dynssm_ros.runtime.along import Along
from dynssm_ros.runtime.features import LayerFeatures
from dynssm_ros.runtime.online import CHANNELS, Learned, OnlineLayer
from dynssm_ros.runtime.rollout import RolloutCorrection, roll_out
from dynssm_ros.vehicle.kinematics import path

_ENDS_S = (0.3, 0.6)  # where paths are compared
_STRIDE_S = 0.5  # between starts
_ROUNDS = 3
_PENALTY = 0.03  # of a weight, as a share of the residuals' number; that of the ridge regression
_CHANGE = 0.02  # of a weight, for derivatives


class Fit:
    """Weights ``(n, 3)`` of a look's inputs, in standard deviations of what the layer leaves."""

    def __init__(self, study: Study, features: LayerFeatures, look: Look, size: Vector) -> None:
        self.study, self.features, self.look, self.size = study, features, look, size

    def learner(self, W: Vector) -> Look:
        """Corrections ``(N, 3)`` (m/s, m/s, rad/s) with these weights."""
        return lambda windows, seen: np.asarray(limited(self.look(windows, seen) @ W) * self.size)

    def fitted(self, stretches: Stretches) -> Vector:
        """Gauss-Newton from no correction."""
        drive, _ = stretches[0]
        some = drive.see(slice(0, 1))
        W = np.zeros((self.look(drive.recording.windows(drive.ends[:1], self.study.base.H), some).shape[1], CHANNELS))
        for _ in range(_ROUNDS):
            A, b, count = np.zeros((W.size, W.size)), np.zeros(W.size), 0
            for residuals, J in self.linearised(stretches, W):
                A, b, count = A + J.T @ J, b + J.T @ residuals, count + len(residuals)
            penalty = _PENALTY * count * np.eye(W.size)
            W = W - np.linalg.solve(A + penalty, b + _PENALTY * count * W.ravel()).reshape(W.shape)
        return W

    def linearised(self, stretches: Stretches, W: Vector) -> Iterator[tuple[Vector, Vector]]:
        """Of each stretch: where paths end off the measured ones, over its RMS without a correction, and derivatives."""
        for drive, layer in stretches:
            starts, known = self.starts(drive, layer, W)
            if len(starts) < CHANNELS:
                continue
            alone = self.off(layer, known, starts, np.zeros_like(W))
            scale = np.sqrt(np.mean(alone**2, axis=0, keepdims=True))
            now = self.off(layer, known, starts, W)
            J = np.empty((now.size, W.size))
            for k in range(W.size):
                changed = W.copy()
                changed.flat[k] += _CHANGE
                J[:, k] = ((self.off(layer, known, starts, changed) - now) / scale / _CHANGE).ravel()
            yield (now / scale).ravel(), J

    def starts(self, drive: LayerDrive, layer: OnlineLayer, W: Vector) -> tuple[Vector, Learned]:
        """Windows and what follows them, ``(M, H + steps, 7)``, and what the layer knows there beside the correction."""
        log, H, T_s = drive.recording, self.study.base.H, self.study.car.sampling_time
        steps = round(max(_ENDS_S) / T_s)
        seen, (rows, increments) = drive.see(slice(None)), drive.measured(slice(None))
        left = increments - self.learner(W)(log.windows(drive.ends, H), seen)
        known = Along(layer).over(seen, rows, left, drive.ends)
        usable = np.intersect1d(drive.ends, log.window_ends(H, steps, self.study.car.minimum_speed))
        chosen = usable[:: max(1, round(_STRIDE_S / T_s))]
        return log.windows(chosen, H, steps), known.at(np.searchsorted(drive.ends, chosen))

    def off(self, layer: OnlineLayer, known: Learned, rows: Vector, W: Vector) -> Vector:
        """Where paths end less where the measured ones do (m), ``(M, ends, 2)``, in the frame of their start."""
        H, T_s = self.study.base.H, self.study.car.sampling_time
        step = corrected(self.features, RolloutCorrection(layer, known), T_s, self.learner(W))
        predicted = np.concatenate([rows[:, H - 1 : H, :3], roll_out(step, rows, H)], axis=1)
        apart = path(predicted, T_s) - path(rows[:, H - 1 :, :3], T_s)
        return np.asarray(apart[:, [round(end / T_s) - 1 for end in _ENDS_S]])


def scored(study: Study) -> dict[str, list[float]]:
    """Errors over those of the layer alone, of corrections fitted to one step and to paths."""
    features = study.base.features(False)
    layer, stretches = study.fitted(features)
    trusted = judged(study, features, layer)
    alone = score(study, features, layer, trusted)
    left, look = left_of(stretches), study.operating_point
    one_step = learned(study, layer, look, ridge, stretches=stretches, left=left)
    fit = Fit(study, features, look, left.std(axis=0) * layer.scale)
    learners = {"fitted to one step": one_step, "fitted to paths": fit.learner(fit.fitted(stretches))}
    return {name: ratios(score(study, features, layer, trusted, learner), alone) for name, learner in learners.items()}


def main() -> None:
    """Scores the folds of measured logs and prints the tables; what is done is kept in ``--out``."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("out/network"))
    add_data_option(parser)
    parser.add_argument("--only", default="", help="folds whose names begin so")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    out = arguments.out / "path_loss"
    out.mkdir(parents=True, exist_ok=True)
    measured = {name: fold for name, fold in folds(arguments.data).items() if not name.startswith("simulated")}
    print(tables(kept(measured, scored, out, arguments.only)))


if __name__ == "__main__":
    main()
