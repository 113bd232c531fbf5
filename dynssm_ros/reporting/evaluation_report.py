"""The tables and the report of an open-loop evaluation."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from functools import partial
from typing import Literal

import numpy as np
from matplotlib.figure import Figure

from dynssm_ros.arrays import Vector
from dynssm_ros.evaluation.coefficients import coefficient_unit
from dynssm_ros.evaluation.open_loop import Evaluation
from dynssm_ros.evaluation.regimes import COASTING, QUANTITIES, Regime
from dynssm_ros.evaluation.rollout import branches
from dynssm_ros.evaluation.score import Group, Score
from dynssm_ros.reporting import evaluation_figures, interactive, track_figures
from dynssm_ros.reporting.page import Prose, Report, Section, data_verdicts
from dynssm_ros.reporting.tables import Column, Table, percent, text
from dynssm_ros.signals.signal_map import STATE_SIGNALS
from dynssm_ros.track.lap_position import track_position
from dynssm_ros.vehicle import COEFFICIENTS
from dynssm_ros.vehicle.kinematics import path

COMMANDS_IN_WORDS = {
    "topics": "topics: the recorded command topics, as increments on the feedback",
    "lookahead": "lookahead: the next feedback sample serves as command, as in the published data sets. It looks into "
    "the future and does not exist live",
    "none": "none: command inputs are zero",
}
_TITLES = {"v_x": "v_x", "v_y": "v_y", "omega": "ω"}
_CUT = f"A model that leaves a panel is over {evaluation_figures.OUTLYING:g} times worse than the middle one of the models."
_MODEL = (Column("model", brief=True), lambda group: group.name)


def summary_table(evaluation: Evaluation) -> Table:
    """One row per model: displacement over the horizon, one-step errors, size and speed."""
    return Table.of(
        evaluation.groups.values(),
        _MODEL,
        (
            (Column("ADE", "m", "path", "min", brief=True), Column("FDE", "m", "path", "min", brief=True)),
            lambda group: group.spreads(lambda score: [score.rollout.ade, score.rollout.fde]),
        ),
        (_channels("RMSE", "min", brief=True), lambda group: group.spreads(lambda score: score.rmse)),
        (_channels("largest error", "min"), lambda group: group.spreads(lambda score: score.max_error)),
        *([(_channels("left to learn", unit="%", brief=True), partial(_left, evaluation))] if evaluation.left else []),
        (Column("parameters"), lambda group: group.first.model.parameters),
        (Column("FLOPs"), lambda group: group.first.model.flops),
        (
            (Column("p50", "µs", "latency", brief=True), Column("p99", "µs", "latency")),
            lambda group: group.spreads(lambda score: score.latency),
        ),
        caption=f"{len(evaluation.rows):,} one-step predictions and {evaluation.starts:,} rollouts over "
        f"{evaluation.horizon_s:g} s, the same rows for every model.{_seeds_in_words(evaluation)}"
        + "".join(f" No test: {note}." for note in evaluation.not_tests),
    )


def _left(evaluation: Evaluation, group: Group) -> list[float]:
    """Percentage of the squared one-step error that boosted trees still take away, by channel."""
    found = evaluation.left.get(group.name, {})
    return [100 * found[channel].share if channel in found else np.nan for channel in STATE_SIGNALS]


def _channels(group: str, best: Literal["min"] | None = None, unit: str = "", brief: bool = False) -> list[Column]:
    """A column for each channel of the state."""
    return [Column(_TITLES[c], unit or evaluation_figures.UNITS[c], group, best, brief=brief) for c in STATE_SIGNALS]


def coverage_table(evaluation: Evaluation) -> Table | None:
    """How often the error lies inside the models' own 90 % interval; ``None`` if no model states one."""
    stating = [group for group in evaluation.groups.values() if group.first.coverage_90 is not None]
    shares = _channels("inside the 90 % interval", unit="%")
    seeds = _seeds_in_words(evaluation).strip()
    table = Table.of(
        stating,
        _MODEL,
        (shares, lambda group: group.spreads(lambda score: _percentages(score.coverage_90))),
        caption=seeds,
    )
    return table if stating else None


