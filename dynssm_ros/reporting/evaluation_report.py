"""The tables and the report of an open-loop evaluation."""

from __future__ import annotations

import os
from collections.abc import Iterator

import numpy as np

from dynssm_ros.arrays import Vector
from dynssm_ros.evaluation.coefficients import coefficient_unit
from dynssm_ros.evaluation.open_loop import Evaluation
from dynssm_ros.evaluation.regimes import COASTING, QUANTITIES
from dynssm_ros.evaluation.rollout import branches
from dynssm_ros.evaluation.score import Group, Score
from dynssm_ros.reporting import evaluation_figures, track_figures
from dynssm_ros.reporting.page import Report, Section
from dynssm_ros.reporting.tables import Column, Table, Value, percent, text
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
_REGIMES_IN_WORDS = {
    "speed": "One-step error in bins of speed.",
    "lateral_acceleration": "One-step error in bins of lateral acceleration, taken as |v_x ω|: straights at the left, "
    "hard cornering at the right.",
    "throttle": f"One-step error by what the driver does: applied throttle below, within or above ±{percent(COASTING)}.",
}


def summary_table(evaluation: Evaluation) -> Table:
    """One row per model: displacement over the horizon, one-step errors, size and speed."""
    units = evaluation_figures.UNITS
    columns = (
        Column("model", brief=True),
        Column("ADE", "m", "path", "min", brief=True),
        Column("FDE", "m", "path", "min", brief=True),
        *(Column(_TITLES[c], units[c], "RMSE", "min", brief=True) for c in STATE_SIGNALS),
        *(Column(_TITLES[c], units[c], "largest error", "min") for c in STATE_SIGNALS),
        Column("parameters"),
        Column("FLOPs"),
        Column("p50", "µs", "latency", brief=True),
        Column("p99", "µs", "latency"),
    )
    rows: list[list[Value]] = [
        [
            name,
            *group.spreads(lambda score: [score.rollout.ade, score.rollout.fde]),
            *group.spreads(lambda score: score.rmse),
            *group.spreads(lambda score: score.max_error),
            group.first.model.parameters,
            group.first.model.flops,
            *group.spreads(lambda score: [score.latency_p50, score.latency_p99]),
        ]
        for name, group in evaluation.groups.items()
    ]
    return Table(
        columns,
        rows,
        f"{len(evaluation.rows):,} one-step predictions and {evaluation.starts:,} rollouts over "
        f"{evaluation.horizon_s:g} s, the same rows for every model.{_seeds_in_words(evaluation)}",
    )


def coverage_table(evaluation: Evaluation) -> Table | None:
    """How often the error lies inside the models' own 90 % interval; ``None`` if no model states one."""
    columns = (Column("model"), *(Column(_TITLES[c], "%", "inside the 90 % interval") for c in STATE_SIGNALS))
    rows: list[list[Value]] = [
        [name, *group.spreads(lambda score: _percentages(score.coverage_90))]
        for name, group in evaluation.groups.items()
        if group.first.coverage_90 is not None
    ]
    return Table(columns, rows, _seeds_in_words(evaluation).strip()) if rows else None


def regime_table(evaluation: Evaluation, quantity: str) -> Table:
    """One-step RMSE of every model in the regimes of one quantity, columns grouped by channel."""
    chosen = [k for k, regime in enumerate(evaluation.regimes) if regime.quantity == quantity]
    regimes = [evaluation.regimes[k] for k in chosen]
    columns = (
        Column("model"),
        *(
            Column(regime.short, regime.unit, f"{_TITLES[channel]} RMSE ({evaluation_figures.UNITS[channel]})", "min")
            for channel in STATE_SIGNALS
            for regime in regimes
        ),
    )
    rows: list[list[Value]] = [
        [name, *group.spreads(lambda score: score.regime_rmse[chosen].T.ravel())]
        for name, group in evaluation.groups.items()
    ]
    counts = "; ".join(f"{regime.name}: {regime.rows:,}" for regime in regimes)
    return Table(columns, rows, f"Rows: {counts}.{_seeds_in_words(evaluation)}")


