"""Poses that do not move as the velocities say are told, and what is wrong with them is named."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from dynssm_ros.api import recorded, simulate
from dynssm_ros.arrays import Vector
from dynssm_ros.runtime.consistency import Consistency
from dynssm_ros.signals.bags import open_bag
from dynssm_ros.signals.decoding import header_stamp_ns, live_decoders
from dynssm_ros.signals.history import Refusal
from dynssm_ros.signals.signal_map import POSE_SIGNALS, STATE_SIGNALS, load_signal_map
from dynssm_ros.vehicle import State, load_vehicle
from dynssm_ros.vehicle.kinematics import Pose

ORCA = load_vehicle("orca")
PERIOD = 20_000_000  # ns
DEVELOPED_ON = ("dart/free_driving_1002", "dart/steering_identification_0950", "dart/circles_1223")
HELD_OUT = ("dart/free_driving_1027", "dart_season/circles_0909_1534", "dart_season/circles_fast_ramp_0927_1821")
Spoil = Callable[[Pose, State], tuple[Pose, State]]


@pytest.fixture(scope="module")
def laps() -> list[tuple[Pose, State]]:
    """A car at its limit, with noise on what is measured, rows 20 ms apart."""
    drive = recorded(simulate("orca", "club", plant="double_track", duration=20.0, noise=(0.03, 0.03, 0.09)))
    rows = np.stack([drive[name] for name in (*POSE_SIGNALS, *STATE_SIGNALS)], axis=1)
    rows[:, :3] += np.random.default_rng(0).normal(0, (0.004, 0.004, 0.02), (len(rows), 3))
    return [(Pose(*row[:3]), State(*row[3:])) for row in rows.tolist()]


def checked(car: Consistency, rows: list[tuple[Pose, State]], spoil: Spoil = lambda *row: row) -> list[Refusal | None]:
    return [car.check(k * PERIOD, *spoil(*row)) for k, row in enumerate(rows)]


def orca() -> Consistency:
    return Consistency(ORCA.constants.l_f + ORCA.constants.l_r, ORCA.minimum_speed)


def turned(angle: float) -> Spoil:
    c, s = math.cos(angle), math.sin(angle)
    return lambda at, v: (at, State(c * v.v_x - s * v.v_y, s * v.v_x + c * v.v_y, v.omega))


def test_a_car_at_its_limit_with_noise_passes(laps) -> None:
    assert set(checked(orca(), laps)) == {None}


@pytest.mark.parametrize(
    ("spoil", "named"),
    [
        (lambda at, v: (at, State(-v.v_x, -v.v_y, v.omega)), Refusal.SPEED_SIGN),
        (lambda at, v: (at, v._replace(v_x=-v.v_x)), Refusal.SPEED_SIGN),
        (lambda at, v: (at, State(3.6 * v.v_x, 3.6 * v.v_y, v.omega)), Refusal.SPEED_UNIT),
        (lambda at, v: turned(at.theta)(at, v), Refusal.MAP_FRAME),
        (turned(math.pi / 2), Refusal.CONTRADICTION),
        (lambda at, v: (at._replace(x=-at.x), v), Refusal.CONTRADICTION),
        (lambda at, v: (at._replace(theta=0.0), v), Refusal.CONTRADICTION),
        (lambda at, v: (Pose(0.0, 0.0, 0.0), v), Refusal.STANDS_STILL),
    ],
    ids=["backwards", "v_x negated", "km/h", "map frame", "mounted across", "mirrored", "no heading", "no pose"],
)
def test_what_is_wrong_is_named(laps, spoil: Spoil, named: Refusal) -> None:
    found = checked(orca(), laps[50:], spoil)
    counts = Counter(refusal for refusal in found if refusal not in (None, Refusal.JUMPED))
    assert counts.most_common(1)[0][0] is named
    assert next(k for k, refusal in enumerate(found) if refusal is not None) < 60
    assert named in found[:150]


def test_what_explains_no_better_than_another_is_not_named(laps) -> None:
    """On a straight along the map's negative x a twist in the map's frame looks like one of the wrong sign."""
    straight = [(Pose(-0.04 * k, 0.0, math.pi), State(-2.0, 0.0, 0.0)) for k in range(50)]
    assert set(checked(orca(), straight)) == {None, Refusal.CONTRADICTION}


def test_odometry_that_freezes_is_told_after_a_tenth_of_a_second(laps) -> None:
    frozen = [*laps[:100], *[laps[99]] * 20]
    found = checked(orca(), frozen)
    assert set(found[:104]) == {None}
    assert set(found[105:]) == {Refusal.STANDS_STILL}


def test_poses_of_a_slow_localisation_that_come_twice_or_thrice_are_none(laps) -> None:
    assert set(checked(orca(), [laps[k - k % 3] for k in range(len(laps))])) == {None}


@pytest.mark.parametrize(
    ("moved", "away"), [((0.5, 0.0, 0.0), True), ((0.0, -2.0, 0.0), True), ((0.02, 0.0, 0.1), False)]
)
def test_a_jump_is_refused_once_and_believed_when_it_is_confirmed(laps, moved: tuple[float, ...], away: bool) -> None:
    car = orca()
    found = checked(car, [(Pose(*np.add(at, moved)) if k >= 100 else at, v) for k, (at, v) in enumerate(laps)])
    assert [k for k, refusal in enumerate(found) if refusal is not None] == ([100] if away else [])
    assert car.jumps == away


def test_a_heading_that_jumps_and_stays_contradicts_the_velocities_from_then_on(laps) -> None:
    found = checked(orca(), [(at._replace(theta=at.theta + 1.5 * (k >= 100)), v) for k, (at, v) in enumerate(laps)])
    assert set(found[:100]) == {None}
    assert found[100:102] == [Refusal.JUMPED, None]
    assert set(found[120:]) == {Refusal.CONTRADICTION}


def coasting(start: tuple[Pose, State], decay: float = 0.95) -> list[tuple[Pose, State]]:
    """The car from ``start`` on, straight ahead until it stands, and 20 s longer."""
    at, speed, rows = start[0], start[1].v_x, []
    for _ in range(1000):
        speed *= decay
        step = speed * PERIOD / 1e9
        at = at._replace(x=at.x + step * math.cos(at.theta), y=at.y + step * math.sin(at.theta))
        rows.append((at, State(speed, 0.0, 0.0)))
    return rows


def test_what_contradicted_is_not_believed_because_the_car_stands_but_once_the_pose_jumps_back(laps) -> None:
    car = Consistency(wheelbase=0.062, minimum_speed=0.5)
    rows = [*laps[:100], *coasting(laps[99])]
    rows = [(at._replace(theta=at.theta + 1.5 * (k >= 100)), v) for k, (at, v) in enumerate(rows)]
    found = checked(car, rows)
    assert found[100:102] == [Refusal.JUMPED, None]
    assert set(found[115:]) == {Refusal.CONTRADICTION}
    jumped_back = [rows[-1][0]._replace(theta=rows[-1][0].theta - 1.5)] * 3
    after = [car.check((len(rows) + k) * PERIOD, at, rows[-1][1]) for k, at in enumerate(jumped_back)]
    assert after == [Refusal.JUMPED, None, None]


def test_what_contradicted_is_believed_again_once_it_agrees(laps) -> None:
    backwards = [(at, State(-v.v_x, -v.v_y, v.omega)) for at, v in laps[50:110]]
    found = checked(orca(), [*backwards, *laps[110:]])
    assert Refusal.SPEED_SIGN in found[:60]
    assert set(found[80:]) == {None}


@pytest.mark.parametrize(("turn", "refused"), [(1.55, True), (0.2, False)])
def test_a_heading_that_jumps_while_the_car_stands_is_told_and_judged_when_it_creeps(
    turn: float, refused: bool
) -> None:
    car, creep = Consistency(wheelbase=3.0, minimum_speed=5.0), 2.0
    stands = [(Pose(0.0, 0.0, turn * (k >= 20)), State(0.0, 0.0, 0.0)) for k in range(60)]
    found = checked(car, stands)
    assert [k for k, refusal in enumerate(found) if refusal is not None] == ([20] if refused else [])
    creeps = [(Pose(creep * PERIOD / 1e9 * k, 0.0, turn), State(creep, 0.0, 0.0)) for k in range(400)]
    found = [car.check((60 + k) * PERIOD, *row) for k, row in enumerate(creeps)]
    assert set(found) == ({None, Refusal.MAP_FRAME} if refused else {None})


def test_poses_that_jump_to_and_fro_are_never_believed_away_from_the_first(laps) -> None:
    car = orca()
    found = checked(car, [(at._replace(x=at.x + 5000.0 * (k % 2)), v) for k, (at, v) in enumerate(laps)])
    assert set(found[1::2]) == {Refusal.JUMPED}
    assert set(found[::2]) == {None}


def test_a_car_that_stands_or_is_carried_says_nothing_of_its_velocities() -> None:
    noise = np.random.default_rng(0).normal(0, 0.003, (200, 3))
    rows = [(Pose(*row), State(0.01, 0.0, 0.0)) for row in noise.tolist()]
    assert set(checked(orca(), rows)) == {None}


def test_after_a_gap_or_a_jump_of_time_it_begins_anew(laps) -> None:
    car = orca()
    assert car.check(0, *laps[0]) is None
    assert car.check(10**9, *laps[200]) is None
    assert car.check(0, *laps[400]) is None
    assert car.jumps == 0


def poses_of(bag: Path, signals: str) -> tuple[list[int], Vector]:
    signal_map = load_signal_map(signals)
    decoder = live_decoders(signal_map)[signal_map.odometry_topic]
    stamps, rows = [], []
    with open_bag(bag) as source:
        for topic, _, raw in source.messages([signal_map.odometry_topic]):
            message = source.decode(topic, raw)
            values = decoder.decode(message)
            stamps.append(header_stamp_ns(message))
            rows.append([values[name] for name in (*POSE_SIGNALS, *STATE_SIGNALS)])
    return stamps, np.array(rows)


def test_a_healthy_race_log_passes_but_for_its_known_bad_heading(putnam: Path) -> None:
    vehicle = load_vehicle("av21")
    car = Consistency(vehicle.constants.l_f + vehicle.constants.l_r, vehicle.minimum_speed)
    stamps, rows = poses_of(putnam, "av21")
    refused = [
        k
        for k, (stamp, row) in enumerate(zip(stamps, rows.tolist(), strict=True))
        if car.check(stamp, Pose(*row[:3]), State(*row[3:])) is not None
    ]
    assert refused == [6583], "averaged across the turn of the angle"


@pytest.mark.parametrize("name", [*DEVELOPED_ON, *HELD_OUT, "orca/ethz_pure_pursuit"])
def test_healthy_logs_pass(data: Path, name: str) -> None:
    wheelbase, slow = (0.062, 0.5) if name.startswith("orca") else (0.1735, 0.3)
    car = Consistency(wheelbase, slow)
    stamps, rows = poses_of(data / name, "default")
    found = {car.check(s, Pose(*row[:3]), State(*row[3:])) for s, row in zip(stamps, rows.tolist(), strict=True)}
    assert found == {None}
    assert car.jumps == 0
