"""Features that are learned for being learned with: a second linear layer whose features a network makes.

    python -m benchmarks.meta_features [--out out/network] [--only putnam] [--data DIR]

The folds, inputs and scores are those of :mod:`benchmarks.network`. There a learner is fixed once it is trained. Here a
network gives ``FEATURES`` numbers a row, and a Kalman filter follows the weights from them to what the online layer leaves.
The network, the first weights, their covariance and how fast they walk are trained together, by backpropagation through the
filter over stretches of ``STRETCH_S`` (as in ALPaCA of Harrison, Sharma and Pavone, 2018, and Neural-Fly of O'Connell et
al., 2022).
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch
from torch import nn

from benchmarks.fold_tables import HORIZONS_S, tables
from benchmarks.logs import add_data_option
from benchmarks.network import (
    Look,
    Scored,
    Stretches,
    Study,
    corrected,
    folds,
    judged,
    kept,
    left_by,
    left_of,
    ratios,
    score,
)
from dynssm_ros.arrays import Vector
from dynssm_ros.runtime.along import Along
from dynssm_ros.runtime.features import LayerFeatures
from dynssm_ros.runtime.online import CHANNELS, OnlineLayer, Seen
from dynssm_ros.runtime.rollout import RolloutCorrection, path_errors, roll_out

FEATURES = 8
STRETCH_S = 6.0
_HIDDEN = 16
_BATCH = 32  # stretches that are followed at once
_ROUNDS = 200
_STRIDE_S = 0.2  # between starts of paths
_FIRST_S = 10.0


class Meta(nn.Module):
    """A network of features and what a filter knows of their weights beforehand."""

    def __init__(self, inputs: int, *, adapts: bool) -> None:
        super().__init__()
        self.features = nn.Sequential(nn.Linear(inputs, _HIDDEN), nn.SiLU(), nn.Linear(_HIDDEN, FEATURES), nn.Tanh())
        self.weights = nn.Parameter(torch.zeros(FEATURES, CHANNELS))
        self.spread = nn.Parameter(torch.full((FEATURES,), -2.0))  # logarithm of the first variances over that of noise
        self.walk = nn.Parameter(torch.tensor(-9.0))  # logarithm of what they grow by in a row, over the first
        self.adapts = adapts

    def follow(self, seen: torch.Tensor, left: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Weights before each row ``(B, T, FEATURES, 3)`` and what they leave of it ``(B, T, 3)``.

        Args:
            seen: features, ``(B, T, FEATURES)``.
            left: by the online layer, ``(B, T, 3)``.
        """
        first = torch.diag(self.spread.exp())
        W, P = self.weights.expand(len(seen), -1, -1), first.expand(len(seen), -1, -1)
        known, errors = [], []
        for phi, y in zip(seen.unbind(1), left.unbind(1), strict=True):
            error = y - torch.einsum("bk,bkc->bc", phi, W)
            known.append(W)
            errors.append(error)
            if self.adapts:
                gain = torch.einsum("bij,bj->bi", P, phi)
                share = 1.0 + torch.einsum("bi,bi->b", gain, phi)
                W = W + torch.einsum("bi,bc->bic", gain / share[:, None], error.clamp(-3.0, 3.0))
                P = P - torch.einsum("bi,bj->bij", gain, gain) / share[:, None, None] + self.walk.exp() * first
        return torch.stack(known, 1), torch.stack(errors, 1)


def trained(inputs: list[Vector], left: list[Vector], rows: int, *, adapts: bool) -> Meta:
    """Meta-trains on stretches of so many rows of each part."""
    torch.manual_seed(0)
    rng = np.random.default_rng(0)
    X, Y = ([torch.tensor(each, dtype=torch.float32) for each in parts] for parts in (inputs, left))
    usable = [k for k, each in enumerate(X) if len(each) > rows]
    share = np.array([len(X[k]) for k in usable], dtype=float)
    model = Meta(X[0].shape[1], adapts=adapts)
    optimiser = torch.optim.AdamW(model.parameters(), lr=0.004, weight_decay=0.01)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, _ROUNDS)
    for _ in range(_ROUNDS):
        parts = rng.choice(usable, _BATCH, p=share / share.sum())
        firsts = [int(rng.integers(len(X[k]) - rows)) for k in parts]
        x, y = (
            torch.stack([of[k][first : first + rows] for k, first in zip(parts, firsts, strict=True)]) for of in (X, Y)
        )
        _, errors = model.follow(model.features(x), y)
        loss = nn.functional.huber_loss(errors, torch.zeros_like(errors), delta=2.0)
        optimiser.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        optimiser.step()
        schedule.step()
    return model


