"""Every effect in the simulated car: what it changes, what it leaves alone, and that a model with it follows the car."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest

from dynssm_ros import compiled
from dynssm_ros.errors import ConfigurationError
from dynssm_ros.simulation.external import drive_by_commands
from dynssm_ros.simulation.laps import simulate
from dynssm_ros.simulation.plant import START_TIME, PlantKind, Pose, make_plant
from dynssm_ros.track.driver import Style
from dynssm_ros.track.tracks import load_track
from dynssm_ros.vehicle import Applied, CarModel, Coefficients, State, Vehicle, load_vehicle
from dynssm_ros.vehicle.effects import EFFECTS
from dynssm_ros.vehicle.effects.measurement import MeasurementEffect, OdometryDelay
from dynssm_ros.vehicle.kinematics import time_of_day

AV21, COURSE = load_vehicle("av21"), load_track("road_course")
LINE, STEPS, WARM = load_track("club").centre.scaled(70.0), 25, 8
START = Pose(0.0, 0.0, 0.3), State(30.0, 0.1, 0.05)
SENSORS = [name for name, effect in EFFECTS.items() if issubclass(effect, (MeasurementEffect, OdometryDelay))]


def with_effect(name: str, acting: Any, share: float = 0.2) -> Vehicle:
    """The car with an effect that acts at the start of the lap, and needs no signal that a simulation has not."""
    parameters = {
        key: v for key, v in acting(name, share).items() if EFFECTS[name].PARAMETERS[key].context != ("roll",)
    }
    return AV21.with_effect(name, parameters | ({"centre": 0.02} if "centre" in parameters else {}))


def commands() -> list[Applied]:
    return [Applied(0.3 + 0.4 * np.sin(0.5 * k), 0.02 * np.sin(0.3 * k)) for k in range(STEPS)]


def driven(vehicle: Vehicle, kind: PlantKind) -> tuple[np.ndarray, np.ndarray, list[dict[str, float]]]:
    """True and measured states, each ``(STEPS + 1, 3)``, and the signals of each step, under the same commands."""
    car = make_plant(vehicle, kind, *START, line=LINE)
    true, measured, signals = [car.state], [car.measured], []
    for k, applied in enumerate(commands()):
        s = 30.0 * k * vehicle.sampling_time
        signals.append(
            {
                "t": k * vehicle.sampling_time,
                "clock": time_of_day(START_TIME) + k * vehicle.sampling_time,
                "s": s,
                "lap_length": LINE.length,
                "bend": float(LINE.bend(s)),
                "theta": car.pose.theta,
            }
        )
        car.advance(applied, s)
        true.append(car.state)
        measured.append(car.measured)
    return np.array(true), np.array(measured), signals


@pytest.mark.parametrize("kind", ["euler", "double_track"])
@pytest.mark.parametrize("name", EFFECTS)
def test_a_compiled_plant_drives_as_numpy_does(
    name: str, kind: PlantKind, acting: Any, library: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    vehicle = with_effect(name, acting)
    monkeypatch.setattr(compiled, "LIBRARY", library)
    car = make_plant(vehicle, kind, *START, line=LINE)
    assert car._compiled is not None  # type: ignore[attr-defined]
    quick = driven(vehicle, kind)
    monkeypatch.setattr(compiled, "LIBRARY", None)
    for found, expected in zip(quick[:2], driven(vehicle, kind)[:2], strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-11, atol=1e-12)


@pytest.fixture(scope="module")
def nominal() -> dict[str, np.ndarray]:
    return {kind: driven(AV21, kind)[0] for kind in ("euler", "rk4", "double_track")}


@pytest.mark.parametrize("kind", ["euler", "double_track"])
@pytest.mark.parametrize("name", sorted(EFFECTS))
def test_every_effect_shows_in_what_is_measured(name: str, kind: PlantKind, nominal: Any, acting: Any) -> None:
    true, measured, _ = driven(with_effect(name, acting), kind)
    assert np.abs(measured - nominal[kind]).max() > 2e-4
    if name in SENSORS:
        np.testing.assert_allclose(true, nominal[kind], rtol=1e-12)
    else:
        np.testing.assert_array_equal(measured, true)


@pytest.mark.parametrize("name", sorted(EFFECTS))
def test_a_model_from_the_vehicle_file_follows_the_measured_car(name: str, nominal: Any, acting: Any) -> None:
    vehicle = with_effect(name, acting, 0.1)
    _, measured, signals = driven(vehicle, "rk4")
    effects, theta = vehicle.active_effects, Coefficients(*vehicle.nominal)
    state, errors = State(*measured[0]), []
    effect_states = CarModel(vehicle.constants, 0.04, effects).settled(
        state, Applied(0.0, 0.0), theta, context=signals[0]
    )
    for k, applied in enumerate(commands()):
        state = State(*measured[k]) if k <= WARM else state  # until then it is led along what is measured
        state, effect_states = CarModel(vehicle.constants, 0.04, effects, "rk4", 40).step(
            state, applied, theta, effect_states, context=signals[k]
        )
        errors.append(np.abs(state - measured[k + 1]).max())
    shown = np.abs(measured - nominal["rk4"]).max()
    # a Pade approximation stands for the delay, and the heading is held over a step here
    assert max(errors[WARM:]) < shown * {"odometry_delay": 0.1, "crosswind": 0.02}.get(name, 1e-6)


@pytest.mark.parametrize("name", sorted(EFFECTS))
def test_laps_are_driven_with_every_effect(name: str, acting: Any) -> None:
    run = simulate(with_effect(name, acting, 0.1), COURSE, duration=0.6, plant="double_track", style=Style(0.7, 0.5))
    assert np.isfinite(run.measured).all()
    assert (name in SENSORS) == (np.abs(run.measured - run.state).max() > 0)
    assert run.vehicle.effects[-1].name == name


@pytest.mark.parametrize("kind", ["euler", "rk4", "double_track"])
@pytest.mark.parametrize("late", [0.08, 0.1])
def test_late_odometry_is_the_true_motion_of_then(kind: PlantKind, late: float, nominal: Any) -> None:
    car = AV21.with_effect("yaw_rate_bias", {"bias": 0.02}).with_effect("odometry_delay", {"delay": late})
    _, measured, _ = driven(car, kind)
    whole = int(late / 0.04)
    np.testing.assert_allclose(measured[: whole + 1], measured[:1].repeat(whole + 1, axis=0), rtol=1e-12)
    then = nominal[kind] + [0.0, 0.0, 0.02]
    if late == 0.08:
        np.testing.assert_allclose(measured[whole:], then[:-whole], rtol=1e-9)
    else:  # half-way between two samples: the mean of the two, as far as the motion bends little in between
        between = (then[: -whole - 1] + then[1:-whole]) / 2
        np.testing.assert_allclose(measured[whole + 1 :], between, atol=1e-12 if kind == "euler" else 8e-3)
        assert np.abs(measured[whole + 1 :] - then[1:-whole]).max() > 0.02


def test_a_signal_that_the_simulation_does_not_have_is_one_clear_line() -> None:
    rolling = AV21.with_effect("road_bank", {"roll_gain": 1.0})
    expected = (
        r"simulation: effect road_bank needs the signal roll \(rad\), which .* "
        r"\(t, clock, s, lap_length, bend, x, y, theta\)$"
    )
    with pytest.raises(ConfigurationError, match=expected):
        simulate(rolling, COURSE, duration=1.0)
    with pytest.raises(ConfigurationError, match="simulation: effect grip_patch needs the signal lap_length"):
        make_plant(AV21.with_effect("grip_patch", {"factor": 0.5}), "euler", *START)


@pytest.mark.parametrize("kind", ["euler", "double_track"])
def test_a_car_that_stands_is_seen_to_stand_through_slow_sensors(kind: PlantKind) -> None:
    slow = AV21.with_effect("yaw_rate_lag", {"time_constant": 0.2}).with_effect("tire_relaxation", {"length": 0.5})
    drive = drive_by_commands(slow, COURSE, kind, lambda previous: Applied(0.0, 0.1))
    assert {sample.measured for sample in itertools.islice(drive, 20)} == {State(0.0, 0.0, 0.0)}
