"""An exported car beside the package's own over a lap: each file run by those who read it, and the largest difference.

    python -m benchmarks.exports [--vehicle orca] [--vehicle av21] [--track club]

C code is compiled, the model for acados evaluated by casadi, CommonRoad's file driven by ``vehiclemodels``. f1tenth_gym and
acados are on no package index: the former is driven by its equations, of the latter the expressions are taken that its
solver gets. Code runs the whole lap by itself under the lap's inputs. The linear cars of the simulators begin anew from the
lap each second.
"""

from __future__ import annotations

import argparse
import math
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import yaml

from benchmarks.page import table
from dynssm_ros.api import export
from dynssm_ros.arrays import Vector
from dynssm_ros.simulation.laps import Run, simulate
from dynssm_ros.track.driver import Style
from dynssm_ros.track.tracks import load_track
from dynssm_ros.vehicle import Applied, CarModel, Coefficients, State, Vehicle, load_vehicle
from dynssm_ros.vehicle.kinematics import Pose, advance_pose
from dynssm_ros.vehicle.single_track import GRAVITY

GENTLE = Style(aggressiveness=0.1, variation=0.0)  # a tenth of the grip, where tyres are linear
_FINE = 20  # steps of a simulator in one of the lap
_PROGRAM = """\
#include "{name}_car.h"
#include <cstdio>
#include <cstring>
int main() {{
    double x[{Name}_STATES], u[{Name}_INPUTS], next[{Name}_STATES];
    for (double &value : x) if (std::scanf("%lf", &value) != 1) return 1;
    while (std::scanf("%lf %lf", u, u + 1) == 2) {{
        {name}_next(x, u, nullptr, next);
        std::memcpy(x, next, sizeof x);
        for (int k = 0; k < 6; k++) std::printf("%.17g ", x[k]);
    }}
}}
"""
Alone = Callable[[Vector, Vector], Vector]
"""From the first states ``(6,)`` and the inputs ``(N, 2)`` of a lap to the states after each, ``(N, 6)``."""
Rates = Callable[[Vector, Vector], Any]
"""From ``x, y, delta, v, theta, omega, beta`` and rates of steering and speed to the rates of the former."""


def own(vehicle: Vehicle) -> Alone:
    """The package's car."""
    car, theta = CarModel.at_any_speed(vehicle), Coefficients(*vehicle.nominal.tolist())

    def alone(first: Vector, inputs: Vector) -> Vector:
        pose, state, rows = Pose(*first[:3].tolist()), State(*first[3:].tolist()), []
        for applied in inputs:
            following, _ = car.step(state, Applied(*applied), theta)
            pose, state = advance_pose(np, pose, state, following, car.T_s), following
            rows.append([*pose, *state])
        return np.array(rows, dtype=float)

    return alone


def of_c(vehicle: Vehicle, folder: Path) -> Alone:
    """Exported C code, compiled."""
    export(vehicle, format="c").save(folder / "c")
    name = vehicle.name
    (folder / "c" / "lap.cpp").write_text(_PROGRAM.format(name=name, Name=name.upper()), encoding="utf-8")
    compiler = shutil.which("c++") or "c++"
    subprocess.run([compiler, "-O2", "lap.cpp", f"{name}.c", "-o", "lap"], cwd=folder / "c", check=True)  # noqa: S603 - our own code

    def alone(first: Vector, inputs: Vector) -> Vector:
        words = " ".join(map(repr, [*first.tolist(), *inputs.ravel().tolist()]))
        done = subprocess.run([folder / "c" / "lap"], input=words, capture_output=True, text=True, check=True)  # noqa: S603 - as above
        return np.array(done.stdout.split(), dtype=float).reshape(-1, 6)

    return alone


def of_acados(vehicle: Vehicle, folder: Path) -> Alone:
    """The discrete model that acados gets."""
    import casadi as ca

    export(vehicle, format="acados").save(folder / "acados")
    sys.modules.setdefault("acados_template", SimpleNamespace(AcadosModel=SimpleNamespace))  # type: ignore[arg-type]
    spec = spec_from_file_location("exported", folder / "acados" / f"{vehicle.name}_acados.py")
    assert spec is not None
    assert spec.loader is not None
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    model = module.model()
    step = ca.Function("step", [model.x, model.u, model.p], [model.disc_dyn_expr])

    def alone(first: Vector, inputs: Vector) -> Vector:
        rows, x = [], first
        for u in inputs:
            x = step(x, u, module.NOMINAL).full()[:, 0]
            rows.append(x)
        return np.array(rows)

    return alone


def of_commonroad(vehicle: Vehicle, folder: Path) -> Rates:
    """The single track ``st`` of CommonRoad with the exported parameters."""
    from vehiclemodels.vehicle_dynamics_st import vehicle_dynamics_st
    from vehiclemodels.vehicle_parameters import setup_vehicle_parameters

    export(vehicle, format="commonroad").save(folder / "commonroad")
    parameters = setup_vehicle_parameters(1, folder / "commonroad")
    return lambda x, u: vehicle_dynamics_st(x.tolist(), u.tolist(), parameters)