def coefficient_table(group: Group) -> Table | None:
    """The coefficients that a model adapts against their bounds; ``None`` if it adapts none."""
    found = group.first.coefficients
    if found is None:
        return None
    columns = (
        Column("coefficient"),
        Column("unit"),
        Column("lower", "", "bounds"),
        Column("upper", "", "bounds"),
        Column("mean", "", "adapted"),
        Column("std", "", "adapted"),
        Column("min", "", "adapted"),
        Column("max", "", "adapted"),
        Column("on a bound", "% of rows"),
    )
    statistics = group.spreads(lambda score: _statistics(score).ravel())
    width = len(statistics) // len(COEFFICIENTS)
    rows: list[list[Value]] = [
        [name, coefficient_unit(name), lower, upper, *statistics[k * width : (k + 1) * width]]
        for k, (name, lower, upper) in enumerate(
            zip(COEFFICIENTS, found.vehicle.lower.tolist(), found.vehicle.upper.tolist(), strict=True)
        )
    ]
    seeds = f", ± their standard deviation over {len(group.scores)} seeds" if len(group.scores) > 1 else ""
    return Table(columns, rows, f"Mean, standard deviation and range over the scored rows{seeds}.")


def verdict(evaluation: Evaluation) -> str:
    """The result in a sentence: the best path over the horizon, then the best model of each channel one step ahead."""
    rmse = {name: group.mean(lambda score: score.rmse) for name, group in evaluation.groups.items()}
    parts = []
    for k, channel in enumerate(STATE_SIGNALS):
        reached = {name: float(values[k]) for name, values in rmse.items() if np.isfinite(values[k])}
        if not reached:
            continue
        best = min(reached, key=lambda name: reached[name])
        value = f"{best} ({text(reached[best])} {evaluation_figures.UNITS[channel]}"
        reference = float(evaluation.persistence_rmse[k])
        if best != "persistence" and reference > 0:
            change = reached[best] / reference - 1
            value += f", {percent(abs(change))} {'below' if change < 0 else 'above'} persistence"
        parts.append(f"{_TITLES[channel]} by {value})")
    if not parts:
        return "No model gave finite predictions."
    return f"{_best_path(evaluation)}Predicted best one step ahead: {'; '.join(parts)}."


def _best_path(evaluation: Evaluation) -> str:
    """A sentence on the displacement over the horizon; empty if no rollout is finite."""
    ade = {
        name: float(group.mean(lambda score: np.array(score.rollout.ade))) for name, group in evaluation.groups.items()
    }
    ade = {name: value for name, value in ade.items() if np.isfinite(value)}
    if not ade:
        return ""
    best = min(ade, key=lambda name: ade[name])
    words = f"Best path over {evaluation.horizon_s:g} s: {best} (ADE {text(ade[best])} m"
    others = {name: value for name, value in ade.items() if name != best}
    if others:
        next_best = min(others, key=lambda name: others[name])
        words += f"; next {next_best}, {text(others[next_best])} m"
    return words + "). "


def open_loop_report(evaluation: Evaluation) -> Report:
    """The report of ``evaluation``."""
    return Report(
        title=f"Open-loop evaluation on {evaluation.name}",
        summary=verdict(evaluation),
        sections=list(_sections(evaluation)),
        protocol=_protocol(evaluation),
        table=summary_table(evaluation),
    )


def markdown(evaluation: Evaluation) -> str:
    """``results.md``: the same head and tables as the report."""
    head = "".join(f"- {name}: {value}\n" for name, value in _protocol(evaluation).items())
    title = f"# Open-loop evaluation on {evaluation.name}"
    tables: list[tuple[str, Table | None]] = [
        *((f"RMSE by {quantity}", regime_table(evaluation, key)) for key, quantity in QUANTITIES.items()),
        *((f"Coefficients of {name}", coefficient_table(group)) for name, group in evaluation.groups.items()),
        ("Stated uncertainty", coverage_table(evaluation)),
    ]
    parts = [f"## {heading}\n\n{table.markdown()}" for heading, table in tables if table is not None]
    return "\n".join([title, "", verdict(evaluation), "", head, summary_table(evaluation).markdown(), *parts])


