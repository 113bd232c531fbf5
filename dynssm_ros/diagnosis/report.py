"""A diagnosis in words, tables and figures."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from dynssm_ros.diagnosis import figures
from dynssm_ros.diagnosis.diagnose import Cause, Diagnosis
from dynssm_ros.diagnosis.systematic import Systematic
from dynssm_ros.evaluation.figures import UNITS
from dynssm_ros.evaluation.metrics import CHANNELS
from dynssm_ros.evaluation.report import Report, Section
from dynssm_ros.evaluation.tables import Column, Table, Value, percent, text
from dynssm_ros.vehicle import COEFFICIENT_UNITS, COEFFICIENTS
from dynssm_ros.vehicle.effects import EFFECTS


def in_words(diagnosis: Diagnosis) -> str:
    """The result for a terminal: cause, size, evidence, gain, what to do."""
    lines = [headline(diagnosis)]
    for number, cause in enumerate(diagnosis.causes, 1):
        effect = EFFECTS[cause.effect]
        lines += [
            "",
            f"{number}. {cause.effect}: {size_in_words(cause)}",
            f"   {effect.SUMMARY}",
            f"   Evidence: information criterion better by {cause.delta_bic:.0f} (6 is strong); without it the held-out "
            f"error is {percent(cause.heldout_gain)} of the present one larger"
            if cause.heldout_gain < 0
            else f"   Evidence: information criterion better by {cause.delta_bic:.0f} (6 is strong); it takes away "
            f"{percent(cause.heldout_gain)} of the held-out error",
            f"   What to do: {effect.ADVICE}",
        ]
        if cause.alternatives:
            lines.append(f"   {alternatives_in_words(cause)}")
    lines += ["", *gain_in_words(diagnosis)]
    lines += [f"note: {note}" for note in diagnosis.notes]
    return "\n".join(lines)


def headline(diagnosis: Diagnosis) -> str:
    """The verdict in a sentence."""
    if diagnosis.verdict == "effects":
        listed = ", ".join(cause.effect for cause in diagnosis.causes)
        return f"The simulation lacks: {listed}."
    if diagnosis.verdict == "none":
        return "The simulation is right within the noise of the measurement, once its nominal values are recalibrated."
    return f"Something is wrong that no effect of the library explains. {pattern_in_words(diagnosis.after)}"


def pattern_in_words(left: Systematic) -> str:
    """What systematic error goes with."""
    parts = []
    for c, channel in enumerate(CHANNELS):
        if left.share[c] > 0.02:
            goes = ", ".join(f"{name} ({value:+.2f})" for name, value in left.pattern[channel].items())
            parts.append(f"{channel}: {percent(left.share[c])} of the squared error is systematic, it goes with {goes}")
    return "; ".join(parts) + "." if parts else "The pattern is too weak to say with what it goes."


def size_in_words(cause: Cause) -> str:
    """The parameters with unit and standard deviation."""
    parts = []
    for name, value in cause.values.items():
        unit = EFFECTS[cause.effect].PARAMETERS[name].unit
        unit = "" if unit == "1" else f" {unit}"
        spread = f" ± {cause.std[name]:.2g}" if name in cause.std else " (assumed)"
        parts.append(f"{name} = {value:.4g}{spread}{unit}")
    return ", ".join(parts)


def alternatives_in_words(cause: Cause) -> str:
    """What the data cannot tell from a cause, and how to tell them apart."""
    ways = "; ".join(f"{name}: {EFFECTS[name].MANOEUVRE}" for name in (cause.effect, *cause.alternatives))
    return f"The data fit {' or '.join(cause.alternatives)} as well. To tell them apart, drive ({ways})."


def gain_in_words(diagnosis: Diagnosis) -> list[str]:
    """Errors before and after, by channel."""
    gain, lines = diagnosis.gain, []
    at = gain.horizon
    names = list(gain.rmse)
    for c, channel in enumerate(CHANNELS):
        values = " -> ".join(f"{text(float(gain.rmse[name][at, c]))} {name}" for name in names)
        low, high = gain.interval[:, at, c]
        lines.append(
            f"held-out error of {channel} after {gain.horizons[at]:g} s ({UNITS[channel]}): {values}; "
            f"{percent(float(gain.reduction[at, c]))} less (95 %: {percent(float(low))} to {percent(float(high))})"
        )
    return lines


def diagnosis_report(diagnosis: Diagnosis) -> Report:
    """The report with figures."""
    return Report(
        f"Diagnosis of {diagnosis.vehicle.name}",
        headline(diagnosis),
        tuple(_sections(diagnosis)),
        diagnosis.protocol,
        _causes(diagnosis) if diagnosis.causes else None,
    )


def _causes(diagnosis: Diagnosis) -> Table:
    columns = (
        Column("cause"), Column("size"), Column("better by", group="information criterion"),
        Column("less", "%", "held-out error"), Column("the data fit as well"), Column("what to do"),
    )  # fmt: skip
    rows: list[list[Value]] = [
        [
            cause.effect,
            size_in_words(cause),
            cause.delta_bic,
            100 * cause.heldout_gain,
            ", ".join(cause.alternatives) or None,
            EFFECTS[cause.effect].ADVICE,
        ]
        for cause in diagnosis.causes
    ]
    return Table(columns, rows)


def _sections(diagnosis: Diagnosis) -> Iterator[Section]:
    gain, windows = diagnosis.gain, diagnosis.gain.windows
    for cause in diagnosis.causes:
        words = f"{EFFECTS[cause.effect].SUMMARY} {size_in_words(cause)}."
        yield Section(cause.effect, words + (f" {alternatives_in_words(cause)}" if cause.alternatives else ""))
    yield Section(
        "Gain on held-out laps",
        "Root mean square error of simulations that start at measured states of laps that neither the fit nor the "
        "selection saw: the car as given, its nominal values recalibrated, and with the causes.",
        figures.gain_by_horizon(gain),
        _gain_table(diagnosis),
    )
    yield Section(
        "Evidence by effect",
        "How much each effect, alone, would improve the fit of the recalibrated car: decrease of twice the negative "
        "log-likelihood, in linearised errors. Named causes are coloured. Effects that share a pattern share evidence.",
        figures.evidence(diagnosis.selection.tried, [cause.effect for cause in diagnosis.causes]),
    )
    at = windows.starts + diagnosis.windows.steps // 2
    rows = windows.data.rows
    yield Section(
        f"Errors over time ({gain.horizons[gain.horizon]:g} s ahead)",
        "Held-out laps, before and after.",
        figures.errors_over("time (s)", gain.time, gain.errors, line=True),
    )
    for title, values in (
        ("speed (m/s)", rows[0, at]),
        ("lateral acceleration (m/s²)", rows[0, at] * rows[2, at]),
        ("steering (rad)", rows[4, at]),
        ("throttle (negative: brake)", rows[3, at]),
    ):
        yield Section(
            f"Errors against {title.split(' (')[0]}",
            "Mean and spread of the error in bins: a mean off zero is systematic.",
            figures.errors_over(title, values, gain.errors),
        )
    if "s" in windows.data.context:
        lap = windows.data.context["s"][at]
        yield Section(
            "Errors over the position on the lap",
            "A mean off zero stays at its place lap after lap.",
            figures.errors_over("position (m)", lap, gain.errors),
        )
    yield Section(
        "Systematic and noise",
        "Share of the squared error that the signals and the place on the lap foretell on parts of the data to which "
        f"that was not fitted. Left: {pattern_in_words(diagnosis.after)}",
        None,
        _systematic_table(diagnosis),
    )
    yield Section(
        "Nominal values",
        "What the fit makes of them. Moved: by how many of the standard deviations that the vehicle file states.",
        None,
        _nominal_table(diagnosis),
    )
    if diagnosis.notes:
        yield Section("Limits", " ".join(f"{note[0].upper()}{note[1:]}." for note in diagnosis.notes))


def _gain_table(diagnosis: Diagnosis) -> Table:
    gain = diagnosis.gain
    columns = (
        Column("channel"), Column("ahead", "s"), *(Column(name, group="error") for name in gain.rmse),
        Column("less", "%"), Column("from", "%", "95 % interval"), Column("to", "%", "95 % interval"),
    )  # fmt: skip
    rows: list[list[Value]] = []
    for c, channel in enumerate(CHANNELS):
        for k, ahead in enumerate(gain.horizons):
            values = [float(values[k, c]) for values in gain.rmse.values()]
            interval = [100 * float(v) for v in gain.interval[:, k, c]]
            rows.append(
                [f"{channel} ({UNITS[channel]})", float(ahead), *values, 100 * float(gain.reduction[k, c]), *interval]
            )
    return Table(columns, rows)


def _systematic_table(diagnosis: Diagnosis) -> Table:
    columns = (
        Column("channel"), Column("before", "%", "systematic"), Column("after", "%", "systematic"),
        Column("by place, before", "%"), Column("by place, after", "%"),
    )  # fmt: skip
    before, after = diagnosis.before, diagnosis.after
    rows: list[list[Value]] = [
        [channel, *(100 * float(v[c]) for v in (before.share, after.share, before.by_place, after.by_place))]
        for c, channel in enumerate(CHANNELS)
    ]
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