def regime_table(evaluation: Evaluation, quantity: str) -> Table:
    """One-step RMSE of every model in the regimes of one quantity, columns grouped by channel."""
    chosen, regimes = _regimes(evaluation, quantity)
    columns = [
        Column(regime.short, regime.unit, f"{_TITLES[channel]} RMSE ({evaluation_figures.UNITS[channel]})", "min")
        for channel in STATE_SIGNALS
        for regime in regimes
    ]
    counts = "; ".join(f"{regime.name}: {regime.rows:,}" for regime in regimes)
    return Table.of(
        evaluation.groups.values(),
        _MODEL,
        (columns, lambda group: group.spreads(lambda score: score.regime_rmse[chosen].T.ravel())),
        caption=f"Rows: {counts}.{_seeds_in_words(evaluation)}",
    )


def _regimes(evaluation: Evaluation, quantity: str) -> tuple[list[int], list[Regime]]:
    """Places and regimes of one quantity."""
    chosen = [k for k, regime in enumerate(evaluation.regimes) if regime.quantity == quantity]
    return chosen, [evaluation.regimes[k] for k in chosen]


def coefficient_table(group: Group) -> Table | None:
    """The coefficients that a model adapts against their bounds; ``None`` if it adapts none."""
    found = group.first.coefficients
    if found is None:
        return None
    car = found.vehicle
    statistics = group.spreads(lambda score: _statistics(score).ravel())
    seeds = f", ± their standard deviation over {len(group.scores)} seeds" if len(group.scores) > 1 else ""
    return Table.of(
        range(len(COEFFICIENTS)),
        (Column("coefficient"), lambda k: COEFFICIENTS[k]),
        (Column("unit"), lambda k: coefficient_unit(COEFFICIENTS[k])),
        (Column("lower", "", "bounds"), lambda k: float(car.lower[k])),
        (Column("upper", "", "bounds"), lambda k: float(car.upper[k])),
        (
            [
                *(Column(name, "", "adapted") for name in ("mean", "std", "min", "max")),
                Column("on a bound", "% of rows"),
            ],
            lambda k: statistics[5 * k : 5 * k + 5],
        ),
        caption=f"Mean, standard deviation and range over the scored rows{seeds}.",
    )


def verdict(evaluation: Evaluation) -> str:
    """The result in a sentence: the best path over the horizon, then the best model of each channel one step ahead."""
    rmse, _ = _over_seeds(evaluation, lambda score: score.rmse)
    parts = []
    for k, channel in enumerate(STATE_SIGNALS):
        best, *_ = _ranked({name: float(values[k]) for name, values in rmse.items()}) or [""]
        if not best:
            continue
        reached, reference = float(rmse[best][k]), float(evaluation.persistence_rmse[k])
        value = f"{best} ({text(reached)} {evaluation_figures.UNITS[channel]}"
        if best != "persistence" and reference > 0:
            change = reached / reference - 1
            value += f", {percent(abs(change))} {'below' if change < 0 else 'above'} persistence"
        parts.append(f"{_TITLES[channel]} by {value})")
    if not parts:
        return "No model gave finite predictions."
    return f"{_best_path(evaluation)}Predicted best one step ahead: {'; '.join(parts)}."


def _ranked(errors: dict[str, float]) -> list[str]:
    """Models whose errors are finite, the best first."""
    return sorted((name for name, value in errors.items() if np.isfinite(value)), key=lambda name: errors[name])


def _best_path(evaluation: Evaluation) -> str:
    """A sentence on the displacement over the horizon; empty if no rollout is finite."""
    means, _ = _over_seeds(evaluation, lambda score: np.array(score.rollout.ade))
    ade = {name: float(mean) for name, mean in means.items()}
    best, *others = _ranked(ade) or [""]
    if not best:
        return ""
    after = f"; next {others[0]}, {text(ade[others[0]])} m" if others else ""
    return f"Best path over {evaluation.horizon_s:g} s: {best} (ADE {text(ade[best])} m{after}). "


def open_loop_report(evaluation: Evaluation) -> Report:
    """The report of ``evaluation``."""
    return Report(
        title=f"Open-loop evaluation on {evaluation.name}",
        summary=verdict(evaluation),
        sections=list(_sections(evaluation)),
        protocol=_protocol(evaluation),
        table=summary_table(evaluation),
        verdicts=data_verdicts(evaluation.recording.info.findings),
    )


