"""The figures of a race: paths, states, forces, coefficients, what a car learns lap by lap."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from scipy.spatial import cKDTree

from dynssm_ros.arrays import Vector
from dynssm_ros.control.race import Race
from dynssm_ros.control.race_models import TRUE
from dynssm_ros.evaluation.coefficients import coefficient_label
from dynssm_ros.reporting.evaluation_figures import MEASURED, SYMBOLS, UNITS, WIDTH, model_colours, styled
from dynssm_ros.signals.signal_map import STATE_SIGNALS
from dynssm_ros.vehicle import COEFFICIENTS, Applied, CarModel, Coefficients, State
from dynssm_ros.vehicle.single_track import Motion, lateral_force

_ENLARGED = 6.0  # where the paths part is enlarged if it is smaller than the track by this factor
_STAMPS = 0.5  # s between the time stamps on the map
_MOVED = (
    1e-3  # share of its bounds that a coefficient must move, and of a state's range that must be added, to be shown
)
_LEARNED = 4  # coefficients in the figure of a car that learns
_ANSWERS = 6  # coefficients at most in a figure of hidden effects


@styled
def trajectories(races: Sequence[Race]) -> Figure:
    """Paths on the track with marks at equal times; on a large track also, enlarged, where they part most.

    Args:
        races: on one course.
    """
    place, side = _parting(races)
    across, up = np.ptp(races[0].course.track.centre.points, axis=0)
    enlarged = side * _ENLARGED < np.hypot(across, up)
    height = (0.6 if enlarged else 0.9) * min(up / across, 1.0)
    figure = Figure(figsize=(WIDTH, WIDTH * max(height, 0.35) + 0.9), layout="constrained")
    if not enlarged:
        plan = figure.subplots()
    else:
        plan, near = figure.subplots(1, 2, width_ratios=(2, 1))
        _draw_paths(near, races)
        near.set(xlim=place[0] + np.array([-side, side]) / 2, ylim=place[1] + np.array([-side, side]) / 2)
        near.set_title("where the paths part most", fontsize=9)
        plan.indicate_inset_zoom(near, edgecolor="black")
    _draw_paths(plan, races)
    every = max(1, round(stamp_period(races) / races[0].course.vehicle.sampling_time))
    for k in range(0, len(races[0].time), 2 * every):
        x, y = (float(value) for value in races[0].pose[k, :2])
        plan.annotate(
            f"{round(float(races[0].time[k]), 2):g} s", (x, y), textcoords="offset points", xytext=(4, 4), fontsize=7
        )
    figure.legend(*plan.get_legend_handles_labels(), loc="outside upper left", ncols=4)
    return figure


def _parting(races: Sequence[Race]) -> tuple[Vector, float]:
    """Where another path is farthest from the first one, or that from the line if it is alone, and three widths there (m)."""
    first, *others = (race.pose[:, :2] for race in sorted(races, key=lambda race: not race.completed))
    points = np.concatenate(others or [races[0].course.reference.line.points])
    apart = cKDTree(first).query(points)[0]
    place, track = points[np.argmax(apart)], races[0].course.track
    return place, 3.0 * float(sum(track.widths(track.centre.project(place)[0])))


def _draw_paths(axes: Axes, races: Sequence[Race]) -> None:
    course, colours = races[0].course, model_colours([race.name for race in races])
    for border in (course.track.left_border, course.track.right_border):
        axes.plot(*np.concatenate([border, border[:1]]).T, color=MEASURED, lw=1.0)
    line = course.reference.line.points
    axes.plot(
        *np.concatenate([line, line[:1]]).T, color="#777777", lw=0.8, ls="--", label=f"{course.reference.name} line"
    )
    T_s = course.vehicle.sampling_time
    every = max(1, round(stamp_period(races) / T_s))
    for race, width in zip(races, widths(len(races)), strict=True):
        axes.plot(*race.pose[:, :2].T, color=colours[race.name], lw=width, label=race.name)
        marks = race.pose[::every]
        axes.plot(*marks[:, :2].T, "o", color=colours[race.name], mec="white", mew=0.5, ms=4, zorder=3)
    axes.set(aspect="equal", xlabel="x (m)", ylabel="y (m)")


def widths(count: int) -> list[float]:
    """Of the lines of ``count`` models: those drawn first are wider, so that cars that drive alike are all seen."""
    return [float(width) for width in np.linspace(min(count, 3), 1.0, count)]


def stamp_period(races: Sequence[Race]) -> float:
    """Time between marks: ``_STAMPS``, or more where a lap takes minutes."""
    return _STAMPS * max(1, round(max(float(race.time[-1]) for race in races) / (40 * _STAMPS)))


@styled
def profiles(races: Sequence[Race]) -> Figure:
    """State and commands over the position on the track."""
    rows = [(f"{SYMBOLS[c]} ({UNITS[c]})", k, "state") for k, c in enumerate(STATE_SIGNALS)]
    rows += [("throttle", 0, "command"), ("steering (rad)", 1, "command")]
    return _panels(races, [(label, [getattr(race, what)[:, k] for race in races]) for label, k, what in rows])


@styled
def forces(races: Sequence[Race]) -> Figure:
    """Axle and drive forces over the position on the track: as each model estimates them, and the driven car's own."""
    along = compared_forces(races)
    estimated, driven = [_estimated(race) for race in races], _motion(along)
    rows = {"F_fy": "$F_{fy}$ (N)", "F_ry": "$F_{ry}$ (N)", "F_d": "$F_d$ (N)"}
    return _panels(
        races,
        [(label, [getattr(each, name) for each in estimated]) for name, label in rows.items()],
        {label: getattr(driven, name) for name, label in rows.items()},
        along,
    )


