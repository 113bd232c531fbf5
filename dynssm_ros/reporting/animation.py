"""The race as an animation: the cars on the track as they are at the same time, what they believed, and what they did."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.animation import PillowWriter
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Polygon

from dynssm_ros.arrays import Mask, Vector
from dynssm_ros.control.race import Race
from dynssm_ros.control.race_models import TRUE
from dynssm_ros.evaluation.coefficients import coefficient_label
from dynssm_ros.files import replacing
from dynssm_ros.reporting.evaluation_figures import MEASURED, STYLE, names_as_they_are
from dynssm_ros.reporting.race_figures import draw_borders, driven_coefficients, race_lines
from dynssm_ros.track.racing_line import CAR_WIDTH
from dynssm_ros.vehicle import COEFFICIENTS

FRAMES = 120  # at most; a GIF of more is slow to write and large
RATE = 25.0  # frames per second, at most
_TRAIL = 0.6  # s of the path behind a car
_LENGTH = 1.5  # of a car in wheelbases
_SMALLEST = 0.03  # of the picture: a car is drawn at least that long
Show = Callable[[float], None]  # a part of the picture as it is at a time (s)
_CHANGED = 0.02  # share of a coefficient's bounds by which a stretch of the road has to change it to be marked


def animate(races: Sequence[Race], path: str | Path) -> None:
    """Writes a GIF, atomically; a car whose drive has ended stays where it ended.

    Beside the map, over the time: the coefficient that hidden physics moves most, as planned with (dashed: the driven
    car's); the speed; and the room between the car's centre and the nearer border. A stretch of the road on which the car
    is another is marked.
    """
    longest = max(races, key=lambda race: float(race.time[-1]))
    name, truth = _most_changed(longest)
    duration = float(longest.time[-1])
    count = int(min(FRAMES, max(2.0, RATE * duration)))
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(10.0, 5.0), layout="constrained")
        FigureCanvasAgg(figure)
        grid = figure.add_gridspec(3, 2, width_ratios=(3, 2))
        road, strips = figure.add_subplot(grid[:, 0]), [figure.add_subplot(grid[k, 1]) for k in range(3)]
        parts = _cars(races, road, _changed_stretch(longest, name, truth))
        parts += _curves(races, strips, name, longest.time, truth)
        figure.legend(*road.get_legend_handles_labels(), loc="outside upper left", ncols=5)
        names_as_they_are(figure).draw_without_rendering()
    figure.set_layout_engine("none")  # it is laid out once, not for each frame
    writer = PillowWriter(fps=max(2, round(min(RATE, count / duration))))
    with replacing(path) as aside, writer.saving(figure, str(aside), dpi=90):
        for t in np.linspace(0.0, duration, count):
            for show in parts:
                show(float(t))
            road.set_title(f"{t:.2f} s", fontsize=10)
            writer.grab_frame()


def _cars(races: Sequence[Race], axes: Axes, changed: Mask) -> list[Show]:
    """The track, marked where it is ``changed``, and the cars on it with the paths behind them."""
    course, track = races[0].course, races[0].course.track
    draw_borders(axes, track)
    extent = np.ptp(np.concatenate([track.left_border, track.right_border]), axis=0)
    if changed.any() and not changed.all():
        x, y = np.where(changed[:, None], track.centre.position(track.centre.s), np.nan).T
        axes.plot(x, y, color=MEASURED, alpha=0.2, lw=8, solid_capstyle="butt", label="the car is changed here")
    wheelbase = course.vehicle.constants.wheelbase
    size = max(_LENGTH * wheelbase, _SMALLEST * float(np.max(extent)))
    cars = [_car(race, axes, size, style) for race, style in race_lines(races)]
    axes.set(aspect="equal", xlabel="x (m)", ylabel="y (m)")
    axes.grid(visible=False)
    return cars


def _car(race: Race, axes: Axes, size: float, style: Mapping[str, Any]) -> Show:
    """A car of a length (m) in the picture with the path behind it."""
    width = CAR_WIDTH / _LENGTH * size
    corners = np.array([[-size, -width], [size, -width], [size, width], [-size, width]]) / 2
    (trail,) = axes.plot([], [], color=style["color"], lw=1.5 * style["lw"], label=race.name)
    body = Polygon(np.zeros((4, 2)), closed=True, facecolor=style["color"], edgecolor="white", lw=0.5, zorder=3)
    axes.add_patch(body)

    def show(t: float) -> None:
        x, y, theta = (float(np.interp(t, race.time, column)) for column in race.pose.T)
        c, s = np.cos(theta), np.sin(theta)
        body.set_xy(corners @ np.array([[c, s], [-s, c]]) + [x, y])
        behind = (race.time > t - _TRAIL) & (race.time <= t)
        trail.set_data(*race.pose[behind, :2].T)

    return show


def _curve(strip: Axes, time: Vector, values: Vector, **style: Any) -> Show:
    """Values over the time that has passed."""
    (line,) = strip.plot(time, values, **style)
    return lambda t: line.set_data(time[time <= t], values[time <= t])


def _curves(races: Sequence[Race], strips: Sequence[Axes], name: str, time: Vector, truth: Vector) -> list[Show]:
    """The coefficient ``name`` as planned with, beside its ``truth`` over ``time`` (s), then speed and room."""
    of_the_car = f"{coefficient_label(name)} planned with; dashed: of the car"
    for strip, title in zip(
        strips, (of_the_car, "speed (m/s)", "from the car's centre to the border (m)"), strict=True
    ):
        strip.set_title(title, loc="left", fontsize=9)
    strips[2].set_xlabel("time (s)")
    strips[2].axhline(0.0, color=MEASURED, lw=0.8)
    for strip in strips[:2]:
        strip.tick_params(labelbottom=False)
    curves = []
    for race, style in race_lines(races):
        shown = (_planned(race, name), np.hypot(*race.state[:, :2].T), race.course.track.room(race.s, race.lateral))
        curves += [_curve(strip, race.time, values, **style) for strip, values in zip(strips, shown, strict=True)]
    curves.append(_curve(strips[0], time, truth, color=MEASURED, lw=1.0, ls="--", zorder=1))
    for strip in strips:
        strip.set(xlim=(0.0, float(time[-1])), ylim=strip.get_ylim())
    return curves


def _planned(race: Race, name: str) -> Vector:
    """The coefficient ``name`` that a car plans with; effects that the true model knows of count as in the driven car."""
    planned = race.theta[:, COEFFICIENTS.index(name)]
    return planned if race.name != TRUE else driven_coefficients(race).get(name, planned)


def _most_changed(race: Race) -> tuple[str, Vector]:
    """The coefficient that hidden physics moves most, and its values in the driven car; the front peak if it moves none."""
    vehicle, driven = race.course.vehicle, driven_coefficients(race)
    if not driven:
        return "D_f", np.full(len(race.time), vehicle.coefficients["D_f"].nominal)

    def moved(name: str) -> float:
        coefficient = vehicle.coefficients[name]
        return float(np.nanmax(np.abs(driven[name] - coefficient.nominal)) / np.ptp(coefficient.bounds))

    name = max(driven, key=moved)
    return name, driven[name]


def _changed_stretch(race: Race, name: str, truth: Vector) -> Mask:
    """Whether the coefficient ``name``, truly ``truth``, is another at each point of the centre line, shape ``(n,)``."""
    track, coefficient = race.course.track, race.course.vehicle.coefficients[name]
    off = np.abs(truth - coefficient.nominal) > _CHANGED * np.ptp(coefficient.bounds)
    known = np.isfinite(truth)
    if not known.any():
        return np.zeros(len(track.centre.s), dtype=bool)
    nearest = np.abs((race.s[known][:, None] - track.centre.s) % track.length)
    nearest = np.minimum(nearest, track.length - nearest)
    return np.asarray(off[known][np.argmin(nearest, axis=0)])
