"""The table and the report of a race."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from dynssm_ros.control.race import Course, Race
from dynssm_ros.reporting.page import Report, Section
from dynssm_ros.reporting.race_figures import (
    coefficients,
    compared_forces,
    evidence,
    forces,
    learning,
    profiles,
    stamp_period,
    trajectories,
)
from dynssm_ros.reporting.tables import Column, Table, Value

VIOLATION = "A violation is the car's centre of gravity outside the borders at any sample."


def race_json(races: Sequence[Race]) -> dict[str, Any]:
    """The result for programs."""
    course = races[0].course
    return {
        "track": course.track.name,
        "track_length_m": course.track.length,
        "vehicle": course.vehicle.name,
        "effects": [entry.model_dump() for entry in course.vehicle.effects],
        "plant": course.plant,
        "objective": course.settings.objective,
        "line": course.reference.name,
        "line_lap_time_s": course.reference.lap_time,
        "line_full_throttle_s": course.reference.full_throttle_time,
        "horizon": course.settings.N,
        "offset_free": course.settings.follows == "always",
        "as_is": not course.settings.evidence,
        "laps": course.laps,
        "noise": list(course.sensing.noise),
        "pose_noise": list(course.sensing.pose_noise),
        "delay_s": course.delay,
        "seed": course.sensing.seed,
        "learn": course.learning is not None,
        "models": {race.name: race.to_json() for race in races},
    }


def race_table(races: Sequence[Race]) -> Table:
    """One row per model."""
    columns = (
        Column("model", brief=True),
        Column("lap", "s", best="min", brief=True),
        Column("violation", brief=True),
        Column("outside", "m"),
        Column("v_x", "m/s", "mean", "max", brief=True),
        Column("|v_y|", "m/s", "mean"),
        Column("|ω|", "rad/s", "mean"),
        Column("steering variation", "rad"),
        Column("p50", "ms", "control step", brief=True),
        Column("p99", "ms", "control step", brief=True),
        Column("infeasible", "", "plans"),
        Column("late", "", "plans"),
        Column("missing", "", "plans", brief=True),
    )
    return Table(columns, [_row(race) for race in races], VIOLATION)


def _row(race: Race) -> list[Value]:
    figures = race.to_json()
    return [
        race.name,
        figures["lap_time_s"],
        "yes" if figures["violation"] else "no",
        figures["outside_m"],
        figures["mean_v_x"],
        figures["mean_abs_v_y"],
        figures["mean_abs_omega"],
        figures["steering_total_variation"],
        figures["solve_ms"]["p50"],
        figures["solve_ms"]["p99"],
        race.infeasible,
        race.late,
        race.infeasible + race.late,
    ]


def race_report(races: Sequence[Race]) -> Report:
    """The race as a page."""
    course = races[0].course
    sections = [
        Section(
            "Trajectories",
            f"The path of each model between the borders, with a mark every {stamp_period(races):g} s; the line that the "
            "controller follows is dashed.",
            trajectories(races),
        ),
        Section(
            "State and commands", "Velocities and what the controller commanded, over the position on the lap.",
            profiles(races),
        ),
        Section(
            "Forces", "Lateral forces of front and rear axle and the drive force at the states and commands that were "
            "driven, as each model estimates them with its coefficients. Dashed are the driven car's own, with "
            f"{compared_forces(races).name}.",
            forces(races),
        ),
        Section(
            "Coefficients",
            "What the controller planned with, step by step: the coefficients that a model moves, and what is added to the "
            "stepped velocities, by the model and, if offset-free, for what it mispredicts. Where the driven car has effects "
            "that amount to a change of a coefficient, the dashed line is what it comes to with them.",
            coefficients(races),
        ),
    ]  # fmt: skip
    if course.settings.evidence and any(race.weights[:, 0].min() < 1.0 for race in races):
        sections.append(
            Section(
                "Evidence",
                "How much of each model was planned with. Without evidence it is the calibrated car (0). A model's "
                "coefficients, and what it adds beside them, count as soon as they have predicted the last horizons better.",
                evidence(races),
            )
        )
    if any(race.learned for race in races):
        sections.insert(
            0,
            Section(
                "Faster every lap",
                "Lap times. The share of the file's car's accelerations that each lap was driven with: mean over its "
                "sections, the least and the largest. How close the car came to a border: 1 is a wheel on it, and from 0.75 "
                "on a section is driven slower. The grip of the sections over that of the coefficients beside it. The "
                "coefficients that were calibrated on the laps before, with two standard deviations; the dashed line is what "
                "the effects of the driven car come to.",
                learning(races),
            ),
        )
    return Report(f"Race on {course.track.name}", summary(races), sections, _protocol(course), race_table(races))


def summary(races: Sequence[Race]) -> str:
    """The result in a sentence or two."""
    done = [race for race in races if race.completed]
    lost = [f"{race.name} {race.failure}" for race in races if not race.completed]
    outside = [race.name for race in done if race.outside > 0]
    text = f"No model completed {_laps(races[0].course)}."
    if done:
        laps = {race.name: f"{np.mean(race.lap_times):.3f}" for race in done}
        best = min(laps.values(), key=float)
        fastest = [name for name, lap in laps.items() if lap == best]
        text = f"{', '.join(fastest)} {'is' if len(fastest) == 1 else 'are'} the fastest with {best} s a lap."
    if outside:
        text += f" Outside the borders: {', '.join(outside)}."
    return text + (f" Not completed: {'; '.join(lost)}." if lost else "")


def _laps(course: Course) -> str:
    return "a lap" if course.laps == 1 else f"{course.laps} laps"


def _protocol(course: Course) -> dict[str, str]:
    settings, effects = course.settings, course.vehicle.effects
    weights = ", ".join(f"{name} {value:g}" for name, value in asdict(settings.weights).items())
    return {
        "Track": f"{course.track.name}, {course.track.length:.4g} m, {_laps(course)}",
        "Plant": f"{course.vehicle.name}, {course.plant}"
        + (f", with {', '.join(entry.name for entry in effects)}" if effects else ""),
        "Start": f"{_start(course)}, actuators at zero; the first lap counts from there. Until its window is full a model "
        "drives with its nominal coefficients",
        "Line": f"{course.reference.name}, {course.reference.line.length:.4g} m, {course.reference.lap_time:.3f} s at its "
        f"own speed, {course.reference.full_throttle_time:.3f} s with no more than full throttle",
        "Controller": f"{settings.objective}, {settings.N} steps of {course.vehicle.sampling_time:g} s, late after "
        f"{1e3 * settings.deadline:g} ms; weights {weights}, in wheelbases and units of {settings.scale.time:.3g} s; what a "
        f"model mispredicts is {_FOLLOWED[settings.follows]}; what it adapts is "
        f"planned with {'where it was better over the last horizons' if settings.evidence else 'as it is'}",
        "Measured": _measured(course),
        "Time": "of a control step: model and plan together, the processor's time on one core",
        "Violation": VIOLATION,
    }


_FOLLOWED = {
    "chosen": "added to it at a rate that the data choose", "always": "added to it (offset-free)", "never": "left as it is",
}  # fmt: skip


def _measured(course: Course) -> str:
    """What comes between the car and its controller."""
    sensing = course.sensing
    if not any((*sensing.noise, *sensing.pose_noise)):
        noise = "without noise"
    else:
        velocities, pose = (", ".join(f"{std:g}" for std in part) for part in (sensing.noise, sensing.pose_noise))
        noise = (
            f"with white noise of {velocities} (m/s, m/s, rad/s) and {pose} (m, m, rad), seed {sensing.seed}, which the "
            "controller filters"
        )
    late = f", {1e3 * course.delay:g} ms late, which the controller knows" if course.delay else ""
    return noise + late


def _start(course: Course) -> str:
    speed = course.starting()[1].v_x
    return "standing" if speed == 0 else f"rolling at {speed:.3g} m/s"