def _protocol(evaluation: Evaluation) -> dict[str, str]:
    recording = evaluation.recording
    commands = recording.info.commands
    lines = {
        "Recording": f"{evaluation.name} ({', '.join(recording.info.source)}), {recording.duration:.1f} s scored at "
        f"{1 / recording.T_s:g} Hz",
        "Split": evaluation.split,
        "Rows": f"all windows without a gap and with v_x at or above {evaluation.min_speed:g} m/s",
        "Commands": COMMANDS_IN_WORDS[commands],
        "Rollouts": f"{evaluation.horizon_s:g} s; predicted states are fed back, measured actuator feedback and "
        "commands are supplied",
        "Displacement": "predicted and measured path, both integrated from velocities (mean velocity of each step at "
        "its middle heading) from the same pose",
        "FLOPs": "per prediction; of trained models the matrix products as torch counts them, of the single-track model "
        "every operation as numpy executes it",
        "Latency": f"one window per call, one core of {os.cpu_count()}",
    }
    for name, group in evaluation.groups.items():
        lines[f"Model {name}"] = _origin(group)
    return lines


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
    groups = evaluation.groups
    states = {name: group.first.state for name, group in groups.items()}
    time = _seconds(evaluation)
    yield Section(
        "Error relative to persistence",
        "Persistence predicts that nothing changes. A bar that passes the dashed line is worse than no model at all; "
        f"bars are cut at {percent(evaluation_figures.MAX_BAR)}, the number is always the true one. Whiskers are the spread "
        "over seeds, where there are several.",
        evaluation_figures.relative_errors(
            {name: group.mean(lambda score: score.rmse) for name, group in groups.items()},
            {name: group.std(lambda score: score.rmse) for name, group in groups.items()},
            evaluation.persistence_rmse,
        ),
    )
    yield Section(
        "Predicted and measured",
        "The liveliest seconds of the recording. One step ahead good models lie on the measured curve at the left; "
        "where they differ is at the right. A slow wave there is physics that the model lacks, an offset is a bias.",
        evaluation_figures.predicted_and_measured(time, evaluation.measured, states),
    )
    yield Section(
        "Predicted and measured change",
        "Each dot is one step. On the diagonal the change was predicted exactly; on the dashed level line it was not "
        "predicted at all, as persistence does. A flatter cloud means a model that is rightly or wrongly cautious. "
        "Explained is the share of the mean square change that the prediction takes away.",
        evaluation_figures.increments(evaluation.current, evaluation.measured, states),
    )
    yield Section(
        "Rollouts",
        f"Errors when the model runs on its own predictions for {evaluation.horizon_s:g} s. Growth in a "
        "straight line is an acceleration that stays wrong; a curve that flattens is an error that heals itself. Bands "
        f"are the spread over seeds, where there are several. {_CUT}",
        evaluation_figures.rollout_growth(
            groups[_focus(evaluation)].first.rollout.time,
            {name: group.mean(_growth) for name, group in groups.items()},
            {name: group.std(_growth) for name, group in groups.items()},
        ),
    )
    yield _trajectory_section(evaluation)
    for quantity, title in QUANTITIES.items():
        yield _regime_section(evaluation, quantity, title)
    yield from _place_sections(evaluation, states)
    for name, group in groups.items():
        yield from _parameter_sections(name, group, time[:: evaluation.every])
    covered = coverage_table(evaluation)
    if covered is not None:
        yield Section(
            "Stated uncertainty",
            "Share of one-step errors inside the interval that the model claims to hold 90 % of them, 1.645 of its "
            "stated standard deviations to either side. Well below 90: overconfident here; well above: too cautious.",
            table=covered,
        )
    yield Section(
        "Latency",
        "Wall-clock time of single predictions on this machine; solid lines are medians, dotted ones 99th percentiles.",
        evaluation_figures.latency_histogram({name: group.first.latency_us for name, group in groups.items()}),
    )


