"""The table and the report of a race."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from dynssm_ros.control.race import Course, Race
from dynssm_ros.reporting.page import Prose, Report
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
from dynssm_ros.reporting.tables import Column, Table

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
    found = {race.name: race.to_json() for race in races}
    means = ("mean_v_x", "mean_abs_v_y", "mean_abs_omega")
    return Table.of(
        races,
        (Column("model", brief=True), lambda race: race.name),
        (Column("lap", "s", best="min", brief=True), lambda race: found[race.name]["lap_time_s"]),
        (Column("violation", brief=True), lambda race: "yes" if race.outside > 0 else "no"),
        (Column("outside", "m"), lambda race: race.outside),
        (
            (
                Column("v_x", "m/s", "mean", "max", brief=True),
                Column("|v_y|", "m/s", "mean"),
                Column("|ω|", "rad/s", "mean"),
            ),
            lambda race: [found[race.name][mean] for mean in means],
        ),
        (Column("steering variation", "rad"), lambda race: found[race.name]["steering_total_variation"]),
        (Column("p50", "ms", "control step", brief=True), lambda race: found[race.name]["solve_ms"]["p50"]),
        (Column("p99", "ms", "control step", brief=True), lambda race: found[race.name]["solve_ms"]["p99"]),
        (Column("infeasible", "", "plans"), lambda race: race.infeasible),
        (Column("late", "", "plans"), lambda race: race.late),
        (Column("missing", "", "plans", brief=True), lambda race: race.infeasible + race.late),
        caption=VIOLATION,
    )


def race_report(races: Sequence[Race]) -> Report:
    """The race as a page."""
    course = races[0].course
    prose = Prose("race", period=stamp_period(races), compared=compared_forces(races).name)
    figures = {"learning": learning} if any(race.learned for race in races) else {}
    figures |= {"trajectories": trajectories, "profiles": profiles, "forces": forces, "coefficients": coefficients}
    if course.settings.evidence and any(race.weights[:, 0].min() < 1.0 for race in races):
        figures["evidence"] = evidence
    sections = [prose.section(name, draw(races)) for name, draw in figures.items()]
    return Report(f"Race on {course.track.name}", summary(races), sections, _protocol(course, prose), race_table(races))


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
        each = " a lap" if races[0].course.track.centre.closed else ""
        text = f"{', '.join(fastest)} {'is' if len(fastest) == 1 else 'are'} the fastest with {best} s{each}."
    if outside:
        text += f" Outside the borders: {', '.join(outside)}."
    return text + (f" Not completed: {'; '.join(lost)}." if lost else "")


def _laps(course: Course) -> str:
    if not course.track.centre.closed:
        return "an open road"
    return "a lap" if course.laps == 1 else f"{course.laps} laps"


def _protocol(course: Course, prose: Prose) -> dict[str, str]:
    settings, effects, speed = course.settings, course.vehicle.effects, course.starting()[1].v_x
    return prose.protocol(
        course=course,
        settings=settings,
        line=course.reference,
        laps=_laps(course),
        effects=f", with {', '.join(entry.name for entry in effects)}" if effects else "",
        start="standing" if speed == 0 else f"rolling at {speed:.3g} m/s",
        deadline_ms=1e3 * settings.deadline,
        weights=", ".join(f"{name} {value:g}" for name, value in asdict(settings.weights).items()),
        followed=_FOLLOWED[settings.follows],
        adapted="where it was better over the last horizons" if settings.evidence else "as it is",
        measured=_measured(course),
        violation=VIOLATION,
    )


_FOLLOWED = {
    "chosen": "added to it at a rate that the data choose", "always": "added to it (offset-free)", "never": "left as it is",
}  # fmt: skip


def _measured(course: Course) -> str:
    """What comes between the car and its controller."""
    sensing, noise = course.sensing, "without noise"
    if any((*sensing.noise, *sensing.pose_noise)):
        velocities, pose = (", ".join(f"{std:g}" for std in part) for part in (sensing.noise, sensing.pose_noise))
        noise = (
            f"with white noise of {velocities} (m/s, m/s, rad/s) and {pose} (m, m, rad), seed {sensing.seed}, which the "
            "controller filters"
        )
    return noise + (f", {1e3 * course.delay:g} ms late, which the controller knows" if course.delay else "")
