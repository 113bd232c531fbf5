"""Tables of what learners take off the errors of the online layer on folds that were left out."""

from __future__ import annotations

from itertools import product

import numpy as np

from benchmarks.page import table
from dynssm_ros.arrays import Vector

HORIZONS_S = (0.3, 0.6, 1.5)
ERRORS = ("one step", *(f"path {horizon:g} s" for horizon in HORIZONS_S), "one step, first 10 s")
_RESAMPLED = 2000  # means over folds, for their interval


def by_group(known: dict[str, dict[str, list[float]]]) -> str:
    """Geometric means of the ratios in each group of folds with their interval over the folds, and the largest of all."""
    names = list(next(iter(known.values())))
    rows = []
    for group, name in product(dict.fromkeys(fold.partition("_")[0] for fold in known), names):
        of = {fold.partition("_")[2]: content[name] for fold, content in known.items() if fold.startswith(group)}
        means = ["{:.3f} ({:.3f}-{:.3f})".format(*mean_over(np.array(each))) for each in zip(*of.values(), strict=True)]
        worst, k = max(product(of, range(len(ERRORS))), key=lambda at: of[at[0]][at[1]])
        rows.append([group, str(len(of)), name, *means, f"{of[worst][k]:.3f} ({worst}, {ERRORS[k]})"])
    return table(["of", "folds", "beside the layer", *ERRORS, "largest"], rows)


def mean_over(values: Vector) -> tuple[float, float, float]:
    """The geometric mean over folds, and where it lies in 95 % of draws of as many folds with replacement."""
    drawn = np.random.default_rng(0).integers(len(values), size=(_RESAMPLED, len(values)))
    low, high = np.exp(np.percentile(np.log(values)[drawn].mean(axis=1), [2.5, 97.5]))
    return float(np.exp(np.log(values).mean())), float(low), float(high)


def tables(known: dict[str, dict[str, list[float]]]) -> str:
    """One step and path over :data:`HORIZONS_S` of each learner, by group of folds, and the path over 0.6 s by fold."""
    parts = []
    names = list(next(iter(known.values())))
    for group in dict.fromkeys(name.partition("_")[0] for name in known):
        of = {fold: content for fold, content in known.items() if fold.startswith(group)}
        rows = []
        for name in names:
            logs = np.log([content[name] for content in of.values()])
            rows.append([name, *(f"{value:.3f}" for value in (*np.exp(logs.mean(axis=0)), *np.exp(logs[:, 2])))])
        heads = [group, *ERRORS, *(f"0.6 s: {fold}" for fold in of)]
        parts.append(table(heads, rows))
    return "\n\n".join(parts)
