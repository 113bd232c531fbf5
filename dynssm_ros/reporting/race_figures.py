"""The figures of a race: paths, states, forces, coefficients, what a car learns lap by lap."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from scipy.spatial import cKDTree

from dynssm_ros.arrays import Vector
from dynssm_ros.control.race import Race
from dynssm_ros.control.race_models import TRUE
from dynssm_ros.evaluation.coefficients import coefficient_label
from dynssm_ros.reporting.evaluation_figures import (
    MEASURED,
    WIDTH,
    label,
    legend_above,
    model_colours,
    sheet,
    styled,
)
from dynssm_ros.signals.signal_map import STATE_SIGNALS
from dynssm_ros.track.tracks import Track
from dynssm_ros.vehicle import COEFFICIENTS, Applied, CarModel, Coefficients, State
from dynssm_ros.vehicle.single_track import Motion, lateral_force

_ENLARGED = 6.0  # where the paths part is enlarged if it is smaller than the track by this factor
_STAMPS = 0.5  # s between the time stamps on the map
_MOVED = 1e-3  # of its bounds that a coefficient must move, and of a state's range that must be added, to be shown
_LEARNED = 4  # coefficients in the figure of a car that learns
_ANSWERS = 6  # coefficients at most in a figure of hidden effects


@styled
def trajectories(races: Sequence[Race]) -> Figure:
    """Paths on the track with marks at equal times; on a large track also, enlarged, where they part most."""
    place, side = _parting(races)
    across, up = np.ptp(races[0].course.track.centre.points, axis=0)
    enlarged = side * _ENLARGED < np.hypot(across, up)
    height = (0.6 if enlarged else 0.9) * min(up / across, 1.0)
    size = WIDTH * max(height, 0.35) + 0.9
    if not enlarged:
        figure, plan = sheet(size)
    else:
        figure, (plan, near) = sheet(size, 1, 2, width_ratios=(2, 1))
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
    return legend_above(figure, plan)


def _parting(races: Sequence[Race]) -> tuple[Vector, float]:
    """Where another path is farthest from the first one, or that from the line if it is alone, and three widths there (m)."""
    first, *others = (race.pose[:, :2] for race in sorted(races, key=lambda race: not race.completed))
    points = np.concatenate(others or [races[0].course.reference.line.points])
    apart = cKDTree(first).query(points)[0]
    place, track = points[np.argmax(apart)], races[0].course.track
    return place, 3.0 * float(sum(track.widths(track.centre.project(place)[0])))


def _draw_paths(axes: Axes, races: Sequence[Race]) -> None:
    course = races[0].course
    draw_borders(axes, course.track)
    line = course.reference.line
    axes.plot(
        *_drawn(line.points, line.closed).T, color="#777777", lw=0.8, ls="--", label=f"{course.reference.name} line"
    )
    every = max(1, round(stamp_period(races) / course.vehicle.sampling_time))
    for race, style in race_lines(races):
        axes.plot(*race.pose[:, :2].T, label=race.name, **style)
        axes.plot(*race.pose[::every, :2].T, "o", color=style["color"], mec="white", mew=0.5, ms=4, zorder=3)
    axes.set(aspect="equal", xlabel="x (m)", ylabel="y (m)")


def draw_borders(axes: Axes, track: Track) -> None:
    """Both borders of a track."""
    for border in (track.left_border, track.right_border):
        axes.plot(*_drawn(border, track.centre.closed).T, color=MEASURED, lw=1.0)


def _drawn(points: Vector, closed: bool) -> Vector:
    return np.concatenate([points, points[:1]]) if closed else points


def race_lines(races: Sequence[Race]) -> list[tuple[Race, dict[str, Any]]]:
    """Races with the style of their lines: those drawn first are wider, so that cars that drive alike are all seen."""
    colours, widths = model_colours([race.name for race in races]), np.linspace(min(len(races), 3), 1.0, len(races))
    styles = ({"color": colours[race.name], "lw": float(width)} for race, width in zip(races, widths, strict=True))
    return list(zip(races, styles, strict=True))


def stamp_period(races: Sequence[Race]) -> float:
    """Time between marks: ``_STAMPS``, or more where a lap takes minutes."""
    return _STAMPS * max(1, round(max(float(race.time[-1]) for race in races) / (40 * _STAMPS)))


@styled
def profiles(races: Sequence[Race]) -> Figure:
    """State and commands over the position on the track."""
    rows = [(label(c), k, "state") for k, c in enumerate(STATE_SIGNALS)]
    throttle = all(race.course.vehicle.inputs.set_point == "throttle" for race in races)
    rows += [("throttle" if throttle else "speed set-point (m/s)", 0, "command"), ("steering (rad)", 1, "command")]
    return _panels(races, [(name, [getattr(race, what)[:, k] for race in races]) for name, k, what in rows])


@styled
def forces(races: Sequence[Race]) -> Figure:
    """Axle and drive forces over the position on the track: as each model estimates them, and the driven car's own."""
    along = compared_forces(races)
    # with the coefficients that a model planned with; the plant's own model knows its effects
    estimated = [_motion(r) if r.name == TRUE else _motion(r, with_effects=False, theta=r.theta) for r in races]
    driven = _motion(along)
    rows = {"F_fy": "$F_{fy}$ (N)", "F_ry": "$F_{ry}$ (N)", "F_d": "$F_d$ (N)"}
    return _panels(
        races,
        [(symbol, [getattr(each, name) for each in estimated]) for name, symbol in rows.items()],
        {symbol: getattr(driven, name) for name, symbol in rows.items()},
        along,
    )


