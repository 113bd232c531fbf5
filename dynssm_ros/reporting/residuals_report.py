"""The page of the anatomy of errors, and what the terminal says of it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from dynssm_ros.evaluation.residuals.anatomy import Anatomy, ModelAnatomy
from dynssm_ros.evaluation.residuals.patterns import Pattern
from dynssm_ros.reporting import residuals_figures
from dynssm_ros.reporting.evaluation_figures import UNITS
from dynssm_ros.reporting.page import Prose, Report, Section, data_verdicts
from dynssm_ros.reporting.tables import Column, Table
from dynssm_ros.signals.signal_map import STATE_SIGNALS

_DRAWN = 8  # patterns of a model
_SHOWN = 6  # lines of a model on the terminal


def residuals_report(found: Anatomy) -> Report:
    """The report of an anatomy."""
    prose = Prose("residuals", found=found, false_alarms=100 * found.false_alarms, least=100 * found.least_share)
    return Report(
        title=f"Anatomy of the errors on {found.name}",
        summary=summary(found),
        sections=list(_sections(found, prose)),
        protocol=prose.protocol(
            rows=len(next(iter(found.models.values())).errors), rate=1 / found.recording.T_s,
            commands=found.recording.info.commands, sources=", ".join(found.recording.info.source),
        ),
        table=pattern_table(found),
        verdicts=data_verdicts(found.recording.info.findings),
    )  # fmt: skip


def summary(found: Anatomy) -> str:
    """The largest pattern of each model in a sentence."""
    return " ".join(
        f"{label}: {sentence(model.patterns[0])}."
        if model.patterns
        else f"{label}: no pattern beyond chance; what is left looks like noise."
        for label, model in found.models.items()
    )


def sentence(pattern: Pattern) -> str:
    """A pattern with its share."""
    return f"{pattern.words} ({100 * pattern.share:.2g} % of the squared error)"


def pattern_table(found: Anatomy) -> Table:
    """A row for each pattern."""
    return Table.of(
        [(label, pattern) for label, model in found.models.items() for pattern in model.patterns],
        (Column("model", brief=True), lambda row: row[0]),
        (Column("channel", brief=True), lambda row: row[1].channel),
        (Column("share", "% of squared error", brief=True), lambda row: 100 * row[1].share),
        (Column("pattern", brief=True), lambda row: row[1].words),
        (Column("chance"), lambda row: f"{row[1].p:.1g}"),
        caption="Share: what a pattern takes away once the larger ones of its channel that can be fitted are taken off.",
    )


def learn_table(found: Anatomy) -> Table:
    """What a strong learner still finds, by model and channel."""
    return Table.of(
        [(label, c, model) for label, model in found.models.items() for c in STATE_SIGNALS if c in model.left_to_learn],
        (Column("model"), lambda row: row[0]),
        (Column("channel"), lambda row: row[1]),
        (Column("RMSE", "m/s, rad/s"), lambda row: float(row[2].rmse[STATE_SIGNALS.index(row[1])])),
        (Column("left to learn", "% of squared error"), lambda row: 100 * row[2].left_to_learn[row[1]].share),
        (Column("by a filter of the last errors", "%"), lambda row: 100 * row[2].left_to_learn[row[1]].filtered),
        (Column("from"), lambda row: ", ".join([*row[2].left_to_learn[row[1]].uses][:3])),
    )


def as_text(found: Anatomy) -> str:
    """A line for each pattern, the largest first, and what can still be learned."""
    lines = []
    for label, model in found.models.items():
        errors = ", ".join(f"{c} {value:.3g} {UNITS[c]}" for c, value in zip(STATE_SIGNALS, model.rmse, strict=True))
        lines.append(f"{label} (one-step RMSE {errors})")
        lines += pattern_lines(model, _SHOWN)
        lines += [] if model.patterns else ["           no pattern beyond chance"]
        lines += [f"  left to learn: {left_in_words(model)}"] if model.left_to_learn else []
    return "\n".join(lines)


def pattern_lines(model: ModelAnatomy, most: int) -> list[str]:
    """A line for each of the ``most`` largest patterns, and how many are smaller."""
    more = len(model.patterns) - most
    return [f"  {100 * each.share:5.1f} %  {each.words}" for each in model.patterns[:most]] + (
        [f"           and {more} smaller, in the report"] if more > 0 else []
    )


def left_in_words(model: ModelAnatomy) -> str:
    """What can still be learned of each channel."""
    return ", ".join(f"{channel} {100 * each.share:.2g} %" for channel, each in model.left_to_learn.items())


def pattern_sections(label: str, model: ModelAnatomy, most: int) -> Iterator[Section]:
    """A figure for each of the ``most`` largest patterns that have one."""
    prose = Prose("residuals")
    for pattern in [each for each in model.patterns if each.picture is not None][:most]:
        figure = residuals_figures.pattern_figure(pattern)
        yield prose.section(pattern.family, figure, model=label, channel=pattern.channel, words=_advised(pattern))


def ahead_sections(ahead: Sequence[Pattern], horizon: float, most: int) -> Iterator[Section]:
    """A figure for each of the ``most`` largest patterns of errors ``horizon`` seconds ahead."""
    prose = Prose("residuals", horizon=f"{horizon:.4g}")
    for pattern in ahead[:most]:
        figure = residuals_figures.pattern_figure(pattern)
        yield prose.section("ahead", figure, channel=pattern.channel, words=_advised(pattern))


def _advised(pattern: Pattern) -> str:
    return ". ".join(part.removesuffix(".") for part in (sentence(pattern), pattern.advice) if part)


def _sections(found: Anatomy, prose: Prose) -> Iterator[Section]:
    for label, model in found.models.items():
        yield from pattern_sections(label, model, _DRAWN)
    if any(model.left_to_learn for model in found.models.values()):
        yield prose.section("left", residuals_figures.left_to_learn_figure(found), learn_table(found))
    curves = {label: model.autocorrelation for label, model in found.models.items()}
    yield prose.section("autocorrelation", residuals_figures.autocorrelation_figure(curves, found.recording.T_s))
