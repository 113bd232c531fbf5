"""The 1:43 car, a circle and a small track, with a controller on them."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from dynssm_ros.control.horizon_model import HorizonModel
from dynssm_ros.control.nmpc import Nmpc
from dynssm_ros.control.reference import Reference, load_reference
from dynssm_ros.control.settings import Settings
from dynssm_ros.track.lines import Line
from dynssm_ros.track.tracks import Track, load_track
from dynssm_ros.vehicle import COEFFICIENTS, CarModel, load_vehicle

N = 10


def symmetric(vehicle):
    """The same car with neither horizontal nor vertical shifts: what it does to the left it does to the right."""
    shifts = np.array([name.startswith("S_") for name in COEFFICIENTS])
    return vehicle.with_nominal(np.where(shifts, 0.0, vehicle.nominal))


@pytest.fixture(scope="session")
def orca():
    return load_vehicle("orca")


@pytest.fixture(scope="session")
def symmetric_orca(orca):
    return symmetric(orca)


@pytest.fixture(scope="session")
def club():
    return load_track("club")


@pytest.fixture(scope="session")
def club_line(orca, club):
    return load_reference("racing", orca, club)


@pytest.fixture(scope="session")
def circle():
    """Builds a circular track driven to the left (``side`` 1) or right (-1), with its centre line at constant speed."""

    def build(side=1, radius=1.0, speed=1.5):
        angle = side * np.linspace(0, 2 * np.pi, 200, endpoint=False)
        line = Line(radius * np.stack([np.cos(angle), np.sin(angle)], axis=1))
        width = np.full(200, 0.2)
        return Track("circle", line, width, width), Reference("circle", line, np.full(200, speed))

    return build


@pytest.fixture(scope="session")
def horizon_model(orca):
    return HorizonModel(CarModel(orca.constants, orca.sampling_time, (), "rk4", 2), N)


@pytest.fixture
def controller(horizon_model, orca):
    """Builds a controller of the 1:43 car on ``(track, reference)``."""

    def build(track, reference, objective="tracking", deadline=math.inf, slip=None, lag_bound=None, N=N, **options):
        settings = replace(Settings.of(orca, objective, N), deadline=deadline)
        settings = settings if slip is None else replace(settings, slip=slip)
        settings = settings if lag_bound is None else replace(settings, lag_bound=lag_bound)
        model = horizon_model if horizon_model.N == N else HorizonModel(horizon_model.car, N)
        return Nmpc(model, orca.inputs, reference, track, settings, **options)

    return build
