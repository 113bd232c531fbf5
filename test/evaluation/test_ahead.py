"""What is planted in the errors half a second ahead is named, and nothing in a healthy drive."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from dynssm_ros.arrays import Vector
from dynssm_ros.evaluation.residuals.ahead import patterns_ahead
from dynssm_ros.evaluation.residuals.patterns import Pattern
from dynssm_ros.identification.problem.car import CarEstimate
from dynssm_ros.identification.problem.windows import fit_windows, recorded_rows
from dynssm_ros.signals.recording import Recording
from dynssm_ros.simulation.laps import as_recording, simulate
from dynssm_ros.track.tracks import load_track
from dynssm_ros.vehicle import load_vehicle

AV21 = load_vehicle("av21")
TRACK = load_track("road_course")


@pytest.fixture(scope="module")
def log() -> Recording:
    return as_recording(simulate(AV21, TRACK, duration=80.0, noise=(0.02, 0.02, 0.003), seed=5))


def found(log: Recording, **changed: Vector) -> list[Pattern]:
    spoilt = replace(log, columns=log.columns | changed)
    windows = fit_windows(spoilt, recorded_rows(spoilt, {}), 0.5, 5.0).with_integrator("euler", AV21)
    return list(patterns_ahead(windows, CarEstimate.of(AV21), spoilt, TRACK.centre))


def swinging(force: Vector, T_s: float) -> Vector:
    """Speed of a mass on a spring of 0.6 Hz that a force shakes, an explicit step of each sampling time."""
    aside, speed, w = 0.0, 0.0, 2 * np.pi * 0.6
    out = np.empty_like(force)
    for k, each in enumerate(force):
        speed += T_s * (each - w**2 * aside - 0.2 * w * speed)
        aside += T_s * speed
        out[k] = 0.05 * speed
    return out


def test_nothing_is_found_where_only_the_sensors_are_noisy(log: Recording) -> None:
    assert found(log) == []


@pytest.mark.parametrize(
    ("channel", "spoil", "words"),
    [
        (
            "omega",
            lambda log: log["omega"] + 0.015 * np.sin(2 * np.pi * log.elapsed / 3.3),
            "every 3.3 s|every 3.29 s|every 3.31 s",
        ),
        (
            "v_y",
            lambda log: log["v_y"] + 0.1 * np.gradient(log["v_x"], log.T_s).clip(-5, 5),
            "throttle|acceleration|braking",
        ),
        ("omega", lambda log: log["omega"] * (0.9 + 0.0025 * log.elapsed), "time"),
        ("v_y", lambda log: log["v_y"] + 2.0 * swinging(log["v_x"] * log["omega"], log.T_s), "steering"),
        ("v_x", lambda log: log["v_x"] + lfilter([0.02], [1.0, -0.92], log["r_fb"] < -0.02), "braking|throttle"),
    ],
    ids=["swing", "pitching", "drift", "slosh", "brakes"],
)
def test_what_is_planted_is_the_largest_pattern_of_its_channel(
    log: Recording, channel: str, spoil: Callable[[Recording], Vector], words: str
) -> None:
    first = next(each for each in found(log, **{channel: spoil(log)}) if each.channel == channel)
    assert any(word in first.words for word in words.split("|")), first.words
    assert first.share > 0.1
    assert first.picture is not None
