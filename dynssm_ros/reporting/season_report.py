"""The page of a season: alarms, each model in each session, coefficients over time, and causes that come and go."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

from dynssm_ros.evaluation.coefficients import coefficient_unit
from dynssm_ros.evaluation.season_review import Alarm, Estimate, Found, Review, expected
from dynssm_ros.reporting.evaluation_figures import MEASURED, PALETTE, WIDTH, model_colours, styled
from dynssm_ros.reporting.page import Report, Section
from dynssm_ros.reporting.tables import Column, Table, Value
from dynssm_ros.vehicle import COEFFICIENTS

_PANELS = 9  # coefficients that are drawn: those that varied most
_NAMED = 24  # sessions whose names are written below a figure
_ALARM = "#D55E00"


def season_report(reviews: Sequence[Review], alarms: Sequence[Alarm], protocol: Mapping[str, str]) -> Report:
    """The report of a season, of reviews in the order of driving."""
    sections = [
        Section("Alarms", "What was not as in the sessions before, in the order of driving.", table=alarm_table(alarms))
    ]
    if _models(reviews):
        text = "Mean displacement of 0.6 s rollouts. Tracks differ, so compare models, not sessions."
        sections.append(Section("Models", text, errors(reviews)))
    if any(each.stretches for each in reviews):
        text = (
            "Calibrated on each session alone, with bands of two standard deviations; a ring is an alarm. Shown are those "
            "that varied most beyond their bands. What one tyre coefficient gains another may lose: judge by what moved "
            "together."
        )
        sections.append(Section("Coefficients", text, coefficients(reviews, alarms)))
    if any(each.causes for each in reviews):
        text = (
            "What the simulation gets wrong in each session, by its diagnosis; the area is the share of the error on "
            "held-out laps that the cause takes away, the number its first parameter. What stays from session to session "
            "belongs into the vehicle file."
        )
        sections.append(Section("Causes", text, causes(reviews)))
    failed = [f"{each.session}: {words}." for each in reviews for words in each.failures]
    if failed:
        sections.append(Section("Not done", " ".join(failed)))
    hours = sum(each.seconds for each in reviews) / 3600
    cars, tracks = ({getattr(each, name) for each in reviews} for name in ("car", "track"))
    summary = (
        f"{len(reviews)} sessions, {hours:.1f} h of {_listed(cars)} on {_listed(tracks)}. "
        f"Alarms: {len(alarms)}, in {len({id(alarm.review) for alarm in alarms})} of them."
    )
    return Report("Season", summary, sections, protocol, session_table(reviews, alarms))


def _listed(names: set[str]) -> str:
    return ", ".join(sorted(names))


def alarm_table(alarms: Sequence[Alarm]) -> Table:
    """One row per alarm."""
    columns = (Column("session", brief=True), Column("start"), Column("alarm", brief=True))
    rows: list[list[Value]] = [[alarm.review.session, _when(alarm.review), alarm.words] for alarm in alarms]
    return Table(columns, rows, "" if rows else "None.")


def session_table(reviews: Sequence[Review], alarms: Sequence[Alarm]) -> Table:
    """One row per session, a column per model."""
    models = _models(reviews)
    several = len({each.car for each in reviews}) > 1
    columns = (
        Column("session", brief=True),
        Column("start"),
        *([Column("car")] if several else []),
        Column("track", brief=True),
        Column("length", "s"),
        *(Column(model, "m", "ADE", brief=True) for model in models),
        Column("best"),
        Column("causes", brief=True),
        Column("alarms", brief=True),
    )
    rows: list[list[Value]] = []
    for each in reviews:
        ade = {model: each.accuracy[model].ade if model in each.accuracy else None for model in models}
        known = {model: value for model, value in ade.items() if value is not None}
        rows.append(
            [
                each.session, _when(each), *([each.car] if several else []), each.track, round(each.seconds), *ade.values(),
                min(known, key=lambda model: known[model]) if known else None,
                ", ".join(cause.effect for cause in each.causes) or each.verdict or None,
                sum(alarm.review is each for alarm in alarms),
            ]
        )  # fmt: skip
    return Table(columns, rows)


def _when(review: Review) -> str:
    return review.start[:16].replace("T", " ")


def _models(reviews: Sequence[Review]) -> list[str]:
    return [*dict.fromkeys(model for each in reviews for model in each.accuracy)]


@styled
def errors(reviews: Sequence[Review]) -> Figure:
    """ADE of each model over the sessions."""
    figure = Figure(figsize=(WIDTH, 3.4), layout="constrained")
    axes = figure.subplots()
    models = _models(reviews)
    colours = model_colours(models)
    for model in models:
        ade = [each.accuracy[model].ade if model in each.accuracy else np.nan for each in reviews]
        axes.plot(ade, "o-", ms=4, lw=0.8, color=colours[model], label=model)
    axes.set_yscale("log")
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.yaxis.set_minor_locator(NullLocator())
    axes.set_ylabel("ADE (m)")
    axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=4)
    _sessions_below(axes, reviews)
    return figure


@styled
def coefficients(reviews: Sequence[Review], alarms: Sequence[Alarm]) -> Figure:
    """Those that varied most over the sessions, with bands."""
    names = sorted(COEFFICIENTS, key=lambda name: -_variation(reviews, name))[:_PANELS]
    names = [name for name in COEFFICIENTS if name in names]
    rows = -(-len(names) // 3)
    figure = Figure(figsize=(WIDTH, 0.7 + 1.9 * rows), layout="constrained")
    grid = figure.subplots(rows, 3, squeeze=False, sharex=True)
    cars = sorted({each.car for each in reviews})
    for axes, name in zip(grid.flat, names, strict=False):
        for colour, car in zip(PALETTE, cars, strict=False):
            places, points = _points([(k, each) for k, each in enumerate(reviews) if each.car == car], name)
            value = np.array([point.value for point in points])
            std = np.array([point.std for point in points])
            axes.errorbar(places, value, 2 * std, fmt="o-", ms=3.5, lw=0.8, elinewidth=1.0, color=colour, label=car)
        for k, each in enumerate(reviews):
            moved = any(alarm.review is each and alarm.subject == name for alarm in alarms)
            if moved and each.stretches:
                axes.plot(k, each.stretches[0].coefficients[name].value, "o", ms=11, mfc="none", mec=_ALARM, mew=1.6)
        unit = coefficient_unit(name)
        axes.set_title(f"{name} ({unit})" if unit else name)
        _sessions_below(axes, reviews, few=6)
    for axes in grid.flat[len(names) :]:
        axes.set_visible(False)
    if len(cars) > 1:
        grid[0, 0].legend()
    return figure


def _points(reviews: Sequence[tuple[int, Review]], name: str) -> tuple[list[float], list[Estimate]]:
    """Where a coefficient's values are on the axis of sessions, and the values."""
    places, points = [], []
    for k, each in reviews:
        for part, stretch in enumerate(each.stretches):
            places.append(k + 0.8 * part / len(each.stretches))
            points.append(stretch.coefficients[name])
    return places, points


