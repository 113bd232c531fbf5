"""What is exported drives as the package's own car does, run by those who read it."""

from __future__ import annotations

import importlib.util
import math
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
import yaml

from dynssm_ros.api import export
from dynssm_ros.arrays import Vector
from dynssm_ros.errors import ConfigurationError
from dynssm_ros.vehicle import Applied, CarModel, Coefficients, State, Vehicle, load_vehicle
from dynssm_ros.vehicle.kinematics import Pose, advance_pose
from dynssm_ros.vehicle.limits import vehicle_limits
from dynssm_ros.vehicle.single_track import GRAVITY

Run = Callable[..., tuple[int, str, str]]


def driven(vehicle: Vehicle, seconds: float = 4.0) -> tuple[Vector, Vector]:
    """States (x, y, theta, v_x, v_y, omega, effect states) and inputs of a drive from standstill, by the package."""
    car = CarModel.at_any_speed(vehicle)
    theta, steps = Coefficients(*vehicle.nominal.tolist()), round(seconds / car.T_s)
    own: dict[str, Any] = dict.fromkeys(car.effect_states, 0.0)
    pose, state, rows, inputs = Pose(0.0, 0.0, 0.3), State(0.0, 0.0, 0.0), [], []
    low, high = vehicle.inputs.throttle
    for k in range(steps):
        share = k / steps
        first = 0.3 * high if share < 0.6 else (0.1 * high if vehicle.inputs.set_point == "speed" else 0.3 * low)
        applied = Applied(first, 0.2 * vehicle.inputs.steering[1] * math.sin(6 * share))
        rows.append([*pose, *state, *own.values()])
        inputs.append(applied)
        following, own = car.step(state, applied, theta, own)
        pose, state = advance_pose(np, pose, state, following, car.T_s), following
    return np.array(rows, dtype=float), np.array(inputs, dtype=float)


def lagging(name: str) -> Vehicle:
    """A car whose steering lags, which has a state of its own."""
    return load_vehicle(name).with_effect("steering_lag", {"time_constant": 0.1}).model_copy(update={"name": name})


@pytest.mark.parametrize(("name", "lags"), [("orca", False), ("orca", True), ("av21", False), ("f1tenth", False)])
def test_the_compiled_c_code_takes_the_package_s_steps(name: str, lags: bool, tmp_path: Path) -> None:
    if (compiler := shutil.which("c++")) is None:
        pytest.skip("no C++ compiler")
    vehicle = lagging(name) if lags else load_vehicle(name)
    export(vehicle, format="c").save(tmp_path / "c")
    program = tmp_path / "c" / "example"
    subprocess.run(
        [compiler, "-O1", f"{name}_example.cpp", f"{name}.c", "-o", program],
        cwd=tmp_path / "c",
        check=True,
        capture_output=True,
    )
    rows, inputs = driven(vehicle)
    text = "\n".join(" ".join(map(repr, row)) for row in np.hstack([rows, inputs]).tolist())
    done = subprocess.run([program], input=text, capture_output=True, text=True, check=True)
    found = np.array([line.split() for line in done.stdout.splitlines()], dtype=float)
    assert rows[:, 3].max() > 0.5
    np.testing.assert_allclose(found[:-1], rows[1:], rtol=1e-9, atol=1e-11)


