"""Acceleration limits of a vehicle and the forward-backward speed profile."""

from dataclasses import replace

import numpy as np
import pytest

from dynssm_ros.errors import UserError
from dynssm_ros.track.lines import Line
from dynssm_ros.track.speed_profile import speed_profile
from dynssm_ros.track.tracks import load_track
from dynssm_ros.vehicle import COEFFICIENTS, load_vehicle
from dynssm_ros.vehicle.limits import Limits, vehicle_limits

CONSTANT = Limits(np.linspace(0.1, 100, 50), np.full(50, 8.0), np.full(50, 3.0), np.full(50, 6.0))


def slopes(line: Line, v: np.ndarray) -> np.ndarray:
    """Longitudinal acceleration from each point to the next."""
    return (np.roll(v, -1) ** 2 - v**2) / (2 * np.diff(line.s, append=line.length))


def test_circle_is_driven_at_the_lateral_limit():
    angle = np.linspace(0, 2 * np.pi, 300, endpoint=False)
    circle = Line(50 * np.stack([np.cos(angle), np.sin(angle)], axis=1))
    np.testing.assert_allclose(speed_profile(circle, CONSTANT), np.sqrt(8.0 * 50), rtol=1e-4)


@pytest.mark.parametrize(("limits", "share"), [(CONSTANT, 1.0), (vehicle_limits(load_vehicle("av21")), 0.8)])
@pytest.mark.parametrize("name", ["oval", "road_course"])
def test_profile_keeps_all_limits(name, limits, share):
    line = load_track(name).centre
    v = speed_profile(line, limits, share)
    lateral = share * np.interp(v, limits.speed, limits.lateral)
    used = np.abs(line.curvature(line.s)) * v**2 / lateral
    assert np.max(used) <= 1 + 1e-3
    assert np.max(v) <= limits.top_speed
    a = slopes(line, v)
    assert np.all(a <= share * np.interp(v, limits.speed, limits.drive) + 1e-9)
    assert np.all(a >= -share * np.interp(np.roll(v, -1), limits.speed, limits.brake) - 1e-9)


def test_a_section_with_a_smaller_share_is_slower_and_is_braked_for():
    line = load_track("club").centre
    limits = vehicle_limits(load_vehicle("orca"))
    careful = np.where(np.abs(line.s - line.length / 2) < line.length / 10, 0.5, 1.0)
    full, v = speed_profile(line, limits), speed_profile(line, limits, careful)
    assert np.all(v <= full + 1e-12)
    used = np.abs(line.curvature(line.s)) * v**2 / np.interp(v, limits.speed, limits.lateral)
    assert np.max(used[careful < 1]) <= 0.5 + 1e-3
    far = np.abs(line.s - line.length / 2) > 0.4 * line.length
    np.testing.assert_allclose(v[far], full[far], rtol=1e-9)


def test_straights_are_driven_at_full_throttle_or_full_brake():
    line = load_track("road_course").centre
    a = slopes(line, speed_profile(line, CONSTANT))
    straight = np.abs(line.curvature(line.s)) < 1e-6
    full = np.isclose(a, 3.0, atol=1e-3) | np.isclose(a, -6.0, atol=1e-3)
    # on each straight one point lies between the two
    assert np.sum(straight & ~full) <= 12
    assert np.sum(straight & full) > 150


@pytest.mark.parametrize("share", [1.0, 0.7])
def test_terminal_speed_is_bounded_by_cornering_and_brakes_alone(share):
    line = load_track("road_course").centre
    terminal = speed_profile(line, CONSTANT, share, reached=False)
    used = np.abs(line.curvature(line.s)) * terminal**2 / (share * CONSTANT.lateral[0])
    assert np.max(used) <= 1 + 1e-3
    assert np.all(slopes(line, terminal) >= -share * CONSTANT.brake[0] - 1e-9)
    weak = replace(CONSTANT, drive=0.5 * CONSTANT.drive)
    np.testing.assert_array_equal(speed_profile(line, weak, share, reached=False), terminal)
    v = speed_profile(line, CONSTANT, share)
    assert np.all(v <= terminal)
    assert np.max(terminal - v) > 10  # at the end of a corner, before a straight
    assert np.mean(terminal - v < 1e-9) > 0.2  # where it brakes


