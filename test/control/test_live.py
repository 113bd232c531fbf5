"""The controller on a car that does not wait: each command acts one T_s after the odometry that it answers."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest

from dynssm_ros.control.controller import Controller
from dynssm_ros.control.live import LiveController
from dynssm_ros.control.reference import load_reference
from dynssm_ros.control.remote import RemoteModel
from dynssm_ros.control.settings import Settings
from dynssm_ros.errors import ConfigurationError
from dynssm_ros.runtime.health import Level
from dynssm_ros.signals.history import Refusal
from dynssm_ros.simulation.external import CommandHolder, drive_by_commands
from dynssm_ros.simulation.plant import Pose, make_plant, plant_type
from dynssm_ros.vehicle import COEFFICIENTS, Applied, State
from dynssm_ros.vehicle.low_speed import LowSpeedRolling

T_S = 20_000_000  # ns
STAMP = 1_700_000_000_000_000_000


@pytest.fixture
def online(orca, club):
    """Builds the controller on the club track."""

    def build(line="centre", speed_scale=0.7, N=10, evidence=True, **options):
        reference = load_reference(line, orca, club, speed_scale)
        settings = replace(Settings.of(orca, N=N, evidence=evidence), deadline=math.inf)
        return LiveController(orca, reference, club, settings, **options)

    return build


@pytest.fixture
def steps(monkeypatch):
    """What the pilot is asked and what it decides, step by step."""
    recorded = []
    original = Controller.step

    def step(self, *given, age):
        recorded.append((*given, original(self, *given, age=age)))
        return recorded[-1][-1]

    monkeypatch.setattr(Controller, "step", step)
    return recorded


class SteppedCar:
    """The simulated car, rolling at first, that obeys each command one step late, and whose odometry may be late too."""

    def __init__(self, vehicle, track, v_x=1.5, late=0, plant="euler"):
        start = Pose(*(float(v) for v in track.centre.position(0.0)), float(track.centre.heading(0.0)))
        rolling = LowSpeedRolling(vehicle, plant_type(plant).step(vehicle))
        self.plant = make_plant(vehicle, plant, start, State(v_x, 0.0, 0.0), last=(rolling,), line=track.centre)
        self.stamp, self.sent = STAMP, Applied(0.0, 0.0)
        self.on_the_way, self.late = [], late

    def answered(self, online: LiveController, spoilt=lambda *odometry: odometry, **others):
        """One odometry message, as it is or ``spoilt``, and its answer, and the car drives on."""
        pose, seen = spoilt(self.plant.pose, self.plant.measured)
        wrapped = pose._replace(theta=math.remainder(pose.theta, 2 * math.pi))
        self.on_the_way.append((self.stamp, wrapped, seen))
        outcome = online.step(*self.on_the_way.pop(0), **others) if len(self.on_the_way) > self.late else None
        self.plant.advance(self.sent)
        self.stamp += T_S
        if isinstance(outcome, Applied):
            self.sent = outcome
        return outcome


def test_laps_from_a_standing_start_stay_between_the_borders(online, orca, club):
    controller = online("racing", 0.9, N=15)
    now = [0.0]
    holder = CommandHolder(orca, 0.2, lambda: now[0])
    last = Applied(0.0, 0.0)
    reach = orca.inputs.steering_rate * orca.sampling_time
    for k, sample in enumerate(drive_by_commands(orca, club, "euler", holder.command)):
        now[0] = k * orca.sampling_time
        command = controller.step(STAMP + k * T_S, sample.pose, sample.measured)
        assert orca.inputs.throttle[0] <= command.r <= orca.inputs.throttle[1]
        assert orca.inputs.steering[0] <= command.delta <= orca.inputs.steering[1]
        assert abs(command.delta - last.delta) <= reach * (1 + 1e-9)
        holder.receive(command)
        last = command
        if controller.laps.count == 1 or k > 500:
            break
    assert controller.laps.count == 1
    assert controller.laps.last < 5.5
    assert controller.laps.worst == 0.0
    assert controller.counts["solved"] > 0.8 * k


@pytest.mark.parametrize("late", [0, 1, 4])
def test_it_plans_from_where_the_car_is_when_the_command_acts(online, orca, club, steps, late):
    controller, car = online(delay=late * orca.sampling_time), SteppedCar(orca, club, late=late)
    assert controller.answered_after == (1 + late) * T_S
    steps.clear()
    for _ in range(40):
        car.answered(controller)
    reached = car.plant.measured
    _, _, _, feedback, decision = steps[-1]
    x, y, _, *velocities = decision.plan.x[0, :6]
    np.testing.assert_allclose(velocities, reached, atol=1e-12)
    assert math.hypot(x - car.plant.pose.x, y - car.plant.pose.y) < 2e-3 * (1 + late), "Euler's chord against the arc"
    assert feedback == steps[-2][-1].command, "the command before is what acts until then"
    assert decision.command == car.sent


def test_what_the_predictor_says_has_to_earn_its_place_in_the_plan(online, orca, club, steps):
    """The plant is the nominal car; the predictor's has far less grip."""
    controller, car = online(), SteppedCar(orca, club)
    theta = orca.nominal.copy()
    for axle in ("D_f", "D_r"):
        theta[COEFFICIENTS.index(axle)] = (
            0.5 * theta[COEFFICIENTS.index(axle)] + 0.5 * orca.lower[COEFFICIENTS.index(axle)]
        )
    for _ in range(100):
        answered = car.stamp
        car.answered(controller)
        controller.remote.adapted(answered + T_S, dict(zip(COEFFICIENTS, theta, strict=True)))
    assert controller.remote.output.source == RemoteModel.ADAPTED
    np.testing.assert_array_equal(steps[-1][-1].adapted.first.theta, orca.nominal)
    assert controller.values()["planned with calibrated"] == "1.00"


