"""Speed, gyro, accelerometers, wheels and fixes that are right have no finding; another unit or sign of one is named."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dynssm_ros.arrays import Vector
from dynssm_ros.signals.consistency import checked
from dynssm_ros.signals.extraction import extract
from dynssm_ros.signals.recording import Recording
from dynssm_ros.signals.resampling import Stream
from dynssm_ros.signals.sensor_consistency import sensor_findings
from dynssm_ros.signals.signal_map import SignalMap, load_signal_map
from dynssm_ros.signals.spans import fitted
from test.signals.test_consistency import driven

DEFAULT = load_signal_map("default")
DEGREE = 180.0 / np.pi


def sensors(fixes: bool, seed: int = 0, **factors: float) -> dict[str, Stream]:
    """What a car measures in 60 s, fixes at 5 Hz; factors multiply signals."""
    drive = driven(seed=seed)
    rng, T_s = np.random.default_rng(seed), drive.T_s
    values: dict[str, Vector] = {name: drive[name] for name in ("v_x", "omega")}
    values["a_x"] = np.gradient(drive["v_x"], T_s) + 0.3 * rng.standard_normal(len(drive)) + 0.2
    values["a_y"] = 1.1 * drive["v_x"] * drive["omega"] + 0.3 * rng.standard_normal(len(drive)) - 0.3  # it rolls
    streams = {name: Stream(drive.time, factors.get(name, 1.0) * one) for name, one in values.items()}
    if fixes:
        at, noise = slice(None, None, 4), 0.3 * rng.standard_normal((2, len(drive)))
        streams["latitude"] = Stream(drive.time[at], 48.0 + ((drive["y"] + noise[0]) / 111_200)[at])
        streams["longitude"] = Stream(drive.time[at], 11.0 + ((drive["x"] + noise[1]) / 74_600)[at])
    return streams


@pytest.mark.parametrize("fixes", [True, False])
@pytest.mark.parametrize("seed", range(2))
def test_sensors_that_are_right_have_no_finding(fixes: bool, seed: int) -> None:
    assert sensor_findings(sensors(fixes, seed), DEFAULT) == ()


@pytest.mark.parametrize("fixes", [True, False])
@pytest.mark.parametrize(
    ("what", "size", "remedy", "factors"),
    [
        ("gyro_scale", 1 / DEGREE, "omega: unit: deg/s", {"omega": DEGREE}),
        ("speed_scale", 1 / 3.6, "v_x: unit: km/h", {"v_x": 3.6}),
        ("a_x_scale", 9.80665, "a_x, a_y: unit: g", {"a_x": 1 / 9.80665, "a_y": 1 / 9.80665}),
        ("a_y_sign", -1.1, "a_y: scale: -1", {"a_y": -1.0}),
        ("a_x_sign", -1.0, "a_x: scale: -1", {"a_x": -1.0}),
    ],
)
def test_another_unit_or_sign_is_named(
    fixes: bool, what: str, size: float, remedy: str, factors: dict[str, float]
) -> None:
    (found,) = sensor_findings(sensors(fixes, **factors), DEFAULT)
    assert found.what == what
    assert found.remedy.startswith(remedy)
    assert found.size == pytest.approx(size, rel=0.05)


def test_a_gyro_that_turns_against_the_fixes_is_named() -> None:
    found = {each.what: each.size for each in sensor_findings(sensors(True, omega=-1.0), DEFAULT)}
    assert found == {"gyro_sign": pytest.approx(-1.0, abs=0.05)}


@pytest.mark.parametrize("way", [1.0, -1.0])
def test_accelerometers_that_are_turned_by_a_quarter_are_named(way: float) -> None:
    right = sensors(True)
    turned = {"a_x": right["a_y"], "a_y": replace(right["a_x"], values=-right["a_x"].values)}
    turned = {name: replace(one, values=way * one.values) for name, one in turned.items()}
    (found,) = sensor_findings(right | turned, DEFAULT)
    assert (found.what, found.size) == ("acceleration_axes", pytest.approx(1.1 * way, rel=0.05))
    signs = ("", " (scale: -1)") if way > 0 else (" (scale: -1)", "")
    assert found.remedy == "map what is a_x as a_y{}, and what is a_y as a_x{}".format(*signs)


def fixes_at(latitude: float, longitude: float, **factors: float) -> dict[str, Stream]:
    """Sensors of a drive at a place on earth, with fixes of 0.5 m."""
    drive, rng, at = driven(), np.random.default_rng(3), slice(None, None, 4)
    x, y = ((drive[name] + 0.5 * rng.standard_normal(len(drive)))[at] for name in ("x", "y"))
    east = longitude + x / (111_320 * np.cos(np.radians(latitude)))
    streams = {"latitude": latitude + y / 111_200, "longitude": east}
    return sensors(False, **factors) | {name: Stream(drive.time[at], one) for name, one in streams.items()}


@pytest.mark.parametrize("place", [(48.0, 11.0), (39.6, -86.3), (52.1, -1.0), (45.0, 44.0)])
@pytest.mark.parametrize(
    ("factors", "others"), [({}, []), ({"v_x": 3.6}, ["speed_scale"]), ({"omega": -1.0}, ["gyro_sign"])]
)
def test_latitudes_that_are_longitudes_are_told_and_nothing_else(
    place: tuple[float, float], factors: dict[str, float], others: list[str]
) -> None:
    right = fixes_at(*place, **factors)
    assert [each.what for each in sensor_findings(right, DEFAULT)] == others
    wrong = {**right, "latitude": right["longitude"], "longitude": right["latitude"]}
    assert [each.what for each in sensor_findings(wrong, DEFAULT)] == ["fix_axes", *others]


def test_near_the_equator_and_greenwich_nothing_tells_latitudes_from_longitudes() -> None:
    right = fixes_at(5.0, -2.0)
    wrong = {**right, "latitude": right["longitude"], "longitude": right["latitude"]}
    assert {"fix_axes"}.isdisjoint(each.what for each in sensor_findings(wrong, DEFAULT))


def beside(drive: Recording, **factors: float) -> dict[str, Stream]:
    """Velocities and poses that are measured, with accelerometers and wheels that slip beside them."""
    rng, T_s = np.random.default_rng(1), drive.T_s
    values: dict[str, Vector] = {name: drive[name] for name in ("v_x", "v_y", "omega", "x", "y")}
    values["a_x"] = np.gradient(drive["v_x"], T_s) + 0.2
    values["a_y"] = drive["v_x"] * drive["omega"] + 0.3 * rng.standard_normal(len(drive))
    values["wheel_speed"] = drive["v_x"] * (1.0 + 0.04 * np.maximum(drive["r_fb"], 0.0))
    return {name: Stream(drive.time, factors.get(name, 1.0) * one) for name, one in values.items()}


@pytest.mark.parametrize(
    ("what", "size", "remedy", "factors"),
    [
        ("a_x_scale", 9.80665, "a_x, a_y: unit: g", {"a_x": 1 / 9.80665, "a_y": 1 / 9.80665}),
        ("a_y_sign", -1.0, "a_y: scale: -1", {"a_y": -1.0}),
        ("a_x_sign", -1.0, "a_x: scale: -1", {"a_x": -1.0}),
        ("a_y_scale", 2.0, "a_y: scale: 2", {"a_y": 0.5}),
        ("wheel_speed_scale", 3.6, "wheel_speed: unit: km/h", {"wheel_speed": 3.6}),
        ("wheel_speed_scale", 0.8, "wheel_speed: scale: 1.2", {"wheel_speed": 0.8}),
        ("wheel_speed_sign", -1.0, "wheel_speed: scale: -1", {"wheel_speed": -1.0}),
    ],
)
def test_sensors_beside_measured_velocities_are_compared_with_them(
    what: str, size: float, remedy: str, factors: dict[str, float]
) -> None:
    drive = driven()
    assert sensor_findings(beside(drive), DEFAULT) == ()
    (found,) = sensor_findings(beside(drive, **factors), DEFAULT)
    assert found.what == what
    assert found.remedy.startswith(remedy)
    assert found.size == pytest.approx(size, rel=0.1)
    marked = replace(drive, info=drive.info.model_copy(update={"findings": (found,)}))
    assert checked(marked).info.findings == (found,)
    wrong = replace(marked, columns=drive.columns | {"omega": -drive["omega"]})
    assert [each.what for each in checked(wrong).info.findings] == ["omega_sign"]


def test_a_log_is_compared_with_the_wheels_that_its_map_names_as_far_as_it_has_them(tmp_path: Path) -> None:
    drive = driven()
    columns = {name: drive[name] for name in ("v_x", "v_y", "omega", "r_fb", "delta_fb")}
    columns |= {"t": (drive.time - drive.time[0]) / 1e9, "wheels": 3.6 * drive["v_x"]}
    np.savez(tmp_path / "log.npz", **columns)
    signals = {name: {"column": name} for name in ("v_x", "v_y", "omega")}
    signals |= {"throttle_feedback": {"column": "r_fb"}, "steering_feedback": {"column": "delta_fb"}}
    signals |= {"wheel_speed": {"column": "wheels"}, "a_y": {"column": "nowhere"}}
    signal_map = SignalMap.model_validate({"name": "table", "time": {"column": "t", "unit": "s"}, "signals": signals})
    found = extract([tmp_path / "log.npz"], signal_map, 1 / drive.T_s)
    assert [(each.what, each.remedy[:23]) for each in found.info.findings] == [
        ("wheel_speed_scale", "wheel_speed: unit: km/h")
    ]
    assert set(found.columns) == {"v_x", "v_y", "omega", "r_fb", "delta_fb", "r_cmd", "delta_cmd"}
    assert "wheel_speed" not in signal_map.active_signals()


def test_of_sensors_that_are_wrong_nothing_else_is_said() -> None:
    wrong = driven()
    findings = sensor_findings(sensors(False, v_x=3.6), DEFAULT)
    info = wrong.info.model_copy(update={"findings": findings})
    wrong = type(wrong)(info, wrong.time, wrong.segment, wrong.columns | {"delta_fb": -wrong["delta_fb"]})
    assert checked(wrong).info.findings == findings


def test_a_steering_that_is_held_says_nothing_of_curvature() -> None:
    rng = np.random.default_rng(0)
    curvature = 0.03 + 0.01 * rng.standard_normal(400)
    held = np.where(np.arange(400) < 40, -0.02, 0.3) + 1e-15 * rng.standard_normal(400)  # as means over spans come out
    assert fitted(np.stack([np.ones(400), curvature], axis=1), held, np.arange(400) // 17) is None