def test_profile_does_not_depend_on_the_first_point():
    line = load_track("club").centre
    limits = vehicle_limits(load_vehicle("orca"))
    shifted = Line(np.roll(line.points, -137, axis=0))
    np.testing.assert_allclose(speed_profile(shifted, limits), np.roll(speed_profile(line, limits), -137), rtol=1e-6)


def test_orca_limits_follow_its_equations():
    orca = load_vehicle("orca")
    th = dict(zip(COEFFICIENTS, orca.nominal, strict=True))
    limits = vehicle_limits(orca)
    v, m = limits.speed, orca.constants.m
    net = (th["C_m1"] - th["C_m2"] * v) - th["C_r0"] - th["C_r2"] * v**2
    np.testing.assert_allclose(limits.drive, net / m, rtol=1e-12)
    braking = -0.1 * (th["C_m1"] - th["C_m2"] * v) - th["C_r0"] - th["C_r2"] * v**2
    np.testing.assert_allclose(limits.brake, -braking / m, rtol=1e-12)
    roots = np.roots([-th["C_r2"], -th["C_m2"], th["C_m1"] - th["C_r0"]])
    assert 0.98 * max(roots) < limits.top_speed <= max(roots)  # where drag eats the whole drive
    peak = th["D_f"] * (orca.constants.l_f + orca.constants.l_r) / (m * orca.constants.l_r)
    assert 0.9 * peak < np.min(limits.lateral) < peak


def test_effects_change_what_the_driver_believes_possible():
    orca = load_vehicle("orca")
    whole = vehicle_limits(orca)
    half = vehicle_limits(orca.with_effect("front_grip", {"factor": 0.5}))
    np.testing.assert_allclose(half.lateral, whole.lateral / 2, rtol=1e-9)  # the front gives way first
    draggy = vehicle_limits(orca.with_effect("drag", {"coefficient": 0.01}))
    assert draggy.top_speed < whole.top_speed


def test_cornering_speed_inverts_the_lateral_limit():
    limits = vehicle_limits(load_vehicle("av21"))
    speed = np.linspace(10, 40, 7)
    curvature = np.interp(speed, limits.speed, limits.lateral) / speed**2
    np.testing.assert_allclose(limits.cornering_speed(curvature), speed, rtol=1e-3)
    np.testing.assert_allclose(limits.cornering_speed(-curvature), speed, rtol=1e-3)
    assert limits.cornering_speed(np.zeros(1))[0] == limits.top_speed


def test_car_that_cannot_move_is_refused():
    orca = load_vehicle("orca")
    weak = orca.nominal.copy()
    weak[COEFFICIENTS.index("C_m1")] = 0.01
    with pytest.raises(UserError, match="full throttle does not move it"):
        vehicle_limits(orca.with_nominal(weak))


def test_an_open_road_is_neither_braked_for_its_end_nor_accelerated_to_its_start():
    """A bend at the end asks for brakes as on a lap; after a bend at the start the car accelerates."""
    bend, straight = np.linspace(0.0, np.pi / 2, 200), np.linspace(0.5, 100.0, 200)[:, None]
    arc = 20.0 * np.stack([np.sin(bend), 1.0 - np.cos(bend)], axis=1)
    into = Line(np.concatenate([[-100.0, 0.0] + straight[:-1] * [1.0, 0.0], arc]), closed=False)
    out = Line(into.points[::-1], closed=False)
    v, w = speed_profile(into, CONSTANT), speed_profile(out, CONSTANT)
    bend_ends = 20.0 * np.pi / 2
    gained = np.interp([0.0, 80.0], into.s, v**2), np.interp([bend_ends + 20.0, out.length], out.s, w**2)
    assert gained[0][0] - gained[0][1] == pytest.approx(2 * 6.0 * 80.0, rel=1e-3)
    assert gained[1][1] - gained[1][0] == pytest.approx(2 * 3.0 * (out.length - bend_ends - 20.0), rel=1e-3)
