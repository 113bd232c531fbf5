"""A diagnosis in words, tables and figures."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator

import numpy as np

from dynssm_ros.arrays import Vector
from dynssm_ros.identification.result.diagnosis import EXTENDED, GIVEN, RECALIBRATED, Cause, Diagnosis
from dynssm_ros.identification.result.formula import Formula
from dynssm_ros.identification.result.residuals import ExplainedVariance
from dynssm_ros.identification.search.selection import DECISIVE_DELTA_BIC
from dynssm_ros.reporting import diagnosis_figures
from dynssm_ros.reporting.evaluation_figures import UNITS
from dynssm_ros.reporting.page import Report, Section
from dynssm_ros.reporting.tables import Column, Table, Value, percent, text
from dynssm_ros.signals.signal_map import STATE_SIGNALS
from dynssm_ros.vehicle import COEFFICIENT_UNITS, COEFFICIENTS
from dynssm_ros.vehicle.effects import EFFECTS

_COEFFICIENTS_IN_WORDS = {
    "D_f": "the front tyres' peak force", "D_r": "the rear tyres' peak force", "C_m1": "the drive force",
    "C_m2": "what the drive loses with speed", "C_r0": "the rolling resistance", "C_r2": "the drag", "I_z": "the yaw inertia",
    "S_hf": "the front slip angle's zero", "S_hr": "the rear slip angle's zero", "m": "the mass",
    "B_f": "the front tyres' stiffness", "B_r": "the rear tyres' stiffness",
}  # fmt: skip
_LITTLE = 0.02  # of the squared error; less is not worth a word
_WIDTH = 110
_MANY_TIMES = 2.0  # farther off, a percentage says nothing
_FEW = 4  # parameters of a curve that are shown one by one


def as_text(diagnosis: Diagnosis) -> str:
    """The result for a terminal: cause, size, evidence, improvement, what to do, what is left."""
    lines = [headline(diagnosis)]
    for number, cause in enumerate(diagnosis.found, 1):
        lines += ["", f"{number}. {cause.effect}{_where(cause)}: {size_in_words(cause)}; {_share_in_words(cause)}"]
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


def _share_in_words(cause: Cause) -> str:
    """Its share of the error in a few words."""
    return f"{'small, ' if cause.small else ''}{percent(cause.heldout_improvement)} of the error on held-out laps"


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
    sentences = []
    for name, (was, now) in diagnosis.recalibrated.items():
        unit = "kg" if name == "m" else COEFFICIENT_UNITS[name]
        value = text(now) if unit == "1" else f"{text(now)} {unit}"
        what = f"{_COEFFICIENTS_IN_WORDS[name]} ({name})" if name in _COEFFICIENTS_IN_WORDS else name
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
            spread = f" ± {cause.std[name]:.2g}" if name in cause.std else " (assumed)"
        parts.append(f"{name} = {value:.4g}{spread}{unit}")
    return ", ".join(parts)


def evidence_in_words(cause: Cause) -> str:
    """How sure the cause is, and what it takes away."""
    held_out = (
        f"it takes away {percent(cause.heldout_improvement)} of the error on held-out laps"
        if cause.heldout_improvement > 0
        else f"on held-out laps it takes nothing away ({percent(cause.heldout_improvement)})"
    )
    confirmed = cause.confirmation
    units = confirmed.improvement
    strong = f"above {DECISIVE_DELTA_BIC:.0f} is very strong"
    return (
        f"on parts of the drive that were left out the logarithm of the predictive likelihood is better by "
        f"{confirmed.total:.0f} ± {confirmed.std:.0f}, in {int((units > 0).sum())} of {len(units)} parts, and "
        f"of the squared error {_shares(confirmed.share)} is gone; the information criterion is better by "
        f"{cause.delta_bic:.0f} ({strong}); {held_out}"
    )


def _shares(share: Vector) -> str:
    return ", ".join(f"{percent(max(float(s), 0.0))} ({c})" for c, s in zip(STATE_SIGNALS, share, strict=True))


def alternatives_in_words(cause: Cause) -> str:
    """What the data cannot tell from a cause, and how to tell them apart."""
    ways = "; ".join(f"{name}: {EFFECTS[name].MANOEUVRE}" for name in (cause.effect, *cause.alternatives))
    return f"The data fit {' or '.join(cause.alternatives)} as well. To tell them apart, drive ({ways})."


def improvement_in_words(diagnosis: Diagnosis) -> list[str]:
    """Errors before and after, by channel."""
    improvement = diagnosis.improvement
    at = improvement.horizon
    low, high = improvement.interval_from(RECALIBRATED)[:, at]
    lines = [f"Error on held-out laps {improvement.horizons[at]:.4g} s ahead:"]
    for c, channel in enumerate(STATE_SIGNALS):
        values = ", ".join(f"{text(float(values[at, c]))} {name}" for name, values in improvement.rmse.items())
        lines.append(
            f"   {channel} ({UNITS[channel]}): {values}: {percent(float(improvement.reduction[at, c]))} less than as given, "
            f"{percent(float(improvement.reduction_from(RECALIBRATED)[at, c]))} less than recalibrated "
            f"(95 %: {percent(float(low[c]))} to {percent(float(high[c]))})"
        )
    return lines


def diagnosis_report(diagnosis: Diagnosis) -> Report:
    """The report with figures."""
    return Report(
        f"Diagnosis of {diagnosis.vehicle.name}",
        f"{headline(diagnosis)} {left_in_words(diagnosis)}".strip(),
        tuple(_sections(diagnosis)),
        diagnosis.protocol,
        _causes(diagnosis) if diagnosis.found else None,
    )


def _about(cause: Cause) -> Iterator[str]:
    effect = EFFECTS[cause.effect]
    yield effect.SUMMARY
    yield f"Evidence: {evidence_in_words(cause)}."
    yield f"What to do: {effect.ADVICE}"
    if cause.alternatives:
        yield alternatives_in_words(cause)


def _causes(diagnosis: Diagnosis) -> Table:
    columns = (
        Column("cause"), Column("size"), Column("better by", group="left-out parts"), Column("±", group="left-out parts"),
        *(Column(channel, "%", "squared error gone there") for channel in STATE_SIGNALS),
        Column("less", "%", "held-out error"), Column("the data fit as well"),
    )  # fmt: skip
    rows: list[list[Value]] = [
        [
            cause.effect + _where(cause),
            size_in_words(cause),
            cause.confirmation.total,
            cause.confirmation.std,
            *(100 * float(share) for share in cause.confirmation.share),
            100 * cause.heldout_improvement,
            ", ".join(cause.alternatives) or "nothing else",
        ]
        for cause in diagnosis.found
    ]
    return Table(columns, rows)


def _sections(diagnosis: Diagnosis) -> Iterator[Section]:
    improvement = diagnosis.improvement
    for cause in diagnosis.found:
        yield Section(
            cause.effect + _where(cause),
            " ".join((f"{size_in_words(cause)}.", *_about(cause))),
            diagnosis_figures.cause_pictures(
                improvement.windows,
                cause.without,
                improvement.errors[EXTENDED][:, improvement.horizon],
                EFFECTS[cause.effect](**cause.values),
            ),
        )
    yield from _improved(diagnosis)
    yield from _shown(diagnosis)
    yield from _found(diagnosis)
    if diagnosis.notes:
        yield Section("Limits", " ".join(f"{note[0].upper()}{note[1:]}." for note in diagnosis.notes))


def _improved(diagnosis: Diagnosis) -> Iterator[Section]:
    improvement = diagnosis.improvement
    yield Section(
        "Simulated and measured",
        f"A lively stretch of the held-out laps. Each simulation starts at a measured state and runs free for "
        f"{improvement.horizons[-1]:.4g} s, with the measured throttle and steering.",
        diagnosis_figures.simulated_and_measured(improvement),
    )
    yield Section(
        "Improvement on held-out laps",
        "Root mean square error of simulations that start at measured states of laps that neither the fit nor the "
        f"selection saw: the car {GIVEN}, its nominal values {RECALIBRATED} without any cause, and {EXTENDED} by the "
        "causes. Intervals are from a bootstrap over blocks in time. What is systematic the signals and the place on the "
        "lap predict, on parts of the data to which that was not fitted.",
        diagnosis_figures.improvement_by_horizon(improvement),
        _improvement_table(diagnosis),
    )
    yield Section(
        "Systematic error and noise",
        "The same errors in two parts: what the signals and the place on the lap predict, and the rest, which is noise "
        "or what the signals do not show. By place alone is what repeats lap after lap. Gone is the share of the "
        f"systematic squared error of the car {GIVEN} that the extended one does not make. {left_in_words(diagnosis)} "
        + " ".join(map(formula_in_words, diagnosis.formulas)),
        None,
        _systematic_table(diagnosis),
    )


def _shown(diagnosis: Diagnosis) -> Iterator[Section]:
    improvement = diagnosis.improvement
    windows = improvement.windows
    rows = windows.data.rows
    yield Section(
        "Errors over time",
        "Predicted minus measured on the held-out laps, one step and "
        f"{improvement.horizons[improvement.horizon]:.4g} s ahead.",
        diagnosis_figures.errors_over_time(improvement),
    )
    # what was going on half the way into the simulation
    at = windows.starts + round(improvement.horizons[improvement.horizon] / windows.data.T_s / 2)
    against = {
        "speed (m/s)": rows[0, at],
        "lateral acceleration (m/s²)": rows[0, at] * rows[2, at],
        "steering (rad)": rows[4, at] + rows[6, at],
        "throttle (negative: brake)": rows[3, at] + rows[5, at],
    }
    if windows.data.on_one_lap:
        against["position on the lap (m)"] = windows.data.context["s"][at]
    for label, values in against.items():
        yield Section(
            f"Errors against {label.split(' (')[0]}",
            "Mean and spread in bins: where the mean is off zero by more than the line's wiggling, the error is "
            f"systematic. The car {GIVEN} may leave the panel.",
            diagnosis_figures.errors_over(label, values, improvement),
        )


def _found(diagnosis: Diagnosis) -> Iterator[Section]:
    yield Section(
        "Evidence by effect",
        "How much each effect, alone, would improve the fit of the recalibrated car. Named causes are coloured. Effects "
        "that leave like traces share the evidence; the causes named explain it best together.",
        diagnosis_figures.evidence(diagnosis.selection.tried, [cause.effect for cause in diagnosis.found]),
    )
    yield Section(
        "What these laps would show",
        "How far off neutral each effect that was not named would have to be to be named: the driving must excite it, and "
        "the nominal values must be known well enough not to take it up. Where the bounds of the effect do not reach that "
        "far, it cannot be judged.",
        None,
        _detectable_table(diagnosis),
    )
    yield Section(
        "Nominal values",
        "What the fit makes of them. Moved: by how many of the standard deviations that the vehicle file states. "
        + " ".join(moved_in_words(diagnosis)),
        None,
        _nominal_table(diagnosis),
    )


def _improvement_table(diagnosis: Diagnosis) -> Table:
    improvement = diagnosis.improvement
    columns = (
        Column("channel"), Column("ahead", "s"), *(Column(name, group="error") for name in improvement.rmse),
        *(
            Column(title, "%", f"less than {name}")
            for name in (GIVEN, RECALIBRATED) for title in ("share", "from", "to")
        ),
    )  # fmt: skip
    less = [(improvement.reduction_from(name), *improvement.interval_from(name)) for name in (GIVEN, RECALIBRATED)]
    rows: list[list[Value]] = []
    for c, channel in enumerate(STATE_SIGNALS):
        for k, ahead in enumerate(improvement.horizons):
            values = [float(values[k, c]) for values in improvement.rmse.values()]
            shares = [round(100 * float(v[k, c])) for one in less for v in one]
            rows.append([f"{channel} ({UNITS[channel]})", f"{ahead:.4g}", *values, *shares])
    return Table(columns, rows)


def _systematic_table(diagnosis: Diagnosis) -> Table:
    improvement = diagnosis.improvement
    columns = (
        Column("channel"), Column("ahead", "s"),
        *(Column(title, "", name) for name in improvement.rmse for title in ("systematic", "rest")),
        Column("gone", "%", "systematic"),
        *(Column(name, "%", "systematic by place alone") for name in (GIVEN, EXTENDED)),
    )  # fmt: skip
    gone = improvement.systematic_gone(GIVEN)
    rows: list[list[Value]] = []
    for c, channel in enumerate(STATE_SIGNALS):
        for k, ahead in enumerate(improvement.horizons):
            parts: list[Value] = []
            for name, values in improvement.rmse.items():
                share = float(improvement.explained_variance[name][k].share[c])
                parts += [float(values[k, c] * np.sqrt(part)) for part in (share, 1.0 - share)]
            place = [100 * float(improvement.explained_variance[name][k].by_place[c]) for name in (GIVEN, EXTENDED)]
            rows.append([f"{channel} ({UNITS[channel]})", f"{ahead:.4g}", *parts, 100 * float(gone[k, c]), *place])
    return Table(columns, rows)


def _detectable_table(diagnosis: Diagnosis) -> Table:
    columns = (Column("effect"), Column("noticed from"), Column("unit"), Column("judged"))
    rows: list[list[Value]] = []
    for effect, size in sorted(
        diagnosis.minimum_detectable.items(), key=lambda item: item[1] / EFFECTS[item[0]].magnitude().span
    ):
        about = EFFECTS[effect].magnitude()
        rows.append([effect, size, "" if about.unit == "1" else about.unit, "yes" if size <= about.span else "no"])
    return Table(columns, rows)


def _nominal_table(diagnosis: Diagnosis) -> Table:
    given, found = diagnosis.car.vehicle, diagnosis.vehicle
    columns = (
        Column("coefficient"),
        Column("given"),
        Column("refitted"),
        Column("std"),
        Column("moved"),
        Column("unit"),
    )
    rows: list[list[Value]] = [
        [
            name,
            given.coefficients[name].nominal,
            found.coefficients[name].nominal,
            found.coefficients[name].std,
            float(np.round(diagnosis.car.moved[k], 2)),
            COEFFICIENT_UNITS[name],
        ]
        for k, name in enumerate(COEFFICIENTS)
    ]
    rows.append(["m", given.constants.m, found.constants.m, None, float(np.round(diagnosis.car.moved[17], 2)), "kg"])
    return Table(columns, rows)