def _variation(reviews: Sequence[Review], name: str) -> float:
    """Of a coefficient between stretches, beyond its standard deviations, as a share of these."""
    _, points = _points(list(enumerate(reviews)), name)
    known = [point for point in points if point.std > 0.0]
    if len(known) < 2:
        return 0.0
    mean, _ = expected(known)
    return float(np.mean([((point.value - mean) / point.std) ** 2 for point in known]))


@styled
def causes(reviews: Sequence[Review]) -> Figure:
    """Which cause is named in which session."""
    names = [*dict.fromkeys(cause.effect for each in reviews for cause in each.causes)]
    figure = Figure(figsize=(WIDTH, 1.2 + 0.42 * len(names)), layout="constrained")
    axes = figure.subplots()
    for k, each in enumerate(reviews):
        for cause in each.causes:
            row = names.index(cause.effect)
            axes.scatter(k, row, s=20 + 500 * max(cause.improvement, 0.0), color=PALETTE[0], alpha=0.55, lw=0)
            axes.annotate(
                _size(cause), (k, row), (13, 0), textcoords="offset points", va="center", fontsize=7, color=MEASURED
            )
    axes.set_yticks(range(len(names)), names)
    axes.set_ylim(len(names) - 0.3, -0.6)
    _sessions_below(axes, reviews)
    return figure


def _size(cause: Found) -> str:
    return f"{next(iter(cause.values.values())):.3g}" if cause.values else ""


def _sessions_below(axes: Axes, reviews: Sequence[Review], few: int = _NAMED) -> None:
    step = -(-len(reviews) // few)
    places = range(0, len(reviews), step)
    axes.set_xticks(places, [reviews[k].session for k in places], rotation=40, ha="right", fontsize=7.5)
    axes.set_xlim(-0.5, len(reviews) - 0.5)
