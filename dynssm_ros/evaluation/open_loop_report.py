"""The tables and the report of an open-loop evaluation."""

from __future__ import annotations

import os
from collections.abc import Iterator

import numpy as np

from dynssm_ros.evaluation import figures
from dynssm_ros.evaluation.metrics import CHANNELS, Vector
from dynssm_ros.evaluation.open_loop import Evaluation, Score
from dynssm_ros.evaluation.report import Report, Section
from dynssm_ros.evaluation.tables import Column, Table, Value, percent, text
from dynssm_ros.runtime.models import OnnxModel, SingleTrack, WindowModel
from dynssm_ros.vehicle import Vehicle

COMMANDS_IN_WORDS = {
    "topics": "topics: the recorded command topics, as increments on the feedback",
    "lookahead": "lookahead: the next feedback sample serves as command, as in the published data sets. It looks into "
    "the future and does not exist live",
    "none": "none: command inputs are zero",
}
_TITLES = {"v_x": "v_x", "v_y": "v_y", "omega": "ω"}


def summary_table(evaluation: Evaluation) -> Table:
    """One row per model: one-step errors, displacement over the horizon, size and speed."""
    units = figures.UNITS
    columns = (
        Column("model", brief=True),
        *(Column(_TITLES[c], units[c], "RMSE", "min", brief=True) for c in CHANNELS),
        *(Column(_TITLES[c], units[c], "largest error", "min") for c in CHANNELS),
        Column("ADE", "m", "path", "min", brief=True),
        Column("FDE", "m", "path", "min", brief=True),
        Column("parameters"),
        Column("FLOPs"),
        Column("p50", "µs", "latency", brief=True),
        Column("p99", "µs", "latency"),
    )
    rows: list[list[Value]] = []
    for name, score in evaluation.scores.items():
        p50, p99 = (float(v) for v in np.percentile(score.latency_us, [50, 99]))
        size = [score.model.parameters, score.model.flops]
        errors = [*map(float, score.rmse), *map(float, score.max_error), score.rollout.ade, score.rollout.fde]
        rows.append([name, *errors, *size, p50, p99])
    return Table(
        columns,
        rows,
        f"{len(evaluation.rows):,} one-step predictions and {evaluation.starts:,} rollouts over "
        f"{evaluation.horizon_s:g} s, the same rows for every model.",
    )


def coverage_table(evaluation: Evaluation) -> Table | None:
    """How often the error lies inside the models' own 90 % interval; ``None`` if no model states one."""
    columns = (Column("model"), *(Column(_TITLES[c], "%", "inside the 90 % interval") for c in CHANNELS))
    rows: list[list[Value]] = [
        [name, *(round(100 * float(share), 1) for share in score.coverage_90)]
        for name, score in evaluation.scores.items()
        if score.coverage_90 is not None
    ]
    return Table(columns, rows) if rows else None


def verdict(evaluation: Evaluation) -> str:
    """The result in a sentence: the best model of each channel, against persistence."""
    parts = []
    for k, channel in enumerate(CHANNELS):
        reached = {n: float(s.rmse[k]) for n, s in evaluation.scores.items() if np.isfinite(s.rmse[k])}
        if not reached:
            continue
        best = min(reached, key=lambda name: reached[name])
        value = f"{best} ({text(reached[best])} {figures.UNITS[channel]}"
        reference = float(evaluation.persistence_rmse[k])
        if best != "persistence" and reference > 0:
            change = reached[best] / reference - 1
            value += f", {percent(abs(change))} {'below' if change < 0 else 'above'} persistence"
        parts.append(f"{_TITLES[channel]} by {value})")
    return f"Predicted best one step ahead: {'; '.join(parts)}." if parts else "No model gave finite predictions."


def open_loop_report(evaluation: Evaluation, vehicle: Vehicle | None = None) -> Report:
    """The report of ``evaluation``.

    Args:
        evaluation: what was measured.
        vehicle: its bounds are shown with adapted coefficients of models that carry no vehicle of their own.
    """
    return Report(
        title=f"Open-loop evaluation on {evaluation.name}",
        summary=verdict(evaluation),
        sections=list(_sections(evaluation, vehicle)),
        protocol=_protocol(evaluation),
        table=summary_table(evaluation),
    )


def markdown(evaluation: Evaluation) -> str:
    """``results.md``: the same head and table as the report."""
    head = "".join(f"- {name}: {value}\n" for name, value in _protocol(evaluation).items())
    title = f"# Open-loop evaluation on {evaluation.name}"
    return f"{title}\n\n{verdict(evaluation)}\n\n{head}\n{summary_table(evaluation).markdown()}"


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
        "Latency": f"one window per call, one core of {os.cpu_count()}",
    }
    for name, score in evaluation.scores.items():
        lines[f"Model {name}"] = _origin(score.model)
    return lines


