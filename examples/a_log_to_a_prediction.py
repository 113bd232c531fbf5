"""From a log to a prediction: extract, calibrate, train, compare with the simplest things, predict.

    python -m examples.a_log_to_a_prediction [BAG] [--signals MAP] [--vehicle NAME]

Without a bag a simulated 1:43 car drives one.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

from dynssm_ros import calibrate, evaluate, extract, load_model, load_vehicle, simulate, train
from dynssm_ros.simulation.laps import write_run


def main(bag: Path | None, signals: str, vehicle: str, out: Path) -> dict[str, float]:
    """Goes the whole way; returns the displacement error (ADE, m) by model."""
    car = load_vehicle(vehicle)
    if bag is None:
        bag = out / "bag"
        write_run(simulate(car, "club", duration=60.0, noise=(0.01, 0.01, 0.03)), bag)

    # the log on one time grid, in SI units
    laps = extract(bag, signals, rate=1 / car.sampling_time)

    # the physics first: 17 coefficients with standard deviations, from the first three quarters
    found = calibrate(laps, car, holdout=0.25)
    for name in ("D_f", "D_r", "C_m1"):
        print(f"{name}: {found.vehicle.coefficients[name].nominal:.4g} ± {found.vehicle.coefficients[name].std:.1g}")

    # the online layer on the physics, the simplest model that learns; "dynssm" adds a network. Scored on the last quarter
    folder = train(laps, "rls", found.vehicle, out / "model", holdout=0.25).artifact.path
    scores = evaluate(laps, [folder, "single_track", "persistence"], found.vehicle, holdout=0.25).scores
    for name, score in scores.items():
        print(f"{name}: one-step RMSE of v_y {score.rmse[1]:.4f} m/s, ADE {score.rollout.ade:.4f} m")

    # one prediction from the newest window: v_x, v_y, omega one T_s ahead
    model = load_model(folder)
    print("next state:", model.predict(laps.matrix[None, -model.H :]).state[0])
    return {name: float(score.rollout.ade) for name, score in scores.items()}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("bag", nargs="?", type=Path)
    parser.add_argument("--signals", default="default")
    parser.add_argument("--vehicle", default="orca")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        main(given.bag, given.signals, given.vehicle, Path(scratch))
