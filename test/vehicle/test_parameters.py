"""Vehicle files: the shipped ones hold what the literature gives, and a wrong one names file, field and value."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from dynssm_ros.configuration import config_root
from dynssm_ros.errors import ConfigurationError
from dynssm_ros.vehicle import COEFFICIENT_UNITS, COEFFICIENTS, Vehicle, load_vehicle, save_vehicle

SHIPPED = sorted(path.stem for path in (config_root() / "vehicles").glob("*.yaml"))


def content() -> dict[str, Any]:
    loaded: dict[str, Any] = yaml.safe_load((config_root() / "vehicles" / "orca.yaml").read_text(encoding="utf-8"))
    return loaded


def changed(path: str, value: Any) -> dict[str, Any]:
    """The ORCA file with the field at a dotted path set to ``value``, or left out where that is ``...``."""
    whole = content()
    *parents, last = path.split(".")
    place = whole
    for parent in parents:
        place = place[parent]
    if value is ...:
        del place[last]
    else:
        place[last] = value
    return whole


def write(folder: Path, whole: object) -> Path:
    path = folder / "car.yaml"
    path.write_text(yaml.safe_dump(whole), encoding="utf-8")
    return path


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_vehicles_load_by_name_and_by_path(name: str) -> None:
    vehicle = load_vehicle(name)
    assert vehicle.name == name
    assert load_vehicle(config_root() / "vehicles" / f"{name}.yaml") == vehicle
    assert (vehicle.lower < vehicle.upper).all()
    assert (vehicle.lower <= vehicle.nominal).all()
    assert (vehicle.nominal <= vehicle.upper).all()


def test_every_coefficient_has_a_unit() -> None:
    assert tuple(COEFFICIENT_UNITS) == COEFFICIENTS
    assert len(COEFFICIENTS) == 17


def test_the_orca_car_has_the_published_constants() -> None:
    orca = load_vehicle("orca")
    assert (orca.constants.m, orca.constants.l_f, orca.constants.l_r) == (0.041, 0.029, 0.033)
    assert dict(zip(COEFFICIENTS, orca.nominal, strict=True))["I_z"] == 27.8e-6
    assert not orca.constants.load_transfer
    assert orca.sampling_time == 0.02


@pytest.mark.parametrize(
    ("path", "value", "expected"),
    [
        ("coefficients.B_f", ..., ["coefficients", "missing B_f"]),
        ("coefficients.B_q", {"nominal": 1.0, "bounds": [0.0, 2.0]}, ["coefficients", "unknown B_q"]),
        ("coefficients.B_f.nominal", 31.0, ["coefficients.B_f", "31", "[5, 30]"]),
        ("coefficients.B_f.bounds", [30.0, 5.0], ["coefficients.B_f", "[30, 5]", "min < max"]),
        ("coefficients.B_f.bounds", [5.0, 5.0], ["coefficients.B_f", "[5, 5]", "min < max"]),
        ("coefficients.B_f.bounds", [5.0], ["coefficients.B_f.bounds"]),
        ("coefficients.B_f.nominal", float("nan"), ["coefficients.B_f.nominal", "finite", "nan"]),
        ("coefficients.B_f.bounds", [5.0, float("inf")], ["coefficients.B_f.bounds", "finite", "inf"]),
        ("coefficients.B_f.nominal", "much", ["coefficients.B_f.nominal", "'much'"]),
        ("coefficients.B_f.std", -1.0, ["coefficients.B_f.std", "-1"]),
        ("coefficients", ..., ["coefficients", "required"]),
        ("coefficients", [1, 2], ["coefficients", "[1, 2]"]),
        ("constants.m", 0.0, ["constants.m", "greater than 0", "0.0"]),
        ("constants.m", float("nan"), ["constants.m", "nan"]),
        ("constants.F_z0", -1.0, ["constants.F_z0", "-1.0"]),
        ("constants.wheels", 4, ["constants.wheels", "4"]),
        ("constants.load_transfer", "perhaps", ["constants.load_transfer", "perhaps"]),
        ("sampling_time", 0.0, ["sampling_time", "0.0"]),
        ("sampling_time", 20.0, ["sampling_time", "20.0"]),
        ("inputs.throttle", [1.0, -1.0], ["inputs.throttle", "[1, -1]", "min < max"]),
        ("inputs.steering", [0.35, 0.35], ["inputs.steering", "[0.35, 0.35]", "min < max"]),
        ("inputs.steering_rate", 0, ["inputs.steering_rate", "0"]),
        ("colour", "red", ["colour", "'red'"]),
        ("effects", [{"name": "warp_drive"}], ["effects.0", "unknown effect 'warp_drive'", "drag"]),
        (
            "effects",
            [{"name": "drag", "parameters": {"coefficient": 9.0}}],
            ["effects.0", "coefficient = 9", "[-1, 2]"],
        ),
        ("effects", [{"name": "drag", "parameters": {"area": 9.0}}], ["effects.0", "no parameter 'area'"]),
        ("effects", [{"name": "drag", "parameters": {"coefficient": float("nan")}}], ["effects.0", "nan"]),
        ("effects", [{"name": "steering_lag"}] * 2, ["effects", "steering_lag", "only once"]),
    ],
)
def test_a_wrong_vehicle_file_names_file_field_and_value(
    tmp_path: Path, path: str, value: Any, expected: list[str]
) -> None:
    file = write(tmp_path, changed(path, value))
    with pytest.raises(ConfigurationError) as caught:
        load_vehicle(file)
    message = str(caught.value)
    assert message.startswith(f"{file}: ")
    assert "\n" not in message
    for part in expected:
        assert part in message


@pytest.mark.parametrize(
    ("path", "value", "expected"),
    [
        ("constants.m", 41.0, "constants.m: 41: in g? expected 0.000715 to 0.357 kg"),
        ("constants.l_f", 29.0, "constants.l_f: 29: in cm? expected 0.01 to 6 m"),
        ("constants.l_f", 1.2e3, "constants.l_f: 1200: in mm? expected 0.01 to 6 m"),
        ("constants.h_cg", 15.0, "constants.h_cg: 15: in cm? expected 0 to 0.062 m"),
        ("constants.F_z0", 0.402, "constants.F_z0: 0.402: expected 0.121 to 0.282 N"),
        ("inputs.steering", [-20.0, 20.0], "inputs.steering: -20: in degrees? expected -1.57 to 1.57 rad; 1 more"),
        ("inputs.steering", [0.1, 0.3], "inputs.steering: [0.1, 0.3]: expected 0, straight ahead, within it"),
        ("inputs.throttle", [-100.0, 100.0], "inputs.throttle: -100: in %? expected -1 to 1 as a fraction; 1 more"),
        ("inputs.steering_rate", 300.0, "inputs.steering_rate: 300: in degrees/s? expected 0.01 to 50 rad/s"),
        ("coefficients.I_z", {"nominal": 0.0, "bounds": [0.0, 1e-4]}, "coefficients.I_z.bounds: [0, 0.0001]: expected more"),
        ("coefficients.I_z", {"nominal": 1.0, "bounds": [0.1, 2.0]}, "coefficients.I_z.nominal: 1: expected 3.92e-06 to"),
        ("coefficients.D_f", {"nominal": -0.2, "bounds": [-0.4, -0.1]}, "coefficients.D_f.bounds: [-0.4, -0.1]: expected"),
        ("coefficients.D_r", {"nominal": 2.0, "bounds": [1.8, 3.0]}, "coefficients.D_r.nominal: 2: a friction coeff"),
        ("coefficients.B_f", {"nominal": 0.2, "bounds": [0.1, 30.0]}, "coefficients.B_f.nominal: 0.2: per degree?"),
        ("coefficients.S_hf", {"nominal": 1.5, "bounds": [-2.0, 2.0]}, "coefficients.S_hf.nominal: 1.5: in degrees?"),
        ("coefficients.C_m1", {"nominal": 3e-4, "bounds": [1e-4, 1e-3]}, "coefficients.C_m1.nominal: 0.0003: in kN?"),
    ],
)  # fmt: skip
def test_a_car_that_cannot_be_is_refused(tmp_path: Path, path: str, value: Any, expected: str) -> None:
    with pytest.raises(ConfigurationError) as caught:
        load_vehicle(write(tmp_path, changed(path, value)))
    assert expected in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_lorry_can_be() -> None:
    m, l_f, l_r = 5000.0, 1.4, 2.4
    whole = changed("constants", {"m": m, "l_f": l_f, "l_r": l_r, "h_cg": 1.2, "F_z0": 24500.0, "load_transfer": True})
    forces = {
        "D_f": 2e4,
        "D_r": 2e4,
        "C_m1": 3e4,
        "C_m2": 800.0,
        "C_r0": 500.0,
        "C_r2": 3.0,
        "I_z": 1.2 * m * l_f * l_r,
    }
    for name, value in forces.items():
        whole["coefficients"][name] = {"nominal": value, "bounds": [0.3 * value, 3 * value]}
    assert Vehicle.model_validate(whole).constants.m == m


def test_what_a_calibration_found_within_its_bounds_is_not_judged() -> None:
    whole = load_vehicle("av21_fthd").model_copy(update={"before": None})
    poor = whole.nominal.copy()
    poor[COEFFICIENTS.index("D_f")] = 10.0
    calibrated = whole.with_nominal(poor).calibrated_on(["0"], whole)
    assert Vehicle.model_validate(calibrated.model_dump()) == calibrated


def test_all_that_is_wrong_is_counted(tmp_path: Path) -> None:
    whole = content()
    whole["constants"] |= {"m": -1.0, "l_f": -1.0, "l_r": -1.0}
    with pytest.raises(ConfigurationError, match=r"constants\.m: .*-1\.0.*; 2 more"):
        load_vehicle(write(tmp_path, whole))


def test_a_vehicle_that_does_not_exist_lists_those_that_do() -> None:
    with pytest.raises(ConfigurationError, match=r"'batmobile' is neither a file nor a shipped name .*orca"):
        load_vehicle("batmobile")


@pytest.mark.parametrize("comment", ["", "calibrated from a bag\nwith 17 Parameter, \u03b8\u2080"])
def test_saving_and_loading_gives_the_same_vehicle(tmp_path: Path, comment: str) -> None:
    vehicle = load_vehicle("orca").with_effect("steering_lag", {"time_constant": 0.123456789})
    vehicle = vehicle.with_nominal(vehicle.nominal + 1e-9 * (vehicle.upper - vehicle.nominal), np.linspace(0, 1, 17))
    file = tmp_path / "deep" / "orca2.yaml"
    save_vehicle(vehicle, file, comment)
    again = load_vehicle(file)
    assert again == vehicle
    np.testing.assert_array_equal(again.nominal, vehicle.nominal)
    assert file.read_text(encoding="utf-8").count("# ") == len(comment.splitlines())
    assert [p.name for p in file.parent.iterdir()] == ["orca2.yaml"]


def test_with_nominal_changes_nothing_but_the_values_given() -> None:
    orca = load_vehicle("orca")
    moved = orca.with_nominal(orca.lower)
    np.testing.assert_array_equal(moved.nominal, orca.lower)
    np.testing.assert_array_equal(moved.upper, orca.upper)
    assert moved.with_nominal(orca.nominal) == orca


def test_coefficients_keep_the_papers_order_whatever_the_order_of_the_file(tmp_path: Path) -> None:
    whole = content()
    whole["coefficients"] = dict(reversed(whole["coefficients"].items()))
    again = load_vehicle(write(tmp_path, whole))
    assert tuple(again.coefficients) == COEFFICIENTS
    np.testing.assert_array_equal(again.nominal, load_vehicle("orca").nominal)


def test_effects_are_built_from_the_file_and_added_in_order() -> None:
    vehicle = load_vehicle("orca").with_effect("drag", {"coefficient": 0.1}).with_effect("rear_grip", {"factor": 0.8})
    assert [(e.NAME, e.parameters) for e in vehicle.active_effects] == [
        ("drag", {"coefficient": 0.1}),
        ("rear_grip", {"factor": 0.8}),
    ]


@pytest.mark.parametrize(
    ("name", "parameters", "expected"),
    [
        ("warp_drive", {}, "unknown effect 'warp_drive'"),
        ("drag", {"coefficient": 9.0}, r"coefficient = 9 .* outside \[-1, 2\]"),
        ("steering_lag", {}, "only once"),
    ],
)
def test_an_effect_that_does_not_fit_is_refused(name: str, parameters: dict[str, float], expected: str) -> None:
    vehicle: Vehicle = load_vehicle("orca").with_effect("steering_lag", {"time_constant": 0.1})
    with pytest.raises(ConfigurationError, match=expected):
        vehicle.with_effect(name, parameters)


def test_what_is_known_together_is_saved_and_read_back(tmp_path: Path) -> None:
    orca, std = load_vehicle("orca"), np.linspace(0.1, 1.0, 17)
    correlation = np.eye(17)
    correlation[0, 2] = correlation[2, 0] = -0.9
    known = orca.with_nominal(orca.nominal, std, correlation)
    save_vehicle(known, tmp_path / "car.yaml")
    again = load_vehicle(tmp_path / "car.yaml")
    assert again == known
    np.testing.assert_allclose(again.known_correlation, correlation, atol=1e-3)
    np.testing.assert_array_equal(orca.known_correlation, np.eye(17))
    assert known.with_nominal(orca.nominal).correlation == known.correlation
    assert known.with_nominal(orca.nominal, std).correlation is None
    assert known.unmeasured().correlation is None


@pytest.mark.parametrize(
    ("correlation", "expected"),
    [
        ([[]], "1 rows; expected 17"),
        ([[0.9] * k for k in range(16)] + [[0.9, -0.9] * 8], "not positive definite"),
    ],
)
def test_correlations_that_cannot_be_are_refused(tmp_path: Path, correlation: list[list[float]], expected: str) -> None:
    content = load_vehicle("orca").model_dump(mode="json") | {"correlation": correlation}
    file = tmp_path / "car.yaml"
    file.write_text(yaml.safe_dump(content), encoding="utf-8")
    with pytest.raises(ConfigurationError, match=expected):
        load_vehicle(file)


def test_of_what_a_car_was_fitted_to_the_least_share_was_left_out(orca: Vehicle) -> None:
    once = orca.with_held_out({"a": 0.25, "b": 0.0})
    assert once.held_out == {"a": 0.25}
    assert once.with_held_out({"a": 0.5, "c": 0.1}).held_out == {"a": 0.25, "c": 0.1}
    assert once.with_held_out({"a": 0.0}).held_out == {}
