"""A diagnosis in words: a sentence for each finding, the largest first, then what each rests on."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator

import numpy as np

from dynssm_ros.evaluation.residuals.anatomy import ModelAnatomy
from dynssm_ros.identification.result.diagnosis import RECALIBRATED, Cause, Conclusion, Diagnosis
from dynssm_ros.identification.result.formula import Formula
from dynssm_ros.identification.result.recalibration import CoefficientShift
from dynssm_ros.identification.result.residuals import ExplainedVariance
from dynssm_ros.identification.tuning import DECISIVE_DELTA_BIC, SURE_STD
from dynssm_ros.reporting.evaluation_figures import UNITS
from dynssm_ros.reporting.page import Prose
from dynssm_ros.reporting.residuals_report import pattern_lines
from dynssm_ros.reporting.tables import percent, text
from dynssm_ros.signals.findings import Finding
from dynssm_ros.signals.signal_map import STATE_SIGNALS
from dynssm_ros.vehicle import COEFFICIENT_UNITS
from dynssm_ros.vehicle.effects import EFFECTS

_LITTLE = 0.02  # of the squared error; less is not worth a word
_WIDTH = 110
_MANY_TIMES = 2.0  # farther off, a percentage says nothing
_MOST_COEFFICIENTS = 4  # that are named in a sentence
MOST_PATTERNS = 3  # of single steps, that are told
_FEW = 4  # parameters of a curve that are shown one by one


def as_text(diagnosis: Diagnosis, left: ModelAnatomy | None = None) -> str:
    """The result for a terminal: a sentence for each finding, then evidence, improvement, and what cannot be judged.

    ``left`` are the one-step errors of the extended car.
    """
    lines = [f"{diagnosis.verdict}: {headline(diagnosis)}"]
    for found in signal_findings(diagnosis):
        lines += textwrap.wrap(f"Signals that cannot be right: {found.line}.", _WIDTH)
    for number, one in enumerate(diagnosis.conclusions, 1):
        lines += textwrap.wrap(f"{number}. {conclusion_in_words(diagnosis, one)}", _WIDTH, subsequent_indent="   ")
    if left is not None and left.patterns:
        lines += ["What single steps of the car with the named causes get wrong, by its share of the squared error:"]
        lines += pattern_lines(left, MOST_PATTERNS)
    for cause in diagnosis.found:
        lines += ["", title_of(cause)]
        lines += [f"   {line}" for words in cause_in_words(cause) for line in textwrap.wrap(words, _WIDTH)]
    lines += ["", *improvement_in_words(diagnosis)]
    for words in (
        *moved_in_words(diagnosis),
        *hiding_in_words(diagnosis),
        *map(formula_in_words, diagnosis.formulas),
        *(f"Note: {note}." for note in diagnosis.notes),
    ):
        lines += textwrap.wrap(words, _WIDTH)
    if diagnosis.not_judged:
        lines += ["", "Cannot be judged on these laps:"]
        for what, effects in _not_judged_together(diagnosis).items():
            lines += textwrap.wrap(
                f"{', '.join(effects)}: {what}", _WIDTH, initial_indent="   ", subsequent_indent="      "
            )
    return "\n".join(lines)


def _not_judged_together(diagnosis: Diagnosis) -> dict[str, list[str]]:
    """Effects that cannot be judged, by what would show them, else why."""
    together: dict[str, list[str]] = {}
    for one in diagnosis.not_judged:
        together.setdefault(f"what would show it is {one.manoeuvre}" if one.manoeuvre else one.why, []).append(
            one.effect
        )
    return together


def signal_findings(diagnosis: Diagnosis) -> tuple[Finding, ...]:
    """Signals that cannot be right together."""
    return diagnosis.recordings.recording.info.findings


def headline(diagnosis: Diagnosis) -> str:
    """The verdict in a sentence."""
    return {
        "cause": f"The simulation lacks: {', '.join(cause.effect + recordings_of(cause) for cause in diagnosis.causes)}.",
        "unexplained": "Something is wrong that no effect of the library explains" + nearest_in_words(diagnosis) + ".",
        "recalibrate": f"{'Coefficients of the vehicle file are' if diagnosis.moved else 'The vehicle file is'} off. "
        "Recalibrated, the simulation is right within the noise of the measurement.",
        "healthy": "The simulation is right within the noise of the measurement, and the vehicle file's coefficients hold.",
    }[diagnosis.verdict]


def conclusion_in_words(diagnosis: Diagnosis, one: Conclusion) -> str:
    """A finding in a sentence."""
    if one.kind == "no_better":
        return _no_better_in_words(diagnosis, one.subject)
    if one.kind == "recalibration":
        return _recalibration_in_words(diagnosis)
    if one.kind == "unexplained":
        return left_in_words(diagnosis)
    cause = next(each for each in diagnosis.found if each.effect == one.subject)
    sure = "Sure but small, within the structure of the model: " if cause.small else ""
    cars = (
        (cause.of_given, "the file's car errs {} on held-out laps"),
        (cause.heldout_improvement, "a recalibrated one {}"),
    )
    gone = ", ".join(words.format(_less(share)) for share, words in cars)
    near = ", but it leaves errors of the same kind: it stands for something else" if cause.kind == "nearest" else ""
    return f"{sure}{cause.effect}{recordings_of(cause)}: {size_in_words(cause)}; with it {gone}{near}."


def nearest_in_words(diagnosis: Diagnosis) -> str:
    """The nearest effects, to end a sentence; empty without."""
    names = " and ".join(cause.effect + recordings_of(cause) for cause in diagnosis.nearest_effects)
    return f"; nearest is {names}" if names else ""


def _no_better_in_words(diagnosis: Diagnosis, channel: str) -> str:
    improvement, c = diagnosis.improvement, STATE_SIGNALS.index(channel)
    at = improvement.horizon
    errors = ", ".join(f"{text(float(rmse[at, c]))} {name}" for name, rmse in improvement.rmse.items())
    first = "throttle" if diagnosis.recordings.recording.info.set_point == "throttle" else "speed set-point"
    still = f"{text(float(improvement.persistence[at, c]))} {UNITS[channel]} if nothing changed"
    return (
        f"The {first if channel == 'v_x' else 'steering'} explains nothing of {channel}: "
        f"{improvement.horizons[at]:.4g} s ahead it errs by {errors}, and by {still}."
    )


def _recalibration_in_words(diagnosis: Diagnosis) -> str:
    found = diagnosis.recalibration
    if found is None:
        moved = ", ".join(f"{name} by {by:+.0f}" for name, by in diagnosis.moved.items())
        return (
            f"Coefficients that moved by more than three standard deviations, with little effect on the error: {moved}."
        )
    first, *others = found.coefficients
    named = [_shift_in_words(first), *(f"{one.name} ({_change(one.given, one.value)})" for one in others)]
    left = len(named) - _MOST_COEFFICIENTS
    return (
        f"The file is off in {', '.join(named[:_MOST_COEFFICIENTS])}{f' and {left} more' if left > 0 else ''}. Recalibrated, "
        f"{percent(found.explains)} of the error on held-out laps is gone."
    )


def _shift_in_words(one: CoefficientShift) -> str:
    return (
        f"{one.name} ({_change(one.given, one.value)}, {text(one.value)} ± {one.std:.2g}{_unit_of(one.name)}, "
        f"{abs(one.deviations):.1f} of its standard deviations; {percent(one.explains)} of the error)"
    )


def _unit_of(coefficient: str) -> str:
    """Its unit after a number."""
    return _spaced("kg" if coefficient == "m" else COEFFICIENT_UNITS[coefficient])


def _spaced(unit: str) -> str:
    return "" if unit == "1" else f" {unit}"


def _change(was: float, now: float) -> str:
    """How far a coefficient is off its value in the file."""
    if was * now > 0 and abs(now / was - 1) < _MANY_TIMES:
        return f"{percent(abs(now / was - 1))} {'more' if abs(now) > abs(was) else 'less'} than the file's {text(was)}"
    return f"where the file has {text(was)}"


def hiding_in_words(diagnosis: Diagnosis) -> list[str]:
    """Effects that the recalibration may hide, each with the size from which it would be named."""
    found = diagnosis.recalibration
    if found is None or not found.candidates:
        return []
    each = "; ".join(
        f"{one.effect} ({', '.join(f'{name} {text(value)}' for name, value in one.values.items())}; named from "
        f"{text(diagnosis.minimum_detectable[one.effect])} off neutral on)"
        for one in found.candidates
    )
    return [f"If the file's coefficients are right, the cause may be one that is too small to be named: {each}."]


def recordings_of(cause: Cause) -> str:
    """The recordings that a cause is in, if not in all."""
    together = {"session": ", one session", "road": ", one road"}.get(cause.level, "")
    return f" (only in {' and '.join(cause.only_in)}{together})" if cause.only_in else ""


def title_of(cause: Cause) -> str:
    """What stands above all that is said of it."""
    return f"{cause.effect}{recordings_of(cause)}{', the nearest effect' if cause.kind == 'nearest' else ''}"


def pattern_in_words(left: ExplainedVariance) -> str:
    """What systematic error goes with, and where on the lap it is farthest off."""
    parts = []
    for c, channel in enumerate(STATE_SIGNALS):
        if left.share[c] > _LITTLE:
            goes = ", ".join(f"{name} ({value:+.2f})" for name, value in left.pattern[channel].items())
            farthest = "; farthest off {:.0f} to {:.0f} m into the lap"
            parts.append(
                f"{channel}, {percent(left.share[c])} of the squared error: goes with {goes}"
                + (farthest.format(*left.stretch[channel]) if left.stretch else "")
            )
    return ". ".join(parts) + "." if parts else "the pattern is too weak to say with what it goes."


def left_in_words(diagnosis: Diagnosis) -> str:
    """What the car with the named causes gets wrong beyond noise; empty if there is nothing."""
    parts = []
    for one in diagnosis.structure[:MOST_PATTERNS]:
        ahead = f"{diagnosis.improvement.horizons[diagnosis.improvement.horizon]:.4g} s ahead"
        parts.append(f"{ahead.capitalize()}, {one.words}: {percent(one.share)} of its squared error.")
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
        if abs(diagnosis.moved[name]) <= SURE_STD:
            continue  # told by its part in the error
        what = f"{words[name]} ({name})" if name in words else name
        sentences.append(
            f"Recalibrated: {what} is {text(now)}{_unit_of(name)}, {_change(was, now)}: "
            f"{abs(diagnosis.moved[name]):.1f} of its standard deviations."
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
        unit = _spaced(EFFECTS[cause.effect].PARAMETERS[name].unit)
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
        f"it takes away {percent(cause.heldout_improvement)} of what a recalibrated car errs on held-out laps"
        if cause.heldout_improvement > 0
        else f"on held-out laps it takes nothing off a recalibrated car's error ({percent(cause.heldout_improvement)})"
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


def cause_in_words(cause: Cause) -> Iterator[str]:
    """What a cause is, how sure it is, what to do, and what else it could be."""
    effect = EFFECTS[cause.effect]
    yield effect.SUMMARY
    yield f"Evidence: {evidence_in_words(cause)}."
    if cause.kind == "nearest":
        yield "What to do: look for what the errors that are left go with; predictions gain by the effect until then."
    else:
        yield f"What to do: {effect.ADVICE}"
    if cause.alternatives:
        ways = "; ".join(f"{name}: {EFFECTS[name].MANOEUVRE}" for name in (cause.effect, *cause.alternatives))
        yield f"The data fit {' or '.join(cause.alternatives)} as well. To tell them apart, drive ({ways})."