def test_what_the_predictor_says_reaches_the_plan_and_is_dropped_when_it_falls_silent(online, orca, club, steps):
    controller, car = online(max_age=0.1, evidence=False), SteppedCar(orca, club)
    theta = orca.nominal + 0.05 * (orca.upper - orca.nominal)
    theta[-1] = orca.nominal[-1]
    for _ in range(5):
        answered = car.stamp
        car.answered(controller)
        controller.remote.adapted(answered + T_S, dict(zip(COEFFICIENTS, theta, strict=True)))
        controller.remote.predicted(answered + T_S, car.plant.measured)
    np.testing.assert_array_equal(steps[-1][-1].adapted.first.theta, theta)
    assert controller.verdict() == (Level.OK, "drives, adapted coefficients")
    values = controller.values()
    assert float(values["D_f"]) == pytest.approx(theta[COEFFICIENTS.index("D_f")], rel=1e-5)
    assert values["coefficients"] == RemoteModel.ADAPTED
    assert any(float(values[f"added to {name}"]) != 0 for name in State._fields), "the plant is the nominal car"
    assert values["planned with model"] == "1.00"

    for _ in range(8):
        car.answered(controller)
    np.testing.assert_array_equal(steps[-1][-1].adapted.first.theta, orca.nominal)
    level, words = controller.verdict()
    assert level == Level.WARN
    assert "nominal car, nothing from the predictor for 0.1 s" in words


@pytest.mark.parametrize(
    ("spoilt", "by", "refusal"),
    [
        (0, math.nan, Refusal.NOT_FINITE),
        (2, math.nan, Refusal.NO_ORIENTATION),
        (3, math.inf, Refusal.NOT_FINITE),
        (5, 1e300, Refusal.IMPLAUSIBLE),
        (0, 1e300, Refusal.IMPLAUSIBLE),
        (1, 0.5, Refusal.JUMPED),
        (3, -1.5, Refusal.JUMPED),
    ],
)
def test_odometry_that_cannot_be_is_refused_and_the_drive_goes_on(online, orca, club, spoilt, by, refusal):
    controller, car = online(), SteppedCar(orca, club)
    for _ in range(5):
        car.answered(controller)
    row = [*car.plant.pose, *car.plant.measured]
    row[spoilt] = by
    assert controller.step(car.stamp, Pose(*row[:3]), State(*row[3:])) is refusal
    car.stamp += T_S
    assert isinstance(car.answered(controller), Applied)