def features_of(model: Meta, x: Vector) -> Vector:
    """What the network makes of inputs ``(N, n)``, ``(N, FEATURES)``."""
    with torch.no_grad():
        found: Vector = model.features(torch.tensor(x, dtype=torch.float32)).double().numpy()
    return found


def scored_with(
    study: Study, features: LayerFeatures, layer: OnlineLayer, trusted: Vector, model: Meta, look: Look, size: Vector
) -> Scored:
    """As :func:`benchmarks.network.score`; the online layer learns as it does alone."""
    log, H, T_s = study.fold.left_out, study.base.H, study.car.sampling_time
    ends = log.window_ends(H, min_speed=study.car.minimum_speed)
    windows = log.windows(ends, H)
    seen, (rows, increments) = features.seen(windows), study.drive(log, ends, features).measured(slice(None))
    known = Along(layer).over(seen, rows, increments, ends)._replace(trusted=trusted)
    left = increments - layer.increments(seen.features, known.weights)
    inputs = torch.tensor(features_of(model, look(windows, seen)), dtype=torch.float32)[None]
    with torch.no_grad():
        weights, errors = (
            each[0].double().numpy()
            for each in model.follow(inputs, torch.tensor(left / (size * layer.scale), dtype=torch.float32)[None])
        )
    errors = errors * size * layer.scale
    steps = round(max(HORIZONS_S) / T_s)
    starts = log.window_ends(H, steps, study.car.minimum_speed)[:: max(1, round(_STRIDE_S / T_s))]
    at = np.searchsorted(ends, starts)

    def learner(windows: Vector, seen: Seen) -> Vector:
        """By the weights that were known at the start of each rollout."""
        found = np.einsum("nk,nkc->nc", features_of(model, look(windows, seen)), weights[at])
        return np.asarray(found * size * layer.scale)

    predicted = log.windows(starts, H, steps)
    states = roll_out(corrected(features, RolloutCorrection(layer, known.at(at)), T_s, learner), predicted, H)
    distances = path_errors(predicted[:, H - 1 : H, :3], states, predicted[:, H:, :3], T_s)
    until = [round(horizon / T_s) for horizon in HORIZONS_S]
    first = log.time[ends] < log.time[ends[0]] + 1e9 * _FIRST_S
    one_step, at_first = (np.sqrt(np.mean(each**2, axis=0)) for each in (errors, errors[first]))
    return Scored(one_step, at_first, np.stack([distances[:, :k].mean(axis=1) for k in until], axis=1))


def scored(study: Study) -> dict[str, list[float]]:
    """Errors over those of the layer alone."""
    features = study.base.features(False)
    layer, stretches = study.fitted(features)
    trusted = judged(study, features, layer)
    alone = score(study, features, layer, trusted)
    size = left_of(stretches).std(axis=0)
    found = {}
    tries: list[tuple[str, Look, bool]] = [
        ("of all that the layer sees", study.everything, True),
        ("of the operating point", study.operating_point, True),
        ("of the operating point, weights held", study.operating_point, False),
    ]
    for name, look, adapts in tries:
        model = _trained_on(study, stretches, look, size, adapts)
        found[name] = ratios(scored_with(study, features, layer, trusted, model, look, size), alone)
    return found


def _trained_on(study: Study, stretches: Stretches, look: Look, size: Vector, adapts: bool) -> Meta:
    H, log = study.base.H, study.fold.training
    inputs = [look(log.windows(drive.ends, H), drive.see(slice(None))) for drive, _ in stretches]
    left = [left_by(layer, drive) / size for drive, layer in stretches]
    return trained(inputs, left, round(STRETCH_S / study.car.sampling_time), adapts=adapts)


def main() -> None:
    """Scores the folds of measured logs and prints the tables; what is done is kept in ``--out``."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("out/network"))
    add_data_option(parser)
    parser.add_argument("--only", default="", help="folds whose names begin so")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    out = arguments.out / "meta_features"
    out.mkdir(parents=True, exist_ok=True)
    measured = {name: fold for name, fold in folds(arguments.data).items() if not name.startswith("simulated")}
    print(tables(kept(measured, scored, out, arguments.only)))


if __name__ == "__main__":
    main()