def compared_forces(races: Sequence[Race]) -> Race:
    """The race whose forces are shown as they were: the longest one, not of the plant's own model, which has no others."""
    return max(races, key=lambda race: (race.name != TRUE, race.s[-1] - race.s[0]))


def _motion(race: Race, with_effects: bool = True, theta: Vector | None = None) -> Motion:
    """The equations of motion at what was driven, with coefficients ``(n, 17)``, the driven car's if not given.

    The driven car's effects act, their states settled, or do not.
    """
    course = race.course
    x, y, heading = race.pose.T
    centre = course.track.centre
    place = {"s": race.s, "lap_length": centre.length, "bend": centre.bend(race.s)}
    context = {"t": race.time, **place, "x": x, "y": y, "theta": heading}
    vehicle = course.vehicle
    effects = [effect for effect in vehicle.active_effects if with_effects and not effect.SENSOR]
    acting = Coefficients(*(vehicle.nominal if theta is None else theta.T))
    car = CarModel(vehicle.constants, vehicle.sampling_time, effects, set_point=vehicle.inputs.set_point)
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
    # from where a model begins to speak: its first row is repeated before
    begins = [int(np.argmax(np.any(race.theta != race.theta[0], axis=1))) if driven else 0 for race in races]
    told = [race.theta[begin:] for race, begin in zip(races, begins, strict=True)]
    moves = np.max([np.ptp(theta, axis=0) for theta in told], axis=0) / (vehicle.upper - vehicle.lower)
    moving = [k for k, name in enumerate(COEFFICIENTS) if moves[k] > _MOVED or name in driven]
    if driven:
        moving = sorted(moving, key=lambda k: (COEFFICIENTS[k] not in driven, -moves[k]))[:_ANSWERS]
    rows = [(coefficient_label(COEFFICIENTS[k]), [race.theta[:, k] for race in races]) for k in moving]
    rows += [
        (label(c, " added"), [race.correction[:, k] for race in races])
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
    rows = 2 + -(-len(names) // 2)
    figure, panels = sheet(0.8 + 1.9 * rows, rows, 2, sharex=True, squeeze=False)
    titles = ("lap time (s)", "share of the limits", "margin used", "grip of the sections")
    for panel, title in zip(panels.flat, titles, strict=False):
        panel.set_ylabel(title)
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
    return legend_above(figure, panels[0, 0])


def _learned_most(race: Race) -> list[str]:
    """The coefficients whose standard deviations shrank most over the laps."""
    first, last = (lap.vehicle.coefficients for lap in (race.learned[0], race.learned[-1]))
    shrunk = {name: (last[name].std or 0.0) / std for name, c in first.items() if (std := c.std)}
    return sorted(shrunk, key=lambda name: shrunk[name])[:_LEARNED]


@styled
def evidence(races: Sequence[Race]) -> Figure:
    """How much of each model was planned with, over the distance driven."""
    used = [1.0 - race.weights[:, 0] for race in races]
    return _panels(races, [("coefficients used", used), ("additions used", [race.weights[:, 2] for race in races])])


def _panels(
    races: Sequence[Race],
    rows: list[tuple[str, list[Any]]],
    dashed: Mapping[str, Any] | None = None,
    along: Race | None = None,
) -> Figure:
    """A panel per row, over the distance driven; dashed lines by the label of the row, of the race ``along``."""
    columns = 1 if len(rows) <= 6 else 2
    lines = -(-len(rows) // columns)
    figure, axes = sheet(0.6 + 1.35 * lines, lines, columns, sharex=True, squeeze=False)
    for panel, (title, values) in zip(axes.T.flat, rows, strict=False):
        for (race, style), series in zip(race_lines(races), values, strict=True):
            panel.plot(race.s - race.s[0], series, label=race.name, **style)
        if along is not None and dashed is not None and title in dashed:
            panel.plot(along.s - along.s[0], dashed[title], color=MEASURED, lw=1.0, ls="--", zorder=1)
        panel.set_ylabel(title)
    for spare in list(axes.T.flat)[len(rows) :]:
        spare.set_visible(False)
    for column in axes.T:
        bottom = [panel for panel in column if panel.get_visible()][-1]
        bottom.set_xlabel("driven along the centre line (m)")
        bottom.tick_params(labelbottom=True)
    figure.align_ylabels()
    return legend_above(figure, axes[0, 0])
