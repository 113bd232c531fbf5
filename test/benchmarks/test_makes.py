"""Cars of other makes on four wheels: what each part of them does, and how their drives are judged."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.hidden_causes import makes
from dynssm_ros.simulation.double_track import DoubleTrack
from dynssm_ros.simulation.plant import Pose, Rk4Plant
from dynssm_ros.vehicle import Applied, CarModel, Coefficients, State, load_vehicle
from dynssm_ros.vehicle.single_track import Motion, StageEffect

AV21 = load_vehicle("av21")
PLAIN = makes.FourWheels.of(AV21.constants)
BEND = State(20.0, -0.1, 0.3), Applied(0.3, 0.05)


def motion(body: StageEffect, state: State = BEND[0], applied: Applied = BEND[1]) -> Motion:
    return CarModel(AV21.constants, 0.02, (body,)).motion(state, applied, Coefficients(*AV21.nominal))


def test_without_what_is_drawn_it_is_the_car_with_four_wheels() -> None:
    here, there = motion(PLAIN), motion(DoubleTrack.of(AV21.constants))
    assert (here.a_x, here.a_y, here.omega_dot) == (there.a_x, there.a_y, there.omega_dot)


def test_a_car_is_the_same_to_the_left_and_to_the_right() -> None:
    body = makes.FourWheels.drawn(AV21, 1)
    left, right = motion(body), motion(body, State(20.0, 0.1, -0.3), Applied(0.3, -0.05))
    np.testing.assert_allclose(
        [right.a_x, -right.a_y, -right.omega_dot], [left.a_x, left.a_y, left.omega_dot], rtol=1e-9
    )


def test_a_lock_turns_the_car_out_of_the_bend_and_soft_steering_takes_force_from_the_front() -> None:
    tight = State(20.0, -0.1, 1.0)
    moved = -0.3 * abs(motion(PLAIN, tight).F_d) * PLAIN.width / 2
    assert motion(replace(PLAIN, lock=0.3), tight).M_z - motion(PLAIN, tight).M_z == pytest.approx(moved, rel=2e-3)
    assert motion(replace(PLAIN, lock=0.3), State(20.0, 0.0, 0.0), Applied(0.3, 0.0)).M_z == pytest.approx(
        0.0, abs=1e-9
    )
    assert motion(replace(PLAIN, compliance=0.01)).F_fy < motion(PLAIN).F_fy


@pytest.mark.parametrize("make", list(makes.MAKES))
def test_steps_of_5_ms_are_those_of_1_ms(make: str) -> None:
    vehicle, body = load_vehicle(make).model_copy(update={"sampling_time": 0.02}), makes.Make(3)

    class Fine(Rk4Plant):
        def first(self, vehicle: object) -> tuple[StageEffect, ...]:
            return body.first(load_vehicle(make))

    start = Pose(0.0, 0.0, 0.0), State(10.0, 0.0, 0.0)
    cars = [each.make(vehicle, *start, (), None) for each in (body, Fine())]
    for k in range(50):
        for car in cars:
            car.advance(Applied(0.4, 0.04 * np.sin(0.2 * k)))
    np.testing.assert_allclose(cars[0].state, cars[1].state, rtol=1e-4, atol=1e-5)


def test_drives_are_judged_by_what_is_named_and_what_such_a_car_has() -> None:
    def answer(hidden: dict[str, dict[str, float]], *named: str, moved: str = "") -> makes.Answer:
        return makes.Answer("sedan", hidden, "cause", named, frozenset({*named, moved}), (), 12.0)

    stronger, drag = {"drive_gain": {"factor": 1.04}}, {"drag": {"coefficient": 0.4}}
    found = [
        answer({}), answer({}, "load_sensitivity"), answer({}, "steering_curve"), answer(stronger, moved="C_m1"),
        answer(stronger, "drag"), answer(drag, "drag"),
    ]  # fmt: skip
    words = makes.page(found)
    assert [one.not_there for one in found] == [(), (), ("steering_curve",), (), ("drag",), ()]
    for row in (
        "| `steering_curve` is named | 1 of 6 | 17 % |", "no structure of such a car | 1 of 3 | 33 % |",
        "| the drive force 4 % larger is found | 1 of 2 | 50 % |", "| sedan | drag 0.4 | cause | drag | 12 s |",
    ):  # fmt: skip
        assert row in words