def _trajectory_section(evaluation: Evaluation) -> Section:
    """Rollouts one after the other over the liveliest stretch, each from the measured state."""
    recording, steps, starts = evaluation.recording, evaluation.steps, evaluation.drawn
    driven = slice(starts[0], starts[-1] + steps + 1)
    return Section(
        "Trajectories",
        f"The path driven in the liveliest seconds and what the models predicted of it: every {evaluation.horizon_s:g} s "
        "a rollout leaves the measured path (dots) and runs on its own. The plan shows the shape, enlarged; the curves "
        f"at the right are true to scale. {_CUT}",
        track_figures.trajectories(
            (recording.time[driven] - recording.time[0]) / 1e9,
            np.concatenate([np.zeros((1, 2)), path(recording.states(driven), recording.T_s)]),
            {
                name: branches(group.first.model, recording, starts, steps, group.first.known)
                for name, group in evaluation.groups.items()
            },
        ),
    )


def _regime_section(evaluation: Evaluation, quantity: str, title: str) -> Section:
    chosen = [k for k, regime in enumerate(evaluation.regimes) if regime.quantity == quantity]
    regimes = [evaluation.regimes[k] for k in chosen]
    return Section(
        f"Errors by {title}",
        f"{_REGIMES_IN_WORDS[quantity]} Whiskers are the spread over seeds, where there are several. {_CUT}",
        evaluation_figures.regime_errors(
            [regime.short for regime in regimes],
            f"{title} ({regimes[0].unit})" if regimes[0].unit else title,
            {name: group.mean(lambda score: score.regime_rmse[chosen]) for name, group in evaluation.groups.items()},
            {name: group.std(lambda score: score.regime_rmse[chosen]) for name, group in evaluation.groups.items()},
        ),
        regime_table(evaluation, quantity),
    )


def _place_sections(evaluation: Evaluation, states: dict[str, Vector]) -> Iterator[Section]:
    """Errors over the position on the lap and on the map, as far as positions were recorded."""
    recording, line, at = evaluation.recording, evaluation.line, evaluation.rows + 1
    title = "Errors over the position on the lap"
    if not recording.has_pose:
        yield Section(title, "Not shown: the recording holds no positions (x, y).")
        return
    if line is None:
        yield Section(title, "Not shown: the car completes no lap in the recording, and no track was given.")
    else:
        scored = recording.select(at)
        yield Section(
            title,
            "One-step error (root mean square) along the lap, under the speed driven there. Peaks that all models share "
            "are places where the car is hard to predict; peaks of one model are its own. Lines end where no row was "
            f"scored. {_CUT}",
            track_figures.errors_along_lap(
                track_position(line, scored),
                scored["v_x"],
                {name: values - evaluation.measured for name, values in states.items()},
                line.length,
            ),
        )
    name = _focus(evaluation)
    yield Section(
        f"Where {name} errs",
        "One-step error (root mean square over half a second) at each place of the track. Errors that stay at a "
        "place from lap to lap come from the track (bank, grade, grip); errors that follow braking or steering "
        "come from the car.",
        track_figures.error_map(
            recording["x"][at],
            recording["y"][at],
            states[name] - evaluation.measured,
            smooth=max(1, round(0.5 / recording.T_s)),
        ),
    )


def _parameter_sections(name: str, group: Group, time: Vector) -> Iterator[Section]:
    found, theta = group.first.coefficients, group.first.theta
    if found is None or theta is None:
        return
    one = f" (seed {group.first.seed})" if len(group.scores) > 1 else ""
    yield Section(
        f"Adapted coefficients of {name}",
        f"Coefficients along the recording{one}. The shaded edges are outside the bounds, the dashed line is the "
        "nominal value. Flat: not needed, or not identifiable here; at an edge: the bounds are in the way.",
        evaluation_figures.adapted_parameters(time, theta, found.vehicle),
        coefficient_table(group),
    )
    yield Section(
        f"Use of the ranges by {name}",
        f"Each coefficient{one} between its bounds (0 % and 100 %); the white tick is the median. One that rests on a "
        "bound tells of bounds that are too tight, or of physics that the single-track model lacks.",
        evaluation_figures.parameter_usage(theta, found.vehicle),
    )


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


def _seconds(evaluation: Evaluation) -> Vector:
    """Time of the predicted rows since the start of the recording (s)."""
    recording = evaluation.recording
    seconds: Vector = (recording.time[evaluation.rows + 1] - recording.time[0]) / 1e9
    return seconds
