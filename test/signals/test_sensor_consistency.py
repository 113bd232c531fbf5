"""Speed, gyro, accelerometers and fixes that are right have no finding; another unit or sign of one is named."""

from __future__ import annotations

import numpy as np
import pytest

from dynssm_ros.arrays import Vector
from dynssm_ros.signals.consistency import checked
from dynssm_ros.signals.resampling import Stream
from dynssm_ros.signals.sensor_consistency import sensor_findings
from dynssm_ros.signals.signal_map import load_signal_map
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


def test_of_sensors_that_are_wrong_nothing_else_is_said() -> None:
    wrong = driven()
    findings = sensor_findings(sensors(False, v_x=3.6), DEFAULT)
    info = wrong.info.model_copy(update={"findings": findings})
    wrong = type(wrong)(info, wrong.time, wrong.segment, wrong.columns | {"delta_fb": -wrong["delta_fb"]})
    assert checked(wrong).info.findings == findings