@pytest.mark.parametrize("state", [State(-3.0, 1.0, 5.0), State(0.0, 0.0, 0.0)])
def test_whatever_is_measured_the_command_may_be_sent(online, orca, club, state):
    controller, car = online(), SteppedCar(orca, club)
    command = controller.step(car.stamp, car.plant.pose, state)
    for value, (low, high) in zip(command, (orca.inputs.throttle, orca.inputs.steering), strict=True):
        assert low <= value <= high


@dataclass(frozen=True)
class Fault:
    """What odometry becomes, message by message, as of where it begins."""

    words: str
    within: int
    """Messages until it is braked and said so."""
    odometry: Callable[[Pose, State, Pose, State], tuple[Pose, State]] = lambda pose, seen, *_: (pose, seen)
    others: Mapping[str, Any] = field(default_factory=dict)


FAULTS = {
    "frozen": Fault("the odometry stands still", 7, lambda pose, seen, *first: first),
    "pose frozen": Fault("the odometry stands still", 7, lambda pose, seen, at, was: (at, seen)),
    "pose 0.5 m beside": Fault("the pose jumped", 2, lambda pose, seen, *_: (pose._replace(x=pose.x + 0.5), seen)),
    "heading turned": Fault("the pose jumped", 2, lambda pose, seen, *_: (pose._replace(theta=pose.theta + 1.5), seen)),
    "twist in a turned frame": Fault(
        "pose and twist contradict each other",
        16,
        lambda pose, seen, *_: (pose, State(seen.v_y, -seen.v_x, seen.omega)),
    ),
    "speed negated": Fault(
        "the speed's sign is swapped", 40, lambda pose, seen, *_: (pose, State(-seen.v_x, -seen.v_y, seen.omega))
    ),
    "0.15 s late": Fault("odometry comes 0.15 s later than its fastest", 1, others={"late": 0.15}),
    "other frames": Fault("the odometry is in other frames", 1, others={"frames": ("base_link", "map")}),
}


@pytest.mark.parametrize("name", FAULTS)
def test_what_it_cannot_drive_with_is_braked_for_and_it_drives_on_when_all_is_well(online, orca, club, name):
    fault, controller, car = FAULTS[name], online(max_late=0.1), SteppedCar(orca, club)
    well = {"frames": ("map", "base_link")}
    for _ in range(20):
        assert isinstance(car.answered(controller, **well), Applied)
        assert controller.verdict()[0] != Level.ERROR
    first = car.plant.pose, car.plant.measured
    for _ in range(fault.within):
        car.answered(controller, spoilt=lambda *now: fault.odometry(*now, *first), **(well | fault.others))
        if controller.verdict() == (Level.ERROR, f"{fault.words}: brakes"):
            break
    assert controller.verdict() == (Level.ERROR, f"{fault.words}: brakes")
    assert car.sent.r == orca.inputs.throttle[0]
    for _ in range(100):
        car.answered(controller, **well)
        if not controller.brakes.reason:
            break
    assert controller.verdict()[0] != Level.ERROR, (controller.verdict(), car.plant.measured, car.plant.pose)
    assert controller.brakes.count <= 2, "to have the right pose again is a jump too"


def test_odometry_that_is_wrong_again_and_again_is_believed_no_more(online, orca, club):
    controller, car = online(), SteppedCar(orca, club)
    for _ in range(4):
        assert not controller.brakes.stays
        for _ in range(60):
            car.answered(controller, frames=("map", "base_link"))
        car.answered(controller, frames=("odom", "base_link"))
    assert controller.brakes.count == 4
    assert controller.verdict() == (Level.ERROR, "the odometry is in other frames: brakes until it is configured anew")


