"""A diagnosis as a page: a line for each finding, tables and figures."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from dynssm_ros.evaluation.residuals.anatomy import ModelAnatomy
from dynssm_ros.evaluation.residuals.patterns import Pattern
from dynssm_ros.identification.result.diagnosis import EXTENDED, GIVEN, RECALIBRATED, Diagnosis
from dynssm_ros.identification.result.improvement import Improvement
from dynssm_ros.reporting import diagnosis_figures
from dynssm_ros.reporting.diagnosis_words import (
    MOST_PATTERNS,
    cause_in_words,
    conclusion_in_words,
    formula_in_words,
    headline,
    hiding_in_words,
    left_in_words,
    moved_in_words,
    recordings_of,
    signal_findings,
    size_in_words,
    title_of,
)
from dynssm_ros.reporting.evaluation_figures import UNITS
from dynssm_ros.reporting.page import Prose, Report, Section, State, Verdict, data_verdicts
from dynssm_ros.reporting.residuals_report import ahead_sections, pattern_sections, sentence
from dynssm_ros.reporting.tables import Column, ColumnOf, Table
from dynssm_ros.signals.signal_map import STATE_SIGNALS
from dynssm_ros.vehicle import COEFFICIENT_UNITS, COEFFICIENTS
from dynssm_ros.vehicle.effects import EFFECTS

_MOST_RECORDINGS = 6  # whose errors are drawn over time


def diagnosis_report(diagnosis: Diagnosis, left: ModelAnatomy | None = None, ahead: Sequence[Pattern] = ()) -> Report:
    """The report with figures; ``left`` are the one-step errors of the extended car, ``ahead`` patterns at the horizon."""
    return Report(
        f"Diagnosis of {diagnosis.vehicle.name}",
        headline(diagnosis),
        tuple(_sections(diagnosis, left, ahead)),
        diagnosis.protocol,
        _causes(diagnosis) if diagnosis.found else None,
        verdicts=(*data_verdicts(signal_findings(diagnosis)), *_lines(diagnosis, left)),
    )


def _lines(diagnosis: Diagnosis, left: ModelAnatomy | None) -> Iterator[Verdict]:
    """The first screen: a line for each finding."""
    look: dict[str, tuple[str, State]] = {
        "no_better": ("input", "wrong"), "cause": ("cause", "look"), "recalibration": ("file", "look"),
        "unexplained": ("left", "look"), "small": ("small", "ok"), "nearest": ("near", "look"),
    }  # fmt: skip
    for one in diagnosis.conclusions:
        yield Verdict(*look[one.kind], conclusion_in_words(diagnosis, one))
    for pattern in () if left is None else left.patterns[:MOST_PATTERNS]:
        yield Verdict("step", "look", f"Single steps: {sentence(pattern)}.")
    if diagnosis.verdict == "healthy":
        yield Verdict("car", "ok", headline(diagnosis))


def _causes(diagnosis: Diagnosis) -> Table:
    return Table.of(
        diagnosis.found,
        (Column("effect"), lambda cause: cause.effect + recordings_of(cause)),
        (Column("told as"), lambda cause: cause.kind),
        (Column("size"), size_in_words),
        (Column("better by", group="left-out parts"), lambda cause: cause.confirmation.total),
        (Column("±", group="left-out parts"), lambda cause: cause.confirmation.std),
        (
            [Column(channel, "%", "squared error gone there") for channel in STATE_SIGNALS],
            lambda cause: [100 * float(share) for share in cause.confirmation.share],
        ),
        (Column("less", "%", "held-out error"), lambda cause: 100 * cause.heldout_improvement),
        (Column("the data fit as well"), lambda cause: ", ".join(cause.alternatives) or "nothing else"),
    )


def _sections(diagnosis: Diagnosis, left: ModelAnatomy | None, ahead: Sequence[Pattern]) -> Iterator[Section]:
    improvement = diagnosis.improvement
    windows, horizon = improvement.windows, improvement.horizons[improvement.horizon]
    prose = Prose(
        "diagnosis", given=GIVEN, recalibrated=RECALIBRATED, extended=EXTENDED, horizon=horizon,
        longest=improvement.horizons[-1], left=left_in_words(diagnosis),
        formulas=" ".join(map(formula_in_words, diagnosis.formulas)),
        moved=" ".join((*moved_in_words(diagnosis), *hiding_in_words(diagnosis))),
    )  # fmt: skip
    for cause in diagnosis.found:
        effect, with_it = EFFECTS[cause.effect](**cause.values), improvement.errors[EXTENDED][:, improvement.horizon]
        pictures = diagnosis_figures.cause_pictures(windows, cause.without, with_it, effect)
        about = " ".join((f"{size_in_words(cause)}.", *cause_in_words(cause)))
        yield prose.section("cause", pictures, cause=title_of(cause), about=about)
    yield from ahead_sections(ahead, float(horizon), MOST_PATTERNS)
    if left is not None:
        yield from pattern_sections("What is left", left, MOST_PATTERNS)
    yield prose.section("simulated", diagnosis_figures.simulated_and_measured(improvement))
    yield prose.section(
        "improvement", diagnosis_figures.improvement_by_horizon(improvement), _improvement_table(improvement)
    )
    yield prose.section("systematic", table=_systematic_table(improvement))
    numbers = np.unique(windows.number).tolist()
    for number in numbers[:_MOST_RECORDINGS]:
        where = f" in {diagnosis.recordings.names[number]}" if len(numbers) > 1 else ""
        yield prose.section("over_time", diagnosis_figures.errors_over_time(improvement, number), where=where)
    # what was going on half the way into the simulation
    rows, at = windows.data.rows, windows.starts + round(horizon / windows.data.T_s / 2)
    against = {
        "speed (m/s)": rows[0, at],
        "lateral acceleration (m/s²)": rows[0, at] * rows[2, at],
        "steering (rad)": rows[4, at] + rows[6, at],
    }
    if diagnosis.recordings.recording.info.set_point == "throttle":
        against["throttle (negative: brake)"] = rows[3, at] + rows[5, at]
    else:
        against["speed set-point less speed (m/s)"] = rows[3, at] + rows[5, at] - rows[0, at]
    if windows.data.on_one_lap:
        against["position on the lap (m)"] = windows.data.context["s"][at]
    for label, values in against.items():
        shown = diagnosis_figures.errors_over(label, values, improvement)
        yield prose.section("against", shown, signal=label.split(" (")[0])
    named = [cause.effect for cause in diagnosis.found]
    yield prose.section("evidence", diagnosis_figures.evidence(diagnosis.selection.tried, named))
    yield prose.section("detectable", table=_detectable_table(diagnosis))
    yield prose.section("nominal", table=_nominal_table(diagnosis))
    if diagnosis.notes:
        yield prose.section("limits", notes=" ".join(f"{note[0].upper()}{note[1:]}." for note in diagnosis.notes))
    if diagnosis.not_judged:
        table = Table.of(
            diagnosis.not_judged,
            (Column("effect"), lambda one: one.effect),
            (Column("why"), lambda one: one.why),
            (Column("what would show it"), lambda one: one.manoeuvre or "nothing that these cars or sensors have"),
        )
        yield prose.section("not_judged", table=table)


_CHANNEL_AND_HORIZON: tuple[ColumnOf, ...] = (
    (Column("channel"), lambda at: f"{at.channel} ({UNITS[at.channel]})"),
    (Column("ahead", "s"), lambda at: f"{at.ahead:.4g}"),
)


class _At(NamedTuple):
    """A channel at a horizon: a row of tables, and the place ``[k, c]`` of its values."""

    channel: str
    ahead: float
    place: tuple[int, int]


def _channels_and_horizons(improvement: Improvement) -> list[_At]:
    horizons = [*enumerate(improvement.horizons)]
    return [_At(channel, ahead, (k, c)) for c, channel in enumerate(STATE_SIGNALS) for k, ahead in horizons]


def _improvement_table(improvement: Improvement) -> Table:
    less = {
        name: (improvement.reduction_from(name), *improvement.interval_from(name)) for name in (GIVEN, RECALIBRATED)
    }
    return Table.of(
        _channels_and_horizons(improvement),
        *_CHANNEL_AND_HORIZON,
        (
            [Column(name, group="error") for name in improvement.rmse],
            lambda at: [float(values[at.place]) for values in improvement.rmse.values()],
        ),
        (
            [Column(title, "%", f"less than {name}") for name in less for title in ("share", "from", "to")],
            lambda at: [round(100 * float(share[at.place])) for shares in less.values() for share in shares],
        ),
    )


def _systematic_table(improvement: Improvement) -> Table:
    gone, explained = improvement.systematic_gone(GIVEN), improvement.explained_variance

    def parts(at: _At) -> list[float]:
        k, c = at.place
        shares = {name: float(explained[name][k].share[c]) for name in improvement.rmse}
        return [
            float(values[k, c] * np.sqrt(part))
            for name, values in improvement.rmse.items()
            for part in (shares[name], 1.0 - shares[name])
        ]

    return Table.of(
        _channels_and_horizons(improvement),
        *_CHANNEL_AND_HORIZON,
        ([Column(title, "", name) for name in improvement.rmse for title in ("systematic", "rest")], parts),
        (Column("gone", "%", "systematic"), lambda at: 100 * float(gone[at.place])),
        (
            [Column(name, "%", "systematic by place alone") for name in (GIVEN, EXTENDED)],
            lambda at: [100 * float(explained[name][at.place[0]].by_place[at.place[1]]) for name in (GIVEN, EXTENDED)],
        ),
    )


def _detectable_table(diagnosis: Diagnosis) -> Table:
    about = {effect: EFFECTS[effect].magnitude() for effect in diagnosis.minimum_detectable}
    sizes = diagnosis.minimum_detectable
    return Table.of(
        sorted(sizes, key=lambda effect: sizes[effect] / about[effect].span),
        (Column("effect"), str),
        (Column("noticed from"), lambda effect: sizes[effect]),
        (Column("unit"), lambda effect: "" if about[effect].unit == "1" else about[effect].unit),
        (Column("judged"), lambda effect: "yes" if sizes[effect] <= about[effect].span else "no"),
    )


def _nominal_table(diagnosis: Diagnosis) -> Table:
    given, found = diagnosis.car.vehicle, diagnosis.vehicle
    was = {name: coefficient.nominal for name, coefficient in given.coefficients.items()} | {"m": given.constants.m}
    now = {name: coefficient.nominal for name, coefficient in found.coefficients.items()} | {"m": found.constants.m}
    std = {name: coefficient.std for name, coefficient in found.coefficients.items()}
    names = [*COEFFICIENTS, "m"]
    return Table.of(
        names,
        (Column("coefficient"), str),
        (Column("given"), was.get),
        (Column("refitted"), now.get),
        (Column("std"), std.get),
        (Column("moved"), lambda name: float(np.round(diagnosis.car.moved[names.index(name)], 2))),
        (Column("unit"), lambda name: COEFFICIENT_UNITS.get(name, "kg")),
    )
