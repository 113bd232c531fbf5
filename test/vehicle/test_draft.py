"""First vehicle files: a known car scaled, with deviations that admit the guess."""

from __future__ import annotations

import numpy as np
import pytest
import yaml

from dynssm_ros.configuration import config_root
from dynssm_ros.errors import ConfigurationError
from dynssm_ros.vehicle import COEFFICIENTS, Vehicle, load_vehicle
from dynssm_ros.vehicle.draft import TYRES, MeasuredCar, as_commented_file, drafted
from dynssm_ros.vehicle.limits import vehicle_limits
from dynssm_ros.vehicle.single_track import SetPoint

SHIPPED = sorted(path.stem for path in (config_root() / "vehicles").glob("*.yaml"))


def itself(car: Vehicle, mass: float = 1.0, length: float = 1.0) -> MeasuredCar:
    """What one would measure of that car, with other mass and length by factors."""
    c = car.constants
    return MeasuredCar(mass * c.m, mass * c.m * c.l_r / (c.l_f + c.l_r), length * (c.l_f + c.l_r))


@pytest.mark.parametrize("name", SHIPPED)
def test_a_car_like_itself_is_itself_but_for_shifts(name: str) -> None:
    like = load_vehicle(name)
    car = drafted(like, name, itself(like))
    shifts = np.array([key.startswith("S_") for key in COEFFICIENTS])
    scale = like.constants.m * 9.81 / 2 / like.constants.F_z0  # F_z0 of the files is rounded, or a custom
    forces = np.array([scale if key[0] == "D" else 1.0 for key in COEFFICIENTS])
    np.testing.assert_allclose(car.nominal[~shifts], (forces * like.nominal)[~shifts], rtol=2e-3)
    np.testing.assert_array_equal(car.nominal[shifts], 0.0)
    assert car.inputs == like.inputs
    assert (car.effects, car.before, car.correlation) == ((), None, None)


@pytest.mark.parametrize("name", SHIPPED)
def test_deviations_and_bounds_are_those_of_a_guess_however_well_the_other_car_is_known(name: str) -> None:
    like = load_vehicle(name)
    car = drafted(like, name, itself(like, 1.3, 1.1))
    for key in ("D_f", "D_r", "B_f", "C_m1", "I_z"):
        one = car.coefficients[key]
        assert one.std is not None
        assert one.std >= 0.24 * one.nominal, key
        assert one.bounds[0] <= one.nominal - 2 * one.std or one.bounds[0] <= one.nominal / 3, key
        assert one.bounds[1] >= one.nominal + 3 * one.std, key
    assert all(one.std for one in car.coefficients.values())


def test_forces_grow_with_mass_inertia_with_mass_and_axles_drag_with_area() -> None:
    like = load_vehicle("sedan")
    car = drafted(like, "long", itself(like, 2.0, 1.5))
    ratio = dict(zip(COEFFICIENTS, car.nominal / np.where(like.nominal == 0, 1.0, like.nominal), strict=True))
    for key, expected in {"D_f": 2, "C_m1": 2, "C_m2": 2, "C_r0": 2, "C_r2": 2.25, "I_z": 4.5, "B_f": 1}.items():
        assert ratio[key] == pytest.approx(expected, rel=2e-3), key
    assert car.constants.h_cg == pytest.approx(1.5 * like.constants.h_cg, rel=1e-3)


@pytest.mark.parametrize("name", SHIPPED)
def test_with_the_other_first_input_a_car_is_as_strong_and_as_fast(name: str) -> None:
    like = load_vehicle(name)
    other: SetPoint = "speed" if like.inputs.set_point == "throttle" else "throttle"
    car = drafted(like, "mine", itself(like), set_point=other)
    assert car.inputs.set_point == other
    assert car.coefficients["C_m1"].nominal == pytest.approx(like.coefficients["C_m1"].nominal, rel=2e-3)
    assert vehicle_limits(car).top_speed == pytest.approx(vehicle_limits(like).top_speed, rel=0.2)
    assert yaml.safe_load(as_commented_file(car, []))["inputs"].get("set_point", "throttle") == other
    assert drafted(like, "mine", itself(like), set_point=like.inputs.set_point) == drafted(like, "mine", itself(like))


def test_axle_loads_give_the_centre_of_gravity() -> None:
    car = drafted(load_vehicle("f1tenth"), "mine", MeasuredCar(1.58, 0.847, 0.1735))
    assert car.constants.l_f == pytest.approx(0.0805, abs=1e-4)
    assert car.constants.l_r == pytest.approx(0.0930, abs=1e-4)
    assert car.constants.F_z0 == pytest.approx(7.75, abs=0.01)


@pytest.mark.parametrize("tyre", sorted(TYRES))
def test_a_kind_of_tyre_gives_friction_and_stiffness(tyre: str) -> None:
    like = load_vehicle("sedan")
    car = drafted(like, "mine", itself(like), tyre=tyre)  # type: ignore[arg-type]
    kind = TYRES[tyre]  # type: ignore[index]
    assert car.coefficients["D_r"].nominal == pytest.approx(kind.friction * car.constants.F_z0, rel=1e-3)
    assert car.coefficients["B_f"].nominal == kind.B


def test_the_best_acceleration_sets_the_drive() -> None:
    for name, falls in (("sedan", True), ("f1tenth", False)):
        like = load_vehicle(name)
        c = itself(like)
        car = drafted(like, name, MeasuredCar(c.mass, c.front_mass, c.wheelbase, acceleration=4.0))
        assert car.coefficients["C_m1"].nominal == pytest.approx(4.0 * c.mass, rel=1e-3)
        assert (car.coefficients["C_m2"].nominal < like.coefficients["C_m2"].nominal) == falls


@pytest.mark.parametrize("name", ["sedan", "f1tenth"])
def test_the_commented_file_is_the_vehicle(name: str) -> None:
    like = load_vehicle(name)
    car = drafted(like, name, itself(like, 1.1, 1.05))
    text = as_commented_file(car, ("first", "second"))
    assert text.startswith("# first\n# second\nname: ")
    assert Vehicle.model_validate(yaml.safe_load(text)) == car
    assert max(map(len, text.splitlines())) < 127


@pytest.mark.parametrize(
    ("measured", "said"),
    [
        (MeasuredCar(1.5e6, 0.8e6, 2.7), "constants.m: 1.5e+06: in g?"),
        (MeasuredCar(1500.0, 800.0, 2700.0), "constants.l_f"),
        (MeasuredCar(1500.0, 1450.0, 2.7), "constants.l_f: 0.09: expected"),
    ],
)
def test_what_no_car_has_is_refused(measured: MeasuredCar, said: str) -> None:
    with pytest.raises(ConfigurationError) as caught:
        drafted(load_vehicle("sedan"), "mine", measured)
    assert said in str(caught.value)


@pytest.mark.parametrize(
    ("name", "lateral", "brake"),
    [("sedan", (0.7, 1.1), (0.8, 1.0)), ("formula_student", (1.1, 1.5), (0.9, 1.4)), ("indy", (1.1, 1.5), (0.9, 1.4))],
)
def test_the_shipped_guesses_corner_and_brake_as_such_cars_do(
    name: str, lateral: tuple[float, float], brake: tuple[float, float]
) -> None:
    """In g, at a walking pace; textbooks' values of such cars."""
    car = load_vehicle(name)
    limits = vehicle_limits(car)
    assert lateral[0] < limits.lateral[100] / 9.81 < lateral[1]
    assert brake[0] < limits.brake[100] / 9.81 < brake[1]
    assert 30.0 < limits.top_speed < 90.0
    assert "guess" in car.description
