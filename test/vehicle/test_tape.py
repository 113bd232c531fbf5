"""Traced equations are the equations: a tape gives what numpy gives, for every effect, moving, standing and reversing."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from dynssm_ros import compiled
from dynssm_ros.arrays import Vector
from dynssm_ros.vehicle import Applied, CarModel, Coefficients, State, Vehicle, load_vehicle
from dynssm_ros.vehicle.compiled_car import car_structure
from dynssm_ros.vehicle.effects import EFFECTS
from dynssm_ros.vehicle.integrators import Integrator
from dynssm_ros.vehicle.single_track import Motion
from dynssm_ros.vehicle.tape import Recorder, execute, trace

ROWS = 12
WITHOUT_CONTEXT = [name for name, effect in EFFECTS.items() if not effect.signals()]


@pytest.fixture
def windows() -> Vector:
    """Random windows ``(70, 12, 7)``: driving, standing, creeping, reversing; more than the compiled loop takes at once."""
    rng = np.random.default_rng(0)
    windows: Vector = rng.normal(size=(70, ROWS, 7)) * [1.5, 0.2, 2.0, 0.5, 0.2, 0.1, 0.05]
    windows[::7, :, :3] = 0.0
    windows[1::7, :, 0] *= 1e-3
    return windows


def over(car: CarModel, windows: Vector, theta: Vector, latest: int) -> Vector:
    columns = np.moveaxis(windows, -1, 0)
    applied = Applied(columns[3] + columns[5], columns[4] + columns[6])
    moved = car.over(State(*columns[:3]), applied, Applied(*columns[3:5]), Coefficients(*theta), latest)
    return np.stack(moved, axis=-1)


@pytest.mark.parametrize(("integrator", "substeps"), [("euler", 1), ("rk4", 2)])
def test_a_tape_is_numpy_to_the_last_digit(
    orca: Vehicle, integrator: Integrator, substeps: int, windows: Vector
) -> None:
    car = CarModel.of(orca, integrator, substeps)

    def step(xp: Any, *q: Any) -> Any:
        return car.under(xp).increment(State(*q[:3]), Applied(*q[3:5]), Coefficients(*orca.nominal.tolist()))[0]

    tape, rows = trace(step, 5), np.ascontiguousarray(windows.reshape(-1, 7)[:, :5].T)
    np.testing.assert_array_equal(execute(tape, rows), np.stack(step(np, *rows)))
    assert tape.slots < len(tape.code), "slots are used again"


def test_what_nothing_hangs_on_is_left_out() -> None:
    recorder = Recorder(2)
    x, y = recorder.symbols
    unused = recorder.sin(x) + 3.0
    assert unused is not None
    tape = recorder.tape([x * y, x * y, 2.0])
    assert len(tape.code) == 1
    np.testing.assert_array_equal(execute(tape, np.array([[3.0], [5.0]])), [[15.0], [15.0], [2.0]])


def test_equations_that_branch_on_a_value_are_refused() -> None:
    with pytest.raises(TypeError, match="branch on a value cannot be traced"):
        trace(lambda _, x: [1.0 if x > 0 else x], 1)
    with pytest.raises(AttributeError, match="where cannot be traced"):
        trace(lambda xp, x: [xp.where(x > 0, x, 0.0)], 1)


@pytest.mark.parametrize("name", ["", *WITHOUT_CONTEXT])
def test_the_compiled_loop_is_numpy_with_each_effect(
    acting: Callable[..., dict[str, float]], windows: Vector, name: str, library: Any
) -> None:
    vehicle = load_vehicle("av21")
    car = CarModel.of(vehicle.with_effect(name, acting(name)) if name else vehicle, "rk4")
    windows = windows * [20.0, 5.0, 0.2, 1.0, 1.0, 1.0, 1.0]
    structure = car_structure(car, vehicle.nominal, ROWS)
    assert structure is not None
    for latest in (1, 5, ROWS):
        found = np.empty((len(windows), latest, 3))
        library.dynssm_over(
            structure.address, compiled.address(windows), len(windows), ROWS, latest, compiled.address(found)
        )
        expected = over(car, windows, vehicle.nominal, latest)
        np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-12 * np.abs(expected).max())


def test_a_car_that_cannot_be_traced_has_no_compiled_loop(orca: Vehicle) -> None:
    class Branching(EFFECTS["drag"]):  # type: ignore[misc]
        def forces(self, xp: Any, q: Motion) -> None:
            q.F_x = q.F_x if q.v_x > 0 else 0.0

    car = CarModel(orca.constants, 0.02, (Branching(coefficient=0.5),))
    assert car_structure(car, orca.nominal, ROWS) is None
