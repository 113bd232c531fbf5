"""The table of a sweep's trials and its result in a sentence; Optuna's own dashboard draws the rest."""

from __future__ import annotations

import numpy as np

from dynssm_ros.evaluation.sweep import Sweep, Trial
from dynssm_ros.reporting.tables import Column, Table, Value

CAUTION = (
    "The best was chosen by these laps, so its error on them flatters it. Compare it with the model file as it was on "
    "other laps, and with other seeds."
)


def verdict(sweep: Sweep) -> str:
    """The best trial beside the first, in a sentence."""
    best, first = sweep.best, sweep.trials[0]
    assert best.errors is not None
    if first.errors is None or best.number == first.number:
        return f"Trial {best.number} of {len(sweep.trials)} is best: ADE {best.errors.ade:.4g} m."
    share = 100 * (best.errors.ade / first.errors.ade - 1)
    return (
        f"Trial {best.number} of {len(sweep.trials)} is best: ADE {best.errors.ade:.4g} m, {share:+.1f} % against "
        f"{first.errors.ade:.4g} m of the model file as it was."
    )


def trial_table(sweep: Sweep) -> Table:
    """All trials, the best first."""
    names = list(sweep.distributions)

    def settings(trial: Trial) -> list[Value]:
        chosen = [trial.settings[name] for name in names]
        return [str(each) if isinstance(each, bool) else each for each in chosen]

    return Table.of(
        sorted(sweep.trials, key=lambda trial: trial.errors.ade if trial.errors else np.inf),
        (Column("trial", brief=True), lambda trial: trial.number),
        ([Column(name.rpartition(".")[2], "", name.rpartition(".")[0]) for name in names], settings),
        (
            [
                Column("ADE", "m", best="min", brief=True),
                Column("v_x", "m/s", "one-step RMSE", "min", brief=True),
                Column("v_y", "m/s", "one-step RMSE", "min", brief=True),
                Column("ω", "rad/s", "one-step RMSE", "min", brief=True),
            ],
            lambda trial: [trial.errors.ade, *trial.errors.rmse] if trial.errors else [None] * 4,
        ),
        caption="Trial 0 is the model file as it was.",
    )
