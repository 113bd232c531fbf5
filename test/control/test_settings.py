"""The controller's settings mean the same for cars of any size."""

import math
from dataclasses import replace

import numpy as np
import pytest

from dynssm_ros.control.horizon_model import HorizonModel
from dynssm_ros.control.nmpc import Adapted, Nmpc
from dynssm_ros.control.reference import Reference
from dynssm_ros.control.settings import Scale, Settings
from dynssm_ros.track.tracks import Track
from dynssm_ros.vehicle import CarModel, load_vehicle
from dynssm_ros.vehicle.limits import vehicle_limits

SIZE = 3.0


def enlarged(vehicle, size):
    """The same car ``size`` times as long with the same forces: accelerations stay, times grow by the root of the size."""
    time = math.sqrt(size)
    content, constants, inputs = vehicle.model_dump(), vehicle.constants, vehicle.inputs
    content["constants"] |= {name: getattr(constants, name) * size for name in ("l_f", "l_r", "h_cg")}
    content["sampling_time"] *= time
    content["inputs"]["steering_rate"] = inputs.steering_rate / time
    for name, factor in (("I_z", size**2), ("C_m2", 1 / time), ("C_r2", 1 / size)):
        entry = content["coefficients"][name]
        entry["nominal"] *= factor
        entry["bounds"] = [bound * factor for bound in entry["bounds"]]
    return type(vehicle).model_validate(content)


def test_the_scale_is_the_wheelbase_and_the_time_of_its_grip(orca):
    scale = Scale.of(orca)
    assert scale.length == pytest.approx(0.062)
    assert scale.length / scale.time**2 == pytest.approx(np.min(vehicle_limits(orca).lateral))
    large = Scale.of(enlarged(orca, SIZE))
    assert large.length == pytest.approx(SIZE * scale.length)
    assert large.time == pytest.approx(math.sqrt(SIZE) * scale.time, rel=1e-3)


@pytest.mark.parametrize(("name", "steps"), [("orca", 15), ("av21", 40)])
def test_every_car_sees_as_far_in_its_own_time(name, steps):
    vehicle = load_vehicle(name)
    settings = Settings.of(vehicle)
    assert steps == settings.N
    assert settings.N * vehicle.sampling_time == pytest.approx(3.5 * settings.scale.time, rel=0.02)


def test_no_axle_is_to_be_used_beyond_what_its_tyres_give():
    """The Indy car's B, C, E are 10, 1.5 and -0.5 on both axles: the front to 98 % of its peak, the rear to 95 %."""
    slip = np.linspace(0, 0.3, 30001)
    force = np.sin(1.5 * np.arctan(10 * slip + 0.5 * (10 * slip - np.arctan(10 * slip))))
    front, rear = Settings.of(load_vehicle("av21")).slip
    assert front == pytest.approx(slip[np.argmax(force >= 0.98)], abs=1e-3)
    assert rear == pytest.approx(slip[np.argmax(force >= 0.95)], abs=1e-3)


@pytest.mark.parametrize("objective", ["tracking", "progress"])
def test_a_car_of_any_size_is_driven_alike(orca, club, club_line, objective):
    """All lengths nine times as large and all times three times: the same plan in units of the car, beside the line too."""
    plans = []
    for size in (1.0, SIZE):
        car, time = enlarged(orca, size), math.sqrt(size)
        track: Track = club.scaled(size)
        line = Reference("line", club_line.line.scaled(size), club_line.speed * time)
        settings = replace(Settings.of(car, objective, 10), deadline=math.inf)  # of no machine
        nmpc = Nmpc(HorizonModel(CarModel.at_any_speed(car), settings.N), car.inputs, line, track, settings)
        (x, y), heading = line.line.position(size * 1.0, size * 0.03), float(line.line.heading(size * 1.0))
        speed = 0.95 * float(line.speed_at(size * 1.0))
        now = np.array([x, y, heading, speed, 0.0, 0.0, 0.2, 0.05])
        for _ in range(3):
            plan = nmpc.plan(now, Adapted(car.nominal, np.zeros(3)))
        assert plan.status == "solved"
        plans.append((plan.u, plan.x / [size, size, 1, time, time, 1 / time, 1, 1]))
    (u, x), (large_u, large_x) = plans
    np.testing.assert_allclose(large_u, u, atol=2e-3)
    np.testing.assert_allclose(large_x, x, rtol=2e-3, atol=2e-3)