def of_f1tenth_gym(vehicle: Vehicle, folder: Path) -> Rates:
    """The equations of f1tenth_gym, a single track with linear tyres, with the exported parameters."""
    (text,) = export(vehicle, format="f1tenth_gym").files.values()
    p = yaml.safe_load(text)
    wheelbase = p["lf"] + p["lr"]

    def rates(x: Vector, u: Vector) -> list[float]:
        _, _, delta, v, theta, omega, beta = x.tolist()
        front = p["mu"] * p["C_Sf"] * p["m"] * (GRAVITY * p["lr"] - u[1] * p["h"]) / wheelbase
        rear = p["mu"] * p["C_Sr"] * p["m"] * (GRAVITY * p["lf"] + u[1] * p["h"]) / wheelbase
        F_f, F_r = front * (delta - beta - p["lf"] * omega / v), rear * (p["lr"] * omega / v - beta)
        turning, slipping = (p["lf"] * F_f - p["lr"] * F_r) / p["I"], (F_f + F_r) / (p["m"] * v) - omega
        return [v * math.cos(theta + beta), v * math.sin(theta + beta), *u.tolist(), omega, turning, slipping]

    return rates


def after_a_second(rates: Rates, run: Run) -> Iterator[tuple[float, float]]:
    """Distance (m) and error of the yaw rate (rad/s) after each second of a lap, begun from the lap."""
    T_s = run.vehicle.sampling_time
    n = round(1.0 / T_s)
    for k in range(0, len(run.time) - n - 1, n):
        pose, state = run.pose[k], run.state[k]
        x = np.array([*pose[:2], run.command[k, 1], state[0], pose[2], state[2], math.atan2(state[1], state[0])])
        for j in range(k, k + n):
            turned = (run.command[j + 1, 1] - x[2]) / T_s
            u = np.array([turned, (run.state[j + 1, 0] - x[3]) / T_s])
            for _ in range(_FINE):
                x = x + T_s / _FINE * np.array(rates(x, u))
        yield math.hypot(*(x[:2] - run.pose[k + n, :2])), abs(x[5] - run.state[k + n, 2])


def looked_up(vehicle: Vehicle, run: Run, folder: Path) -> Vector:
    """Steering of the exported table less that of the lap (rad), where it corners; read as the race stack reads it."""
    export(vehicle, format="steering_table").save(folder / "table")
    lookup = np.loadtxt(folder / "table" / f"{vehicle.name}_lookup_table.csv", delimiter=",")
    speeds, angles = lookup[0, 1:], lookup[1:, 0]
    wanted = run.state[:, 0] * run.state[:, 2]
    off = []
    for k in np.flatnonzero(abs(wanted) > 0.3 * abs(wanted).max()):
        column = lookup[1:, 1 + int(np.argmin(abs(speeds - run.state[k, 0])))]
        column = column[: int(np.argmax(np.isnan(column)))] if np.isnan(column).any() else column
        steering = float(np.interp(abs(wanted[k]), column, angles[: len(column)]))
        off.append(math.copysign(steering, wanted[k]) - run.command[k, 1])
    return np.array(off)


def rows(name: str, track: str, folder: Path) -> Iterator[list[str]]:
    """What each format does over a lap of a car."""
    vehicle = load_vehicle(name)
    road = load_track(track)
    usual, gentle = simulate(vehicle, road, laps=1), simulate(vehicle, road, laps=1, plant="rk4", style=GENTLE)
    first, inputs = np.concatenate([usual.pose[0], usual.state[0]]), usual.command[:-1]
    expected = own(vehicle)(first, inputs)
    for form, alone in (("c", of_c), ("acados", of_acados)):
        apart = abs(alone(vehicle, folder)(first, inputs) - expected).max(axis=0)
        yield [name, form, "a lap by itself", f"{apart[:2].max():.1e} m, {apart[5]:.1e} rad/s"]
    for form, rates in (("commonroad", of_commonroad), ("f1tenth_gym", of_f1tenth_gym)):
        distance, turning = np.array(list(after_a_second(rates(vehicle, folder), gentle))).T
        share = turning.max() / abs(gentle.state[:, 2]).max()
        words = f"{distance.max():.2g} m, {turning.max():.2g} rad/s ({100 * share:.0f} % of the largest)"
        yield [name, form, "a second, gently driven", words]
    off = looked_up(vehicle, gentle, folder)
    share = np.sqrt(np.mean(off**2)) / abs(gentle.command[:, 1]).max()
    words = f"{abs(off).max():.2g} rad, RMS {100 * share:.0f} % of the largest steering"
    yield [name, "steering_table", "each row, gently driven", words]


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--vehicle", action="append", help="orca and av21 if not given")
    parser.add_argument("--track", help="club, or road_course for the full-size car, if not given")
    arguments = parser.parse_args()
    found: list[list[str]] = []
    for name in arguments.vehicle or ("orca", "av21"):
        with tempfile.TemporaryDirectory() as folder:
            found += rows(name, arguments.track or ("road_course" if name == "av21" else "club"), Path(folder))
    print(table(["car", "format", "run", "largest difference"], found))


if __name__ == "__main__":
    main()