@pytest.mark.parametrize("anew", [0.0, 0.4], ids=["back", "elsewhere"])
def test_a_car_that_may_be_elsewhere_stands_until_its_pose_is_set_anew(online, orca, club, anew):
    controller, car = online(), SteppedCar(orca, club)
    for _ in range(20):
        car.answered(controller)
    speeds = []
    for _ in range(100):
        car.answered(controller, spoilt=lambda pose, seen: (pose._replace(y=pose.y + 0.2), seen))
        speeds.append(car.plant.measured.v_x)
    assert abs(speeds[-1]) < 0.02
    assert speeds == sorted(speeds, reverse=True), "without a break"
    assert controller.verdict() == (Level.ERROR, "the pose jumped: brakes until the pose is set anew")
    for _ in range(10):
        car.answered(controller, spoilt=lambda pose, seen: (pose._replace(y=pose.y + anew), seen))
    assert controller.brakes.reason == ""


def test_a_pose_that_jumps_and_comes_back_at_speed_is_believed_once_the_car_stands(online, orca, club):
    controller, car = online(), SteppedCar(orca, club)
    for _ in range(20):
        car.answered(controller)
    for _ in range(5):
        car.answered(controller, spoilt=lambda pose, seen: (pose._replace(theta=pose.theta + 1.5), seen))
    stood = False
    for _ in range(100):
        car.answered(controller)
        if not controller.brakes.reason:
            break
        stood = car.plant.measured.v_x < 0.2
    assert stood
    assert controller.brakes.reason == ""
    assert controller.brakes.count == 1


def test_odometry_that_comes_twice_or_late_is_refused(online, orca, club):
    controller, car = online(), SteppedCar(orca, club)
    car.answered(controller)
    car.answered(controller)
    for back in (1, 2):
        assert controller.step(car.stamp - back * T_S, car.plant.pose, car.plant.measured) is Refusal.REPEATED


