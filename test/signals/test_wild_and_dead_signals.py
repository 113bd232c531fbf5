"""Signals of which a part is no measurement: values that stand for nothing, signals that stop, fields that were exchanged."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from dynssm_ros.signals.actuation import steering_fit
from dynssm_ros.signals.consistency import contradictions
from dynssm_ros.signals.findings import Finding
from dynssm_ros.signals.recording import Recording
from dynssm_ros.signals.spans import Drive
from dynssm_ros.simulation.laps import as_recording, simulate
from dynssm_ros.track.driver import Style
from dynssm_ros.track.tracks import load_track
from dynssm_ros.vehicle import load_vehicle

CAR = load_vehicle("av21")


@cache
def driven() -> Recording:
    """A minute of hard driving on a road course."""
    run = simulate(
        CAR, load_track("road_course"), 60.0, plant="rk4", seed=110, noise=(0.01, 0.01, 0.01), style=Style(0.9, 0.3)
    )
    return as_recording(run)


def changed(**columns: np.ndarray) -> Recording:
    return replace(driven(), columns={**driven().columns, **columns})


def found_in(recording: Recording) -> dict[str, Finding]:
    return {each.what: each for each in contradictions(recording, CAR.constants.wheelbase)}


def test_a_healthy_drive_has_no_finding() -> None:
    assert found_in(driven()) == {}


@pytest.mark.parametrize(
    ("column", "name", "value"),
    [
        ("v_x", "v_x", 9999.0), ("v_x", "v_x", -999.0), ("v_y", "v_y", 6553.5), ("omega", "omega", -327.68),
        ("delta_fb", "steering", 655.35), ("r_fb", "throttle", -99.0),
    ],
)  # fmt: skip
@pytest.mark.parametrize("run", [1, 7])
def test_values_that_stand_for_nothing_are_named_and_change_no_other_check(
    column: str, name: str, value: float, run: int
) -> None:
    values = driven()[column].copy()
    for first in np.random.default_rng(0).choice(len(values) - run, 14 // run, replace=False):
        values[first : first + run] = value
    found = found_in(changed(**{column: values}))
    assert list(found) == [f"{name}_spikes"]
    assert f"{name} is up to" in found[f"{name}_spikes"].told
    assert not Drive.of(changed(**{column: values})).stands


def test_a_single_wild_value_is_left_to_the_ranges_of_the_car() -> None:
    """With which ``calibrate`` names its row; it changes no other check either."""
    values = driven()["delta_fb"].copy()
    values[500] = 655.35
    assert found_in(changed(delta_fb=values)) == {}


def test_a_steering_that_jumps_to_its_lock_is_no_wild_value() -> None:
    """As of a radio, that rests nearly always."""
    steering = np.where(np.arange(len(driven())) % 100 == 0, 0.4, 0.0)
    assert "steering_spikes" not in found_in(changed(delta_fb=steering))


@pytest.mark.parametrize(("column", "name"), [("delta_fb", "steering"), ("omega", "omega")])
def test_a_signal_that_stops_is_the_only_fault(column: str, name: str) -> None:
    """No lag, sign or scale follows from a signal that is not there."""
    values = driven()[column].copy()
    values[len(values) // 2 :] = values[len(values) // 2]
    assert list(found_in(changed(**{column: values}))) == [f"{name}_frozen"]


@pytest.mark.parametrize(
    ("column", "name", "seconds"), [("delta_fb", "steering", 0.6), ("omega", "omega", 1.5), ("v_x", "v_x", 1.5)]
)
def test_a_signal_that_drops_to_zero_again_and_again_is_the_only_fault(column: str, name: str, seconds: float) -> None:
    values, rows = driven()[column].copy(), round(seconds / driven().T_s)
    turns = np.flatnonzero(np.abs(driven()["omega"]) > np.percentile(np.abs(driven()["omega"]), 60))
    for first in turns[turns < len(values) - 2 * rows][:: len(turns) // 10]:
        values[first : first + rows] = 0.0
    found = found_in(changed(**{column: values}))
    assert list(found) == [f"{name}_frozen"]
    assert "exactly 0" in found[f"{name}_frozen"].told


def test_a_throttle_that_stops_is_found() -> None:
    values = driven()["r_fb"].copy()
    values[len(values) // 5 :] = values[len(values) // 5]
    assert list(found_in(changed(r_fb=values))) == ["throttle_frozen"]


@pytest.mark.parametrize(
    ("v_x", "v_y", "remedy"),
    [
        ("v_y", "v_x", "v_x: the field of v_y, v_y: that of v_x"),
        ("-v_y", "v_x", "v_x: the field of v_y, v_y: scale: -1 of that of v_x"),
        ("v_y", "-v_x", "v_x: scale: -1 of the field of v_y, v_y: that of v_x"),
        ("-v_y", "-v_x", "v_x: scale: -1 of the field of v_y, v_y: scale: -1 of that of v_x"),
    ],
)
def test_exchanged_velocities_are_one_fault_with_the_sign_of_each(v_x: str, v_y: str, remedy: str) -> None:
    fields = {name: driven()[name] for name in ("v_x", "v_y")}
    given = fields | {f"-{name}": -values for name, values in fields.items()}
    found = found_in(changed(v_x=given[v_x], v_y=given[v_y]))
    assert list(found) == ["twist_turned"]
    read = remedy.replace("v_x: ", "").split(", v_y: ")  # what the remedy makes of the fields is the drive
    mended = [-1.0 if "-1" in each else 1.0 for each in read]
    np.testing.assert_array_equal(mended[0] * given[v_y], fields["v_x"])
    np.testing.assert_array_equal(mended[1] * given[v_x], fields["v_y"])
    assert found["twist_turned"].remedy == remedy


def test_a_turned_sensor_whose_v_y_points_right_has_both_faults() -> None:
    """Where no exchange of fields mends them."""
    turned = np.exp(-0.8j) * (driven()["v_x"] - 1j * driven()["v_y"])
    assert list(found_in(changed(v_x=turned.real, v_y=turned.imag))) == ["twist_turned", "v_y_sign"]


@pytest.mark.parametrize("rows", [-1, 0, 1, 2])
def test_the_scale_of_the_steering_does_not_hang_on_a_row_of_lag(rows: int) -> None:
    fit = steering_fit(Drive.of(driven()).earlier(rows, "steering"))
    assert fit is not None
    assert fit.values[1] == pytest.approx(CAR.constants.wheelbase, rel=0.1)
