"""The race as an animation: the cars on the track as they are at the same time."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.animation import PillowWriter
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Polygon

from dynssm_ros.control.race import Race
from dynssm_ros.files import replacing
from dynssm_ros.reporting.evaluation_figures import MEASURED, STYLE, model_colours
from dynssm_ros.reporting.race_report import widths
from dynssm_ros.track.racing_line import CAR_WIDTH

FRAMES = 120  # at most; a GIF of more is slow to write and large
RATE = 25.0  # frames per second, at most
_TRAIL = 1.0  # s of the path behind a car
_LENGTH = 1.5  # of a car in wheelbases
_SMALLEST = 0.015  # of the picture: a car is drawn at least that long


def animate(races: Sequence[Race], path: str | Path) -> None:
    """Writes a GIF, atomically; a car whose drive has ended stays where it ended.

    Args:
        races: on one course.
        path: of the file.
    """
    duration = max(float(race.time[-1]) for race in races)
    count = int(min(FRAMES, max(2.0, RATE * duration)))
    with mpl.rc_context(STYLE):
        figure, cars = _scene(races)
    writer = PillowWriter(fps=max(2, round(min(RATE, count / duration))))
    with replacing(path) as aside, writer.saving(figure, str(aside), dpi=90):
        for t in np.linspace(0.0, duration, count):
            for car in cars:
                car.show(float(t))
            figure.axes[0].set_title(f"{t:.2f} s")
            writer.grab_frame()


class _Car:
    """A car in the picture with the path behind it."""

    def __init__(self, race: Race, body: Polygon, trail: Line2D, size: float) -> None:
        width = CAR_WIDTH / _LENGTH * size
        self._corners = np.array([[-size, -width], [size, -width], [size, width], [-size, width]]) / 2
        self._race, self._body, self._trail = race, body, trail

    def show(self, t: float) -> None:
        """As it is at time ``t`` (s)."""
        time, pose = self._race.time, self._race.pose
        x, y, theta = (float(np.interp(t, time, column)) for column in pose.T)
        c, s = np.cos(theta), np.sin(theta)
        self._body.set_xy(self._corners @ np.array([[c, s], [-s, c]]) + [x, y])
        behind = (time > t - _TRAIL) & (time <= t)
        self._trail.set_data(*pose[behind, :2].T)


def _scene(races: Sequence[Race]) -> tuple[Figure, list[_Car]]:
    course, colours = races[0].course, model_colours([race.name for race in races])
    borders = [course.track.left_border, course.track.right_border]
    extent = np.ptp(np.concatenate(borders), axis=0)
    figure = Figure(figsize=(7.0, 1.0 + 6.2 * float(np.clip(extent[1] / extent[0], 0.3, 1.2))), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    for border in borders:
        axes.plot(*np.concatenate([border, border[:1]]).T, color=MEASURED, lw=1.0)
    wheelbase = course.vehicle.constants.l_f + course.vehicle.constants.l_r
    size = max(_LENGTH * wheelbase, _SMALLEST * float(np.max(extent)))
    cars = []
    for race, width in zip(races, widths(len(races)), strict=True):
        colour = colours[race.name]
        (trail,) = axes.plot([], [], color=colour, lw=1.5 * width, label=race.name)
        body = Polygon(np.zeros((4, 2)), closed=True, facecolor=colour, edgecolor="white", lw=0.5, zorder=3)
        axes.add_patch(body)
        cars.append(_Car(race, body, trail, size))
    axes.set(aspect="equal", xlabel="x (m)", ylabel="y (m)")
    axes.grid(visible=False)
    figure.legend(*axes.get_legend_handles_labels(), loc="outside upper left", ncols=4)
    return figure, cars