def loaded(file: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location(file.stem, file)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("lags", [False, True])
def test_the_model_for_acados_steps_and_moves_as_the_car(
    lags: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With a stand-in of ``AcadosModel``: acados itself is in no package index."""
    import casadi as ca

    vehicle = lagging("orca") if lags else load_vehicle("orca")
    export(vehicle, format="acados").save(tmp_path / "acados")
    monkeypatch.setitem(sys.modules, "acados_template", SimpleNamespace(AcadosModel=SimpleNamespace))
    module = loaded(tmp_path / "acados" / "orca_acados.py")
    model = module.model()
    rows, inputs = driven(vehicle)
    step, rates = (
        ca.Function("f", [model.x, model.u, model.p], [each]) for each in (model.disc_dyn_expr, model.f_expl_expr)
    )
    found = np.array([step(x, u, module.NOMINAL).full()[:, 0] for x, u in zip(rows, inputs, strict=True)])
    np.testing.assert_allclose(found[:-1], rows[1:], rtol=1e-9, atol=1e-11)
    car = replace(CarModel.at_any_speed(vehicle), T_s=1e-6, integrator="euler", substeps=1)
    x, u, own = rows[100], inputs[100], dict(zip(car.effect_states, rows[100, 6:], strict=True))
    following, owned = car.step(State(*x[3:6]), Applied(*u), Coefficients(*vehicle.nominal.tolist()), own)
    expected = (np.array([*following, *owned.values()]) - x[3:]) / 1e-6
    moved = rates(x, u, module.NOMINAL).full()[:, 0]
    np.testing.assert_allclose(moved[3:], expected, rtol=1e-5, atol=1e-6)
    assert math.hypot(moved[0], moved[1]) == pytest.approx(math.hypot(x[3], x[4]))
    assert model.x_labels[:6] == ["x", "y", "theta", "v_x", "v_y", "omega"]
    assert ca.symvar(model.f_impl_expr)


def test_an_effect_of_the_place_is_no_code() -> None:
    vehicle = load_vehicle("orca").with_effect("grip_patch", {"factor": 0.8})
    with pytest.raises(
        ConfigurationError, match=r"vehicle orca\S*.*: an effect reads .*; expected effects of velocities"
    ):
        export(vehicle, format="c")


def gentle(vehicle: Vehicle) -> tuple[float, float, State, float]:
    """Steering angle (rad), speed (m/s), state and change of speed (m/s^2) of a corner with a fiftieth of the grip."""
    car = CarModel.at_any_speed(vehicle)
    limits = vehicle_limits(vehicle)
    speed = 0.3 * limits.top_speed
    delta = vehicle.constants.wheelbase * 0.02 * float(limits.lateral[0]) / speed**2
    theta, state = Coefficients(*vehicle.nominal.tolist()), State(speed, 0.0, 0.0)
    fine = replace(car, T_s=0.002, integrator="rk4")
    for _ in range(2000):
        following, _ = fine.step(state, Applied(vehicle.inputs.coasting(speed), delta), theta)
        state = State(speed, *following[1:])
    return delta, speed, state, float(following.v_x - speed) / fine.T_s


def without_shifts(name: str) -> Vehicle:
    """Shifts of the slip angles and forces have no place in a simulator's file."""
    vehicle = load_vehicle(name)
    return vehicle.with_nominal(vehicle.nominal * (1.0 - np.isin(np.arange(17), (8, 9, 10, 11))))


@pytest.mark.parametrize("name", ["orca", "f1tenth", "sedan"])
def test_a_gentle_corner_of_f1tenth_gym_is_the_package_s(name: str) -> None:
    """By the equations of its single track, which are linear: the steady corner in closed form."""
    vehicle = without_shifts(name)
    (text,) = export(vehicle, format="f1tenth_gym").files.values()
    p = yaml.safe_load(text)
    delta, v, state, a_x = gentle(vehicle)
    wheelbase, transfer = p["lf"] + p["lr"], a_x * p["h"]
    front, rear = (
        p["mu"] * p["C_Sf"] * (GRAVITY * p["lr"] - transfer) / wheelbase,
        p["mu"] * p["C_Sr"] * (GRAVITY * p["lf"] + transfer) / wheelbase,
    )
    understeer = p["lr"] / (wheelbase * front) - p["lf"] / (wheelbase * rear)
    assert v * delta / (wheelbase + understeer * v**2) == pytest.approx(state.omega, rel=0.03)
    assert {
        "I",
        "s_min",
        "s_max",
        "sv_min",
        "sv_max",
        "v_switch",
        "a_max",
        "v_min",
        "v_max",
        "width",
        "length",
    } < p.keys()
    assert p["v_min"] <= 0 < p["v_switch"] < p["v_max"]


@pytest.mark.parametrize("name", ["orca", "av21", "sedan"])
def test_commonroad_drives_the_car_it_reads(name: str, tmp_path: Path) -> None:
    """Its tyres are the same in front and behind, so the car is one with the mean of both."""
    pytest.importorskip("vehiclemodels")
    from vehiclemodels.vehicle_dynamics_st import vehicle_dynamics_st
    from vehiclemodels.vehicle_parameters import setup_vehicle_parameters

    vehicle = without_shifts(name)
    export(vehicle, format="commonroad").save(tmp_path / "car")
    read = setup_vehicle_parameters(1, tmp_path / "car")
    delta, v, state, _ = gentle(vehicle)
    x, step = np.array([0.0, 0.0, delta, v, 0.0, 0.0, 0.0]), 1e-3
    for _ in range(4000):
        x = x + step * np.array(vehicle_dynamics_st(x.tolist(), [0.0, 0.0], read))
    assert x[3] == pytest.approx(v)
    assert x[5] == pytest.approx(v * delta / vehicle.constants.wheelbase, rel=0.01), "neutral, as equal tyres are"
    assert x[5] == pytest.approx(state.omega, rel=0.3)
    assert read.m == vehicle.constants.m
    assert (read.steering.min, read.steering.max) == vehicle.inputs.steering


def looked_up(table: Vector, acceleration: float, speed: float) -> float:
    """As the race stack reads it: the nearest speed, then between the two nearest accelerations before the first NaN."""
    column = table[1:, 1 + int(np.argmin(np.abs(table[0, 1:] - speed)))]
    column = column[: int(np.argmax(np.isnan(column)))] if np.isnan(column).any() else column
    return float(np.interp(acceleration, column, table[1 : len(column) + 1, 0]))


@pytest.mark.parametrize("name", ["orca", *(pytest.param(name, marks=pytest.mark.slow) for name in ("av21", "sedan"))])
def test_the_steering_of_the_table_makes_the_acceleration(name: str, tmp_path: Path) -> None:
    vehicle = without_shifts(name)
    export(vehicle, format="steering_table").save(tmp_path / "table")
    table = np.loadtxt(tmp_path / "table" / f"{name}_lookup_table.csv", delimiter=",")
    assert np.isfinite(table[1:3]).all(), "the first angles are of every speed"
    assert np.nanmax(np.diff(table[1:, 1:], axis=0)) > 0
    car = replace(CarModel.at_any_speed(vehicle), T_s=0.002, integrator="rk4")
    theta, peak = Coefficients(*vehicle.nominal.tolist()), float(vehicle_limits(vehicle).lateral.max())
    for column in (5, 20, 35):
        speed = float(table[0, column])
        wanted = min(0.5 * peak, 0.8 * float(np.nanmax(table[1:, column])))
        delta, state = looked_up(table, wanted, speed), State(speed, 0.0, 0.0)
        for _ in range(3000):
            following, _ = car.step(state, Applied(vehicle.inputs.coasting(speed), delta), theta)
            state = State(speed, *following[1:])
        assert speed * state.omega == pytest.approx(wanted, rel=0.02)


def test_the_command_writes_a_folder_of_its_own(dynssm: Run, tmp_path: Path) -> None:
    status, out, _ = dynssm("export", "--vehicle", "orca", "--format", "commonroad", "--out", tmp_path / "car")
    assert status == 0
    assert "parameters_tire.yaml" in out
    assert sorted(path.name for path in (tmp_path / "car").iterdir()) == [
        "parameters_tire.yaml",
        "parameters_vehicle1.yaml",
    ]
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").touch()
    assert dynssm("export", "--vehicle", "orca", "--out", tmp_path / "mine")[0] == 1
    assert (tmp_path / "mine" / "thesis.txt").exists()
