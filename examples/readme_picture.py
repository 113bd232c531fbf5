"""The picture of the README: what a diagnosis is worth on a real race log. About three minutes.

python -m examples.readme_picture PUTNAM_PARK_BAG docs/_static/diagnosis.png
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from dynssm_ros import calibrate, diagnose, extract
from dynssm_ros.evaluation.regimes import liveliest
from dynssm_ros.files import protecting
from dynssm_ros.identification.result.diagnosis import Diagnosis

CARS = {"recalibrated": "#d55e00", "extended": "#0072b2"}
LEGEND = {"recalibrated": "best fit without a cause", "extended": "extended by the diagnosis"}
SECONDS = 16.0


def main(bag: Path, picture: Path) -> Diagnosis:
    """Calibrates and diagnoses the log, draws the picture and returns the diagnosis."""
    laps = extract([bag], signals="av21", rate=25.0)
    with protecting((), force=True):  # v_y errs more than if nothing changed, until the late yaw rate is named
        car = calibrate(laps, "av21", holdout=0.25, integrator="rk4").vehicle
    found = diagnose(laps, car, horizon=0.6)
    figure = draw(found)
    picture.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(picture, dpi=110)
    return found


def draw(found: Diagnosis) -> Figure:
    """The yaw rate on held-out rows, measured and simulated from measured states, and the errors at the horizon."""
    improvement = found.improvement
    assert improvement is not None
    windows = improvement.windows
    T_s, rows = windows.data.T_s, windows.data.rows
    shown = windows.starts[liveliest(windows.time, rows[:3, windows.starts].T, SECONDS)]
    starts = [int(shown[0])]
    for start in shown:
        if start >= starts[-1] + windows.steps:
            starts.append(int(start))
    runs = replace(windows, starts=np.array(starts))
    whole = np.arange(starts[0], starts[-1] + windows.steps + 1)
    figure = Figure(figsize=(9.6, 3.9), layout="constrained")
    over_time, bars = figure.subplots(1, 2, width_ratios=[2.3, 1.0])
    over_time.plot((whole - whole[0]) * T_s, rows[2, whole], color="0.65", lw=5.0, label="measured")
    t = (runs.starts[:, None] + np.arange(windows.steps + 1) - whole[0]) * T_s
    for name, colour in CARS.items():
        path = np.concatenate(
            [rows[2, runs.starts, None], (runs.errors(improvement.cars[name]) + runs.target)[..., 2]], 1
        )
        for k, (when, what) in enumerate(zip(t, path, strict=True)):
            over_time.plot(when, what, color=colour, lw=1.8, label=LEGEND[name] if k == 0 else None)
    over_time.set(xlabel="time (s)", ylabel="yaw rate (rad/s)")
    over_time.set_title(f"Laps that the fit did not see, simulated {windows.steps * T_s:.2g} s at a time")
    over_time.legend(frameon=False)
    recalibrated, extended = (improvement.rmse[name][improvement.horizon] for name in CARS)
    share = 100.0 * extended / recalibrated
    bars.bar(np.arange(3), 100.0, 0.37, color=CARS["recalibrated"])
    drawn = bars.bar(np.arange(3) + 0.42, share, 0.37, color=CARS["extended"])
    bars.bar_label(drawn, [f"{value - 100.0:+.0f} %" for value in share], padding=2, fontsize=8)
    bars.set_xticks(np.arange(3) + 0.21, ["$v_x$", "$v_y$", "yaw rate"])
    bars.set(ylim=(0, 112), yticks=[], title=f"Error {improvement.horizons[improvement.horizon]:.2g} s ahead")
    for panel in (over_time, bars):
        panel.spines[["top", "right"]].set_visible(False)
    return figure


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("bag", type=Path)
    parser.add_argument("picture", type=Path)
    arguments = parser.parse_args()
    diagnosis = main(arguments.bag, arguments.picture)
    for cause in diagnosis.found:
        print(cause.kind, cause.effect, cause.values, cause.std)