def _origin(model: WindowModel) -> str:
    if isinstance(model, OnnxModel):
        card = model.artifact.card
        training = ", ".join(f"{key} {_plain(value)}" for key, value in card.training.items())
        trained = f"; training: {training}" if training else ""
        steps = f"{card.substeps} step{'s' if card.substeps > 1 else ''}"
        physics = f", integrator {card.integrator} with {steps}" if card.architecture.get("physics") else ""
        return (
            f"{card.kind}, window {card.window} rows, trained with commands '{card.commands}', vehicle "
            f"{card.vehicle.name}{physics}{trained}"
        )
    if isinstance(model, SingleTrack):
        return f"nominal single-track model of vehicle {model.vehicle.name}, no learning"
    if model.name == "persistence":
        return "the next state is the present one"
    return f"window {model.H} rows"


def _plain(value: object) -> str:
    return " + ".join(map(str, value)) if isinstance(value, (list, tuple)) else str(value)


def _sections(evaluation: Evaluation, vehicle: Vehicle | None) -> Iterator[Section]:
    scores = evaluation.scores
    states = {name: score.state for name, score in scores.items()}
    time = _seconds(evaluation)
    yield Section(
        "Error relative to persistence",
        "Persistence predicts that nothing changes. A bar that passes the dashed line is worse than no model at all; "
        f"bars are cut at {percent(figures.MAX_BAR)}, the number is always the true one.",
        figures.relative_errors({n: s.rmse for n, s in scores.items()}, evaluation.persistence_rmse),
    )
    yield Section(
        "Predicted and measured",
        "The liveliest seconds of the recording. One step ahead good models lie on the measured curve at the left; "
        "where they differ is at the right. A slow wave there is physics that the model lacks, an offset is a bias.",
        figures.predicted_and_measured(time, evaluation.measured, states),
    )
    yield Section(
        "Predicted and measured change",
        "Each dot is one step. On the diagonal the change was predicted exactly; on the dashed level line it was not "
        "predicted at all, as persistence does. A flatter cloud means a model that is rightly or wrongly cautious.",
        figures.increments(evaluation.current, evaluation.measured, states),
    )
    yield Section(
        "Rollouts",
        f"Errors when the model runs on its own predictions for {evaluation.horizon_s:g} s. Growth in a "
        "straight line is an acceleration that stays wrong; a curve that flattens is an error that heals itself.",
        figures.rollout_growth({name: score.rollout for name, score in scores.items()}),
    )
    if evaluation.recording.has_pose:
        name = _focus(evaluation)
        at = evaluation.rows + 1
        yield Section(
            f"Where {name} errs",
            "One-step error (root mean square over half a second) at each place of the track. Errors that stay at a "
            "place from lap to lap come from the track (bank, grade, grip); errors that follow braking or steering "
            "come from the car.",
            figures.error_map(
                evaluation.recording["x"][at],
                evaluation.recording["y"][at],
                states[name] - evaluation.measured,
                smooth=max(1, round(0.5 / evaluation.recording.T_s)),
            ),
        )
    for name, score in scores.items():
        yield from _parameter_sections(name, score, time, vehicle)
    covered = coverage_table(evaluation)
    if covered is not None:
        yield Section(
            "Stated uncertainty",
            "Share of one-step errors inside the interval that the model claims to hold 90 % of them. Well below 90: "
            "overconfident here; well above: too cautious.",
            table=covered,
        )
    yield Section(
        "Latency",
        "Wall-clock time of single predictions on this machine; solid lines are medians, dotted ones 99th percentiles.",
        figures.latency_histogram({name: score.latency_us for name, score in scores.items()}),
    )


def _parameter_sections(name: str, score: Score, time: Vector, vehicle: Vehicle | None) -> Iterator[Section]:
    if score.theta is None or not score.adapts:
        return
    car = score.model.artifact.card.vehicle if isinstance(score.model, OnnxModel) else vehicle
    yield Section(
        f"Adapted parameters of {name}",
        "Coefficients along the recording. The shaded edges are outside the admissible range, the dashed line is the "
        "nominal value. Flat: not needed, or not identifiable here; at an edge: the bounds are in the way.",
        figures.adapted_parameters(time, score.theta, car),
    )
    if car is not None:
        yield Section(
            f"Use of the ranges by {name}",
            "Each coefficient between its bounds (0 % and 100 %); the white tick is the median. One that rests on a "
            "bound tells of bounds that are too tight, or of physics that the single-track model lacks.",
            figures.parameter_usage(score.theta, car),
        )


def _focus(evaluation: Evaluation) -> str:
    """The first model that is not persistence: the one that the evaluation is about."""
    names = list(evaluation.scores)
    return next((name for name in names if name != "persistence"), names[0])


def _seconds(evaluation: Evaluation) -> Vector:
    """Time of the predicted rows since the start of the recording (s)."""
    recording = evaluation.recording
    seconds: Vector = (recording.time[evaluation.rows + 1] - recording.time[0]) / 1e9
    return seconds