def markdown(evaluation: Evaluation) -> str:
    """``results.md``: the same head and tables as the report."""
    wrong = [("Signals that cannot be right", each.line) for each in evaluation.recording.info.findings]
    head = "".join(f"- {name}: {value}\n" for name, value in (*wrong, *_protocol(evaluation).items()))
    title = f"# Open-loop evaluation on {evaluation.name}"
    tables: list[tuple[str, Table | None]] = [
        *((f"RMSE by {quantity}", regime_table(evaluation, key)) for key, quantity in QUANTITIES.items()),
        *((f"Coefficients of {name}", coefficient_table(group)) for name, group in evaluation.groups.items()),
        ("Stated uncertainty", coverage_table(evaluation)),
    ]
    parts = [f"## {heading}\n\n{table.markdown()}" for heading, table in tables if table is not None]
    return "\n".join([title, "", verdict(evaluation), "", head, summary_table(evaluation).markdown(), *parts])


def _prose(evaluation: Evaluation) -> Prose:
    bars, coasting = percent(evaluation_figures.MAX_BAR), percent(COASTING)
    return Prose("evaluation", evaluation=evaluation, cut=_CUT, max_bar=bars, coasting=coasting)


def _protocol(evaluation: Evaluation) -> dict[str, str]:
    recording = evaluation.recording
    sources, commands = ", ".join(recording.info.source), COMMANDS_IN_WORDS[recording.info.commands]
    lines = _prose(evaluation).protocol(
        sources=sources, rate=1 / recording.T_s, commands=commands, cores=os.cpu_count()
    )
    return lines | {f"Model {name}": _origin(group) for name, group in evaluation.groups.items()}


def _origin(group: Group) -> str:
    model = group.first.model
    if model.card is None:
        return model.origin
    notes = model.card.training | ({"seed": group.seeds} if group.seeds else {})
    training = ", ".join(f"{key} {_plain(value)}" for key, value in notes.items())
    return f"{model.origin}; training: {training}" if training else model.origin


def _plain(value: object) -> str:
    return " + ".join(map(str, value)) if isinstance(value, (list, tuple)) else str(value)


def _sections(evaluation: Evaluation) -> Iterator[Section]:
    groups, prose = evaluation.groups, _prose(evaluation)
    states = {name: group.first.state for name, group in groups.items()}
    recording, horizon = evaluation.recording, groups[_focus(evaluation)].first.rollout.time
    time = recording.elapsed[evaluation.rows + 1]
    rmse = _over_seeds(evaluation, lambda score: score.rmse)
    yield prose.section("relative", evaluation_figures.relative_errors(*rmse, evaluation.persistence_rmse))
    yield prose.section(
        "measured",
        evaluation_figures.predicted_and_measured(time, evaluation.measured, states),
        zoomed=_zoomed(evaluation, time, states),
    )
    yield prose.section("change", evaluation_figures.increments(evaluation.current, evaluation.measured, states))
    yield prose.section("rollouts", evaluation_figures.rollout_growth(horizon, *_over_seeds(evaluation, _growth)))
    yield prose.section("trajectories", _trajectories(evaluation))
    for quantity, title in QUANTITIES.items():
        yield prose.section(quantity, _regime_errors(evaluation, quantity, title), regime_table(evaluation, quantity))
    yield from _place_sections(evaluation, prose, states)
    for name, group in groups.items():
        found, theta = group.first.coefficients, group.first.theta
        if found is None or theta is None:
            continue
        one = f" (seed {group.first.seed})" if len(group.scores) > 1 else ""
        adapted = evaluation_figures.adapted_parameters(time[:: evaluation.every], theta, found.vehicle)
        yield prose.section("coefficients", adapted, coefficient_table(group), model=name, one=one)
        yield prose.section("ranges", evaluation_figures.parameter_usage(theta, found.vehicle), model=name, one=one)
    covered = coverage_table(evaluation)
    if covered is not None:
        yield prose.section("coverage", table=covered)
    latency = {name: group.first.latency_us for name, group in groups.items()}
    yield prose.section("latency", evaluation_figures.latency_histogram(latency))