def test_odometry_at_twice_the_rate_is_answered_every_other_time(online, orca, club):
    controller, car = online(), SteppedCar(orca, club)
    assert isinstance(car.answered(controller), Applied)
    half = controller.step(car.stamp - T_S // 2, car.plant.pose, car.plant.measured)
    assert half is None
    assert isinstance(car.answered(controller), Applied)


def test_time_that_jumps_back_begins_a_new_drive(online, orca, club):
    controller, car = online(), SteppedCar(orca, club)
    for _ in range(10):
        car.answered(controller)
    driven = controller.laps.s
    car = SteppedCar(orca, club)
    car.stamp -= 10**9
    car.answered(controller)
    assert controller.laps.s != driven
    assert controller.laps.lateral == pytest.approx(0.0, abs=1e-9)


def test_a_car_that_is_slower_than_the_line_is_brought_up_to_speed(online, orca, club, steps):
    controller, car = online(), SteppedCar(orca, club, v_x=0.0)
    steps.clear()
    car.answered(controller)
    assert controller.verdict()[1].startswith("gets up to speed")
    assert not steps
    for _ in range(40):
        car.answered(controller)
    assert controller.verdict()[1].startswith("drives")
    assert controller.counts["solved"] == len(steps) > 10


def test_a_predictor_that_says_nonsense_does_not_steer_a_launch(online, orca, club):
    def commands(nonsense):
        controller, car = online("racing", 0.9), SteppedCar(orca, club, v_x=0.0)
        for _ in range(12):
            if nonsense:
                controller.remote.predicted(car.stamp, (0.5, 3.0, -8.0))
            yield car.answered(controller)
            assert controller.verdict()[1].startswith("gets up to speed")

    assert list(commands(True)) == list(commands(False))


def test_a_gap_ends_the_plan_and_the_car_is_found_wherever_it_is(online, orca, club, steps):
    controller, car = online(), SteppedCar(orca, club)
    for _ in range(10):
        car.answered(controller)
    s = 0.6 * club.length
    elsewhere = Pose(*(float(v) for v in club.centre.position(s)), float(club.centre.heading(s)))
    outcome = controller.step(car.stamp + 10**9, elsewhere, State(1.0, 0.0, 0.0))
    assert isinstance(outcome, Applied)
    assert controller.laps.s % club.length == pytest.approx(s, abs=1e-6)
    assert steps[-1][-1].plan.status == "solved"


def test_far_off_the_road_it_brakes_and_says_so(online, orca, club):
    controller, car = online(), SteppedCar(orca, club)
    for _ in range(5):
        car.answered(controller)
    beside = Pose(*(float(v) for v in club.centre.position(0.3, -3 * 0.4)), 0.0)
    car.stamp += 10**9  # a gap, else the pose jumps
    assert controller.step(car.stamp, beside, State(1.0, 0.0, 0.0)).r == orca.inputs.throttle[0]
    level, words = controller.verdict()
    assert level == Level.ERROR
    assert "m outside the borders: brakes" in words
    car.stamp += 10**9
    for _ in range(6):
        car.answered(controller)
    assert controller.verdict()[0] != Level.ERROR


def test_off_the_road_after_a_gap_it_brakes_until_it_is_back(online, orca, club):
    controller, car = online(), SteppedCar(orca, club)
    for _ in range(5):
        car.answered(controller)
    beside = Pose(*(float(v) for v in club.centre.position(0.3, -0.25)), float(club.centre.heading(0.3)))
    car.stamp += 10**9
    for k in range(20):  # the road's borders are 0.2 m from its centre
        command = controller.step(car.stamp + k * T_S, beside, State(0.0, 0.0, 0.0))
        assert command.r == orca.inputs.throttle[0]
        assert "0.05 m outside the borders: brakes" in controller.verdict()[1]
    car.stamp += 10**9
    for _ in range(10):
        car.answered(controller)
    assert controller.verdict()[0] != Level.ERROR


def test_a_delay_beyond_what_can_be_carried_over_is_refused(online):
    with pytest.raises(ConfigurationError, match=r"delay 0.38 s: expected less than 19 times T_s"):
        online(delay=0.38)
    with pytest.raises(ConfigurationError, match=r"delay -1 s: expected 0 to 0.4 s"):
        online(delay=-1.0)


def test_without_a_place_the_brakes_hold_the_steering(online, orca, club):
    controller, car = online(), SteppedCar(orca, club)
    for _ in range(20):
        car.answered(controller)
    assert controller.brake() == (orca.inputs.throttle[0], car.sent.delta)
    assert controller.brake(car.stamp + 11 * 10**9) == (orca.inputs.throttle[0], car.sent.delta), (
        "too far to be reckoned"
    )


@pytest.mark.parametrize(
    ("fault", "driven"),
    [
        pytest.param(
            fault, driven, marks=[] if (fault, driven) in {("frozen", 210), ("silent", 255)} else pytest.mark.slow
        )
        for fault in ("frozen", "silent")
        for driven in (120, 165, 210, 255, 300)
    ],
)
def test_it_brakes_along_the_line_without_seeing_it(online, orca, club, driven, fault):
    """From full speed, by a car that slides otherwise than the controller's; with the steering held it would leave the
    road by up to a metre."""
    controller, car = online("racing", 0.9, N=15), SteppedCar(orca, club, plant="double_track")
    for _ in range(driven):
        car.answered(controller)
    assert controller.verdict()[0] != Level.ERROR
    first, room = (car.plant.pose, car.plant.measured), []
    for k in range(150):
        if fault == "frozen":
            car.answered(controller, spoilt=lambda *_: first)
        else:
            if k > 10:
                controller.brakes.apply("silent")
                car.sent = controller.brake(car.stamp + controller.answered_after)
            car.plant.advance(car.sent)
            car.stamp += T_S
        room.append(float(club.clearance(np.array(car.plant.pose[:2])[None])[0]))
    assert car.plant.measured.v_x < 0.1
    assert min(room) > -0.02


def test_late_plans_are_counted_and_told(orca, club):
    reference = load_reference("centre", orca, club, 0.7)
    controller = LiveController(orca, reference, club, replace(Settings.of(orca, N=10), deadline=0.0))
    car = SteppedCar(orca, club)
    for _ in range(5):
        assert isinstance(car.answered(controller), Applied)
    assert controller.counts["late"] == 4, "the first plan may take its time"
    level, words = controller.verdict()
    assert level == Level.WARN
    assert "4 of 5 plans infeasible or late" in words


def test_before_the_first_odometry_there_are_figures_too(online):
    values = online().values()
    assert values["laps"] == "0"
    assert values["plans solved"] == "0", "what warms it up does not count"
    assert values["step p99 (ms)"] == "nan"
