"""The page of a season: alarms, each model in each session, coefficients over time, and causes that come and go."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

from dynssm_ros.evaluation.coefficients import coefficient_label
from dynssm_ros.evaluation.season_review import Alarm, Estimate, Review, expected
from dynssm_ros.reporting.evaluation_figures import MEASURED, PALETTE, model_colours, sheet, styled
from dynssm_ros.reporting.page import Prose, Report
from dynssm_ros.reporting.tables import Column, Table
from dynssm_ros.vehicle import COEFFICIENTS

_PANELS = 9  # coefficients that are drawn: those that varied most
_NAMED = 24  # sessions whose names are written below a figure
_ALARM = "#D55E00"


def season_report(reviews: Sequence[Review], alarms: Sequence[Alarm], protocol: Mapping[str, str]) -> Report:
    """The report of a season, of reviews in the order of driving."""
    prose = Prose("season")
    sections = [prose.section("alarms", table=alarm_table(alarms))]
    if _models(reviews):
        sections.append(prose.section("models", errors(reviews)))
    if any(each.stretches for each in reviews):
        sections.append(prose.section("coefficients", coefficients(reviews, alarms)))
    if any(each.causes for each in reviews):
        sections.append(prose.section("causes", causes(reviews)))
    if any(each.patterns for each in reviews):
        sections.append(prose.section("patterns", table=_pattern_table(reviews)))
    failed = [f"{each.session}: {words}." for each in reviews for words in each.failures]
    if failed:
        sections.append(prose.section("not_done", failures=" ".join(failed)))
    hours = sum(each.seconds for each in reviews) / 3600
    cars, tracks = (", ".join(sorted({getattr(each, name) for each in reviews})) for name in ("car", "track"))
    summary = (
        f"{len(reviews)} sessions, {hours:.1f} h of {cars} on {tracks}. "
        f"Alarms: {len(alarms)}, in {len({id(alarm.review) for alarm in alarms})} of them."
    )
    return Report("Season", summary, sections, protocol, session_table(reviews, alarms))


def season_json(reviews: Sequence[Review], alarms: Sequence[Alarm]) -> dict[str, Any]:
    """The result for programs."""
    said = [{"session": each.review.session, "subject": each.subject, "words": each.words} for each in alarms]
    return {"sessions": [each.model_dump(mode="json", exclude={"key"}) for each in reviews], "alarms": said}


def alarm_table(alarms: Sequence[Alarm]) -> Table:
    """One row per alarm."""
    return Table.of(
        alarms,
        (Column("session", brief=True), lambda alarm: alarm.review.session),
        (Column("start"), lambda alarm: _when(alarm.review)),
        (Column("alarm", brief=True), lambda alarm: alarm.words),
        caption="" if alarms else "None.",
    )


def session_table(reviews: Sequence[Review], alarms: Sequence[Alarm]) -> Table:
    """One row per session, a column per model."""
    models, cars = _models(reviews), {each.car for each in reviews}

    def best(each: Review) -> str | None:
        return min(each.accuracy, key=lambda model: each.accuracy[model].ade, default=None)

    return Table.of(
        reviews,
        (Column("session", brief=True), lambda each: each.session),
        (Column("start"), _when),
        ([Column("car")] if len(cars) > 1 else [], lambda each: [each.car] if len(cars) > 1 else []),
        (Column("track", brief=True), lambda each: each.track),
        (Column("length", "s"), lambda each: round(each.seconds)),
        ([Column(model, "m", "ADE", brief=True) for model in models], lambda each: [_ade(each, one) for one in models]),
        (Column("best"), best),
        (
            Column("causes", brief=True),
            lambda each: ", ".join(cause.effect for cause in each.causes) or each.verdict or None,
        ),
        (Column("alarms", brief=True), lambda each: sum(alarm.review is each for alarm in alarms)),
    )


def _pattern_table(reviews: Sequence[Review]) -> Table:
    """One row per pattern that a session's diagnosed car leaves."""
    return Table.of(
        [(each.session, pattern) for each in reviews for pattern in each.patterns],
        (Column("session"), lambda row: row[0]),
        (Column("share", "% of squared error"), lambda row: 100 * row[1].share),
        (Column("pattern"), lambda row: row[1].words),
    )


def _ade(review: Review, model: str) -> float | None:
    return review.accuracy[model].ade if model in review.accuracy else None


def _when(review: Review) -> str:
    return review.start[:16].replace("T", " ")


def _models(reviews: Sequence[Review]) -> list[str]:
    return [*dict.fromkeys(model for each in reviews for model in each.accuracy)]


@styled
def errors(reviews: Sequence[Review]) -> Figure:
    """ADE of each model over the sessions."""
    figure, axes = sheet(3.4)
    models = _models(reviews)
    colours = model_colours(models)
    for model in models:
        ade = np.array([_ade(each, model) for each in reviews], dtype=float)
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
    figure, grid = sheet(0.7 + 1.9 * rows, rows, 3, squeeze=False, sharex=True)
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
        axes.set_title(coefficient_label(name))
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
    figure, axes = sheet(1.2 + 0.42 * len(names))
    for k, each in enumerate(reviews):
        for cause in each.causes:
            row, size = names.index(cause.effect), "".join(f"{value:.3g}" for value in [*cause.values.values()][:1])
            axes.scatter(k, row, s=20 + 500 * max(cause.improvement, 0.0), color=PALETTE[0], alpha=0.55, lw=0)
            axes.annotate(size, (k, row), (13, 0), textcoords="offset points", va="center", fontsize=7, color=MEASURED)
    axes.set_yticks(range(len(names)), names)
    axes.set_ylim(len(names) - 0.3, -0.6)
    _sessions_below(axes, reviews)
    return figure


def _sessions_below(axes: Axes, reviews: Sequence[Review], few: int = _NAMED) -> None:
    step = -(-len(reviews) // few)
    places = range(0, len(reviews), step)
    axes.set_xticks(places, [reviews[k].session for k in places], rotation=40, ha="right", fontsize=7.5)
    axes.set_xlim(-0.5, len(reviews) - 0.5)