def compared_forces(races: Sequence[Race]) -> Race:
    """The race whose forces are shown as they were: the longest one, not of the plant's own model, which has no others."""
    return max(races, key=lambda race: (race.name != TRUE, race.s[-1] - race.s[0]))


def _estimated(race: Race) -> Motion:
    """The equations of motion with the coefficients that a model planned with; the plant's own knows its effects."""
    return _motion(race) if race.name == TRUE else _motion(race, with_effects=False, theta=race.theta)


def _motion(race: Race, with_effects: bool = True, theta: Vector | None = None) -> Motion:
    """The equations of motion at what was driven; states of effects are settled.

    Args:
        race: whose states and commands.
        with_effects: whether the driven car's effects act.
        theta: coefficients ``(n, 17)``; ``None``: the driven car's.
    """
    course = race.course
    x, y, heading = race.pose.T
    centre = course.track.centre
    place = {"s": race.s, "lap_length": centre.length, "bend": centre.bend(race.s)}
    context = {"t": race.time, **place, "x": x, "y": y, "theta": heading}
    vehicle = course.vehicle
    effects = [effect for effect in vehicle.active_effects if with_effects and not effect.SENSOR]
    acting = Coefficients(*(vehicle.nominal if theta is None else theta.T))
    car = CarModel(vehicle.constants, vehicle.sampling_time, effects)
    return car.motion(State(*race.state.T), Applied(*race.command.T), acting, context=context)


def driven_coefficients(race: Race) -> dict[str, Any]:
    """What the effects of the driven car amount to, as values of coefficients that come to the same, by name.

    Slip angles that effects shift are shifts ``S_h``; lateral forces that they scale are peaks ``D``. Values are of shape
    ``(n,)``, and not a number where a force is too small to tell. Only those that effects change.
    """
    nominal = Coefficients(*race.course.vehicle.nominal)
    plain, driven = _motion(race, with_effects=False), _motion(race)
    found: dict[str, Any] = {}
    for axle in "fr":
        B, C, D, E = (getattr(nominal, f"{name}_{axle}") for name in "BCDE")
        S_h, S_v = (getattr(nominal, f"S_{name}{axle}") for name in "hv")
        shift = getattr(driven, f"alpha_{axle}") - getattr(plain, f"alpha_{axle}")
        force = lateral_force(np, getattr(driven, f"alpha_{axle}"), B=B, C=C, D=D, E=E, S_v=S_v)
        told = np.abs(force) > 0.1 * D
        load = getattr(driven, f"F_z{axle}") / driven.F_z0
        found[f"S_h{axle}"] = S_h + shift
        found[f"D_{axle}"] = np.where(
            told, D * getattr(driven, f"F_{axle}y") / load / np.where(told, force, 1.0), np.nan
        )
    return {name: v for name, v in found.items() if np.nanmax(np.abs(v - getattr(nominal, name)), initial=0.0) > 1e-9}


@styled
def coefficients(races: Sequence[Race]) -> Figure:
    """The coefficients that a model or the driven car's effects move, and what models add, over the position on the track.

    Where effects are hidden in the car, those that they amount to come first, then those that answer most. What a model says
    once and for all does not answer.
    """
    longest = max(races, key=lambda race: race.s[-1] - race.s[0])
    vehicle, driven = longest.course.vehicle, driven_coefficients(longest)
    told = [race.theta[_first_change(race.theta) if driven else 0 :] for race in races]
    moves = np.max([np.ptp(theta, axis=0) for theta in told], axis=0) / (vehicle.upper - vehicle.lower)
    moving = [k for k, name in enumerate(COEFFICIENTS) if moves[k] > _MOVED or name in driven]
    if driven:
        moving = sorted(moving, key=lambda k: (COEFFICIENTS[k] not in driven, -moves[k]))[:_ANSWERS]
    rows = [(coefficient_label(COEFFICIENTS[k]), [race.theta[:, k] for race in races]) for k in moving]
    rows += [
        (f"{SYMBOLS[c]} added ({UNITS[c]})", [race.correction[:, k] for race in races])
        for k, c in enumerate(STATE_SIGNALS)
        if not moving
        or any(np.max(np.abs(race.correction[:, k])) > _MOVED * np.ptp(race.state[:, k]) for race in races)
    ]
    return _panels(races, rows, {coefficient_label(name): values for name, values in driven.items()}, longest)


