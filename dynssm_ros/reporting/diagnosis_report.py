"""A diagnosis in words, tables and figures."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from dynssm_ros.identification.result.diagnosis import EXTENDED, GIVEN, RECALIBRATED, Cause, Diagnosis
from dynssm_ros.identification.result.formula import Formula
from dynssm_ros.identification.result.improvement import Improvement
from dynssm_ros.identification.result.residuals import ExplainedVariance
from dynssm_ros.identification.tuning import DECISIVE_DELTA_BIC
from dynssm_ros.reporting import diagnosis_figures
from dynssm_ros.reporting.evaluation_figures import UNITS
from dynssm_ros.reporting.page import Prose, Report, Section, data_verdicts
from dynssm_ros.reporting.tables import Column, ColumnOf, Table, percent, text
from dynssm_ros.signals.findings import Finding
from dynssm_ros.signals.signal_map import STATE_SIGNALS
from dynssm_ros.vehicle import COEFFICIENT_UNITS, COEFFICIENTS
from dynssm_ros.vehicle.effects import EFFECTS

_LITTLE = 0.02  # of the squared error; less is not worth a word
_WIDTH = 110
_MANY_TIMES = 2.0  # farther off, a percentage says nothing
_MOST_RECORDINGS = 6  # whose errors are drawn over time
_FEW = 4  # parameters of a curve that are shown one by one


def as_text(diagnosis: Diagnosis) -> str:
    """The result for a terminal: cause, size, evidence, improvement, what to do, what is left."""
    lines = [headline(diagnosis)]
    for found in _findings(diagnosis):
        lines += textwrap.wrap(f"Signals that cannot be right: {found.line}.", _WIDTH)
    for number, cause in enumerate(diagnosis.found, 1):
        share = f"{'small, ' if cause.small else ''}{percent(cause.heldout_improvement)} of the error on held-out laps"
        lines += ["", f"{number}. {cause.effect}{_where(cause)}: {size_in_words(cause)}; {share}"]
        lines += [f"   {line}" for words in _about(cause) for line in textwrap.wrap(words, _WIDTH)]
    lines += ["", *improvement_in_words(diagnosis)]
    for words in (
        *moved_in_words(diagnosis),
        left_in_words(diagnosis),
        *map(formula_in_words, diagnosis.formulas),
        *(f"Note: {note}." for note in diagnosis.notes),
    ):
        lines += textwrap.wrap(words, _WIDTH)
    return "\n".join(lines)


def _findings(diagnosis: Diagnosis) -> tuple[Finding, ...]:
    return diagnosis.recordings.recording.info.findings


def headline(diagnosis: Diagnosis) -> str:
    """The verdict in a sentence, and what is small in another."""
    causes, small = (
        ", ".join(cause.effect + _where(cause) for cause in each)
        for each in (diagnosis.causes, diagnosis.small_effects)
    )
    words = {
        "effects": f"The simulation lacks: {causes}.",
        "none": "The simulation is right within the noise of the measurement, once its nominal values are recalibrated.",
        "unexplained": "Something is wrong that no effect of the library explains.",
    }[diagnosis.verdict]
    return f"{words} Sure but small, within the structure of the model: {small}." if small else words


def _where(cause: Cause) -> str:
    """The recordings that a cause is in, if not in all."""
    together = {"session": ", one session", "road": ", one road"}.get(cause.level, "")
    return f" (only in {' and '.join(cause.only_in)}{together})" if cause.only_in else ""


def pattern_in_words(left: ExplainedVariance) -> str:
    """What systematic error goes with, and where on the lap it is farthest off."""
    parts = []
    for c, channel in enumerate(STATE_SIGNALS):
        if left.share[c] > _LITTLE:
            goes = ", ".join(f"{name} ({value:+.2f})" for name, value in left.pattern[channel].items())
            where = "; farthest off {:.0f} to {:.0f} m into the lap"
            parts.append(
                f"{channel}, {percent(left.share[c])} of the squared error: goes with {goes}"
                + (where.format(*left.stretch[channel]) if left.stretch else "")
            )
    return ". ".join(parts) + "." if parts else "the pattern is too weak to say with what it goes."


def left_in_words(diagnosis: Diagnosis) -> str:
    """What the extended car gets wrong beyond noise; empty if there is nothing."""
    parts = []
    if diagnosis.left.is_there:
        parts.append(f"Systematic error that is left, and what it goes with: {pattern_in_words(diagnosis.left)}")
    if diagnosis.clustered.is_there:
        recording, low = diagnosis.recordings.place(diagnosis.clustered.when[0])
        high = low + diagnosis.clustered.when[1] - diagnosis.clustered.when[0]
        parts.append(
            "Errors come together over seconds as noise does not, so that something is missing that comes and goes; they are "
            f"largest {low:.0f} to {high:.0f} s into {recording}."
        )
    return " ".join(parts)


def formula_in_words(formula: Formula) -> str:
    """The term that is missing, and what it takes away where it was not fitted."""
    terms = "".join(
        f" {'-' if c < 0 else '+'} {text(abs(c))}{'' if name == '1' else f' {name}'}"
        for name, c in formula.terms.items()
    )
    parts = int((formula.improvement > 0).sum())
    time = "; t since the start of the recording" if any("t" in name.split() for name in formula.terms) else ""
    return (
        f"d{formula.channel}/dt may lack{terms} (SI units; throttle and steering as applied{time}): on parts of the drive "
        f"that were left out that takes {percent(formula.share)} of the squared error, in {parts} of "
        f"{len(formula.improvement)} parts."
    )


def moved_in_words(diagnosis: Diagnosis) -> list[str]:
    """What recalibration moved farther than the vehicle file allows for."""
    sentences, words = [], Prose("diagnosis").words["coefficients"]
    for name, (was, now) in diagnosis.recalibrated.items():
        unit = "kg" if name == "m" else COEFFICIENT_UNITS[name]
        value = text(now) if unit == "1" else f"{text(now)} {unit}"
        what = f"{words[name]} ({name})" if name in words else name
        if was * now > 0 and abs(now / was - 1) < _MANY_TIMES:
            more = f"{abs(now / was - 1):.0%} {'more' if abs(now) > abs(was) else 'less'}"
            change = f"{more} than the vehicle file's {text(was)}"
        else:
            change = f"where the vehicle file has {text(was)}"
        sentences.append(
            f"Recalibrated: {what} is {value}, {change}: {abs(diagnosis.moved[name]):.0f} of its standard deviations."
        )
    return sentences


def size_in_words(cause: Cause) -> str:
    """The parameters with unit and standard deviation, or a bound that they are at; of a long curve its range."""
    profile = EFFECTS[cause.effect](**cause.values).along_lap(np.linspace(0.0, 1.0, 200))
    if profile is not None and len(cause.std) > _FEW:
        label, values = profile
        return f"{label} from {values.min():.3g} to {values.max():.3g} along the lap, {len(cause.std)} parameters"
    parts = []
    for name, value in cause.values.items():
        unit = EFFECTS[cause.effect].PARAMETERS[name].unit
        unit = "" if unit == "1" else f" {unit}"
        if name in cause.on_bound:
            spread = " or farther from neutral (at its bound)"
        else:
            otherwise = " (read off single steps)" if name in EFFECTS[cause.effect].READ_OFF else " (assumed)"
            spread = f" ± {cause.std[name]:.2g}" if name in cause.std else otherwise
        parts.append(f"{name} = {value:.4g}{spread}{unit}")
    return ", ".join(parts)


def evidence_in_words(cause: Cause) -> str:
    """How sure the cause is, and what it takes away."""
    held_out = (
        f"it takes away {percent(cause.heldout_improvement)} of the error on held-out laps"
        if cause.heldout_improvement > 0
        else f"on held-out laps it takes nothing away ({percent(cause.heldout_improvement)})"
    )
    confirmed, units = cause.confirmation, cause.confirmation.improvement
    shares = zip(STATE_SIGNALS, confirmed.share, strict=True)
    gone = ", ".join(f"{percent(max(float(share), 0.0))} ({channel})" for channel, share in shares)
    return (
        f"on parts of the drive that were left out the logarithm of the predictive likelihood is better by "
        f"{confirmed.total:.0f} ± {confirmed.std:.0f}, in {int((units > 0).sum())} of {len(units)} parts, and "
        f"of the squared error {gone} is gone; the information criterion is better by {cause.delta_bic:.0f} "
        f"(above {DECISIVE_DELTA_BIC:.0f} is very strong); {held_out}"
    )


def improvement_in_words(diagnosis: Diagnosis) -> list[str]:
    """Errors before and after, by channel."""
    improvement = diagnosis.improvement
    at = improvement.horizon
    low, high = improvement.interval_from(RECALIBRATED)[:, at]
    lines = [f"Error on held-out laps {improvement.horizons[at]:.4g} s ahead:"]
    for c, channel in enumerate(STATE_SIGNALS):
        values = ", ".join(f"{text(float(values[at, c]))} {name}" for name, values in improvement.rmse.items())
        lines.append(
            f"   {channel} ({UNITS[channel]}): {values}: {_less(improvement.reduction[at, c])} than as given, "
            f"{_less(improvement.reduction_from(RECALIBRATED)[at, c])} than recalibrated "
            f"(95 %: {_less(low[c])} to {_less(high[c])})"
        )
    return lines


def _less(share: float) -> str:
    """How much of an error a reduction takes away, or adds."""
    return f"{percent(abs(float(share)))} {'less' if share >= 0 else 'more'}"


def diagnosis_report(diagnosis: Diagnosis) -> Report:
    """The report with figures."""
    return Report(
        f"Diagnosis of {diagnosis.vehicle.name}",
        f"{headline(diagnosis)} {left_in_words(diagnosis)}".strip(),
        tuple(_sections(diagnosis)),
        diagnosis.protocol,
        _causes(diagnosis) if diagnosis.found else None,
        verdicts=data_verdicts(_findings(diagnosis)),
    )


def _about(cause: Cause) -> Iterator[str]:
    effect = EFFECTS[cause.effect]
    yield effect.SUMMARY
    yield f"Evidence: {evidence_in_words(cause)}."
    yield f"What to do: {effect.ADVICE}"
    if cause.alternatives:
        ways = "; ".join(f"{name}: {EFFECTS[name].MANOEUVRE}" for name in (cause.effect, *cause.alternatives))
        yield f"The data fit {' or '.join(cause.alternatives)} as well. To tell them apart, drive ({ways})."


def _causes(diagnosis: Diagnosis) -> Table:
    return Table.of(
        diagnosis.found,
        (Column("cause"), lambda cause: cause.effect + _where(cause)),
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


def _sections(diagnosis: Diagnosis) -> Iterator[Section]:
    improvement = diagnosis.improvement
    windows, horizon = improvement.windows, improvement.horizons[improvement.horizon]
    prose = Prose(
        "diagnosis", given=GIVEN, recalibrated=RECALIBRATED, extended=EXTENDED, horizon=horizon,
        longest=improvement.horizons[-1], left=left_in_words(diagnosis),
        formulas=" ".join(map(formula_in_words, diagnosis.formulas)), moved=" ".join(moved_in_words(diagnosis)),
    )  # fmt: skip
    for cause in diagnosis.found:
        effect, with_it = EFFECTS[cause.effect](**cause.values), improvement.errors[EXTENDED][:, improvement.horizon]
        pictures = diagnosis_figures.cause_pictures(windows, cause.without, with_it, effect)
        about = " ".join((f"{size_in_words(cause)}.", *_about(cause)))
        yield prose.section("cause", pictures, cause=cause.effect + _where(cause), about=about)
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