def _zoomed(evaluation: Evaluation, time: Vector, states: dict[str, Vector]) -> str:
    """Predictions, measurements and inputs of the first rows that a page can hold."""
    first = slice(interactive.MOST_ROWS)
    inputs = {
        name: evaluation.recording[column][evaluation.rows[first]]
        for name, column in (("r", "r_fb"), ("δ (rad)", "delta_fb"))
    }
    shown = {name: values[first] for name, values in states.items()}
    return interactive.predicted_and_measured(time[first], evaluation.measured[first], shown, inputs)


def _trajectories(evaluation: Evaluation) -> Figure:
    """Rollouts one after the other over the liveliest stretch, each from the measured state."""
    recording, steps, starts = evaluation.recording, evaluation.steps, evaluation.drawn
    driven = slice(starts[0], starts[-1] + steps + 1)
    return track_figures.trajectories(
        recording.elapsed[driven],
        np.concatenate([np.zeros((1, 2)), path(recording.states(driven), recording.T_s)]),
        {
            name: branches(group.first.model, recording, starts, steps, group.first.known)
            for name, group in evaluation.groups.items()
        },
    )


def _regime_errors(evaluation: Evaluation, quantity: str, title: str) -> Figure:
    chosen, regimes = _regimes(evaluation, quantity)
    what = f"{title} ({regimes[0].unit})" if regimes[0].unit else title
    rmse = _over_seeds(evaluation, lambda score: score.regime_rmse[chosen])
    return evaluation_figures.regime_errors([regime.short for regime in regimes], what, *rmse)


def _place_sections(evaluation: Evaluation, prose: Prose, states: dict[str, Vector]) -> Iterator[Section]:
    """Errors over the position on the lap and on the map, as far as positions were recorded."""
    recording, line, at = evaluation.recording, evaluation.line, evaluation.rows + 1
    if not recording.has_pose:
        yield prose.section("no_positions")
        return
    errors = {name: values - evaluation.measured for name, values in states.items()}
    if line is None:
        yield prose.section("no_lap")
    else:
        scored = recording.select(at)
        place = track_position(line, scored)
        yield prose.section("lap", track_figures.errors_along_lap(place, scored["v_x"], errors, line.length))
    name, smooth = _focus(evaluation), max(1, round(0.5 / recording.T_s))
    where = track_figures.error_map(recording["x"][at], recording["y"][at], errors[name], smooth)
    yield prose.section("map", where, model=name)


def _over_seeds(
    evaluation: Evaluation, measure: Callable[[Score], Vector]
) -> tuple[dict[str, Vector], dict[str, Vector]]:
    """Mean of ``measure`` over the seeds of each model, and its standard deviation."""
    groups = evaluation.groups.items()
    return {name: group.mean(measure) for name, group in groups}, {name: group.std(measure) for name, group in groups}


def _statistics(score: Score) -> Vector:
    """Mean, standard deviation, least, largest value, and rows at a bound (%) of each coefficient, shape ``(17, 5)``."""
    found = score.coefficients
    if found is None:
        return np.full((len(COEFFICIENTS), 5), np.nan)
    return np.stack([found.mean, found.std, found.low, found.high, 100 * found.at_bound], axis=1)


def _percentages(shares: Vector | None) -> Vector:
    return np.full(len(STATE_SIGNALS), np.nan) if shares is None else 100 * shares


def _growth(score: Score) -> Vector:
    """RMSE of the states and mean displacement at each step of the rollouts, shape ``(n, 4)``."""
    return np.column_stack([score.rollout.rmse, score.rollout.displacement])


def _seeds_in_words(evaluation: Evaluation) -> str:
    several = {name: group.seeds for name, group in evaluation.groups.items() if len(group.scores) > 1}
    listed = "; ".join(
        f"{name}: n = {len(seeds)}, seeds {', '.join(map(str, seeds))}" for name, seeds in several.items()
    )
    return f" ± is the standard deviation over the seeds of a model ({listed})." if several else ""


def _focus(evaluation: Evaluation) -> str:
    """The first model that is not persistence: the one that the evaluation is about."""
    names = list(evaluation.groups)
    return next((name for name in names if name != "persistence"), names[0])