@styled
def learning(races: Sequence[Race]) -> Figure:
    """Lap times, shares of the limits, margins, grip and coefficients, lap by lap; bands are all sections."""
    races = [race for race in races if race.learned]
    colours = model_colours([race.name for race in races])
    known = {name for race in races for name in _learned_most(race)}
    names = [name for name in COEFFICIENTS if name in known]
    figure = Figure(figsize=(WIDTH, 0.8 + 1.9 * (2 + -(-len(names) // 2))), layout="constrained")
    panels = figure.subplots(2 + -(-len(names) // 2), 2, sharex=True, squeeze=False)
    labels = ("lap time (s)", "share of the limits", "margin used", "grip of the sections")
    for panel, label in zip(panels.flat, labels, strict=False):
        panel.set_ylabel(label)
    for race in races:
        colour, laps = colours[race.name], np.arange(1, len(race.learned) + 1)
        panels[0, 0].plot(laps, [lap.time for lap in race.learned], "o-", ms=4, color=colour, label=race.name)
        by_section = [[lap.shares for lap in race.learned], [lap.grip for lap in race.learned]]
        for panel, sections in zip(panels[:2, 1], map(np.array, by_section), strict=True):
            panel.plot(laps, sections.mean(axis=1), "o-", ms=4, color=colour)
            panel.fill_between(laps, sections.min(axis=1), sections.max(axis=1), color=colour, alpha=0.15, lw=0)
        panels[1, 0].plot(laps, np.minimum([lap.margin_used for lap in race.learned], 1.5), "o-", ms=4, color=colour)
        for panel, name in zip(panels[2:].flat, names, strict=False):
            values = np.array([lap.vehicle.coefficients[name].nominal for lap in race.learned])
            band = 2 * np.array([lap.vehicle.coefficients[name].std or 0.0 for lap in race.learned])
            panel.plot(laps, values, "o-", ms=4, color=colour)
            panel.fill_between(laps, values - band, values + band, color=colour, alpha=0.15, lw=0)
    truth = driven_coefficients(races[0])
    for panel, name in zip(panels[2:].flat, names, strict=False):
        panel.set_ylabel(coefficient_label(name))
        if name in truth:
            panel.axhline(float(np.nanmedian(truth[name])), color=MEASURED, lw=1.0, ls="--")
    for spare in list(panels[2:].flat)[len(names) :]:
        spare.set_visible(False)
    panels[1, 0].axhline(1.0, color=MEASURED, lw=0.8)
    for bottom in panels[-1]:
        bottom.set_xlabel("lap")
        bottom.xaxis.set_major_locator(MaxNLocator(integer=True))
    figure.legend(*panels[0, 0].get_legend_handles_labels(), loc="outside upper left", ncols=4)
    return figure


def _learned_most(race: Race) -> list[str]:
    """The coefficients whose standard deviations shrank most over the laps."""
    first, last = (lap.vehicle.coefficients for lap in (race.learned[0], race.learned[-1]))
    shrunk = {name: (last[name].std or 0.0) / std for name, c in first.items() if (std := c.std)}
    return sorted(shrunk, key=lambda name: shrunk[name])[:_LEARNED]


@styled
def evidence(races: Sequence[Race]) -> Figure:
    """How much of each model was planned with, over the distance driven."""
    rows: list[tuple[str, list[Any]]] = [
        ("coefficients used", [1.0 - race.weights[:, 0] for race in races]),
        ("additions used", [race.weights[:, 2] for race in races]),
    ]
    return _panels(races, rows)


def _first_change(theta: npt.NDArray[np.float64]) -> int:
    """The first row that is not the first one repeated: where a model begins to speak; 0 if it never does."""
    return int(np.argmax(np.any(theta != theta[0], axis=1)))


def _panels(
    races: Sequence[Race],
    rows: list[tuple[str, list[Any]]],
    dashed: Mapping[str, Any] | None = None,
    along: Race | None = None,
) -> Figure:
    """A panel per row, over the distance driven; dashed lines by the label of the row, of the race ``along``."""
    colours = model_colours([race.name for race in races])
    columns = 1 if len(rows) <= 6 else 2
    lines = -(-len(rows) // columns)
    figure = Figure(figsize=(WIDTH, 0.6 + 1.35 * lines), layout="constrained")
    axes = figure.subplots(lines, columns, sharex=True, squeeze=False)
    for panel, (label, values) in zip(axes.T.flat, rows, strict=False):
        for race, series, width in zip(races, values, widths(len(races)), strict=True):
            panel.plot(race.s - race.s[0], series, color=colours[race.name], lw=width, label=race.name)
        if along is not None and label in (dashed or {}):
            panel.plot(along.s - along.s[0], (dashed or {})[label], color=MEASURED, lw=1.0, ls="--", zorder=1)
        panel.set_ylabel(label)
    for spare in list(axes.T.flat)[len(rows) :]:
        spare.set_visible(False)
    for column in axes.T:
        bottom = [panel for panel in column if panel.get_visible()][-1]
        bottom.set_xlabel("driven along the centre line (m)")
        bottom.tick_params(labelbottom=True)
    figure.align_ylabels()
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside upper left", ncols=4)
    return figure
