"""The page of an inspection: what is in a log, and its signals over time as the suggested signal map reads them."""

from __future__ import annotations

from matplotlib.figure import Figure

from dynssm_ros.reporting.evaluation_figures import MAX_POINTS, MEASURED, PALETTE, WIDTH, sheet, styled
from dynssm_ros.reporting.inspection_tables import finding_table, signal_table, topic_table
from dynssm_ros.reporting.page import Report, Section
from dynssm_ros.signals.inspection import Inspection

_PANELS = {
    "$v_x$ (m/s)": ("v_x",),
    "$v_y$ (m/s)": ("v_y",),
    r"$\omega$ (rad/s)": ("omega",),
    "throttle, brake": ("throttle_feedback", "throttle_command", "brake_feedback", "brake_command"),
    "speed set-point (m/s)": ("speed_feedback", "speed_command"),
    "steering": ("steering_feedback", "steering_command"),
}


def inspection_report(found: Inspection) -> Report:
    """The report of an inspection."""
    missing = f" Nothing was found for {', '.join(found.missing)}." if found.missing else ""
    told = "".join(f" {name}: {one.note}." for name, one in found.signals.items() if one.note)
    text = f"As written to signals.yaml. Names suggest it, so check each line.{missing}{told}"
    sections = [Section("Signal map", text, table=signal_table(found) if found.signals else None)]
    if found.findings:
        told = " ".join(f"{finding.line}." for finding in found.findings)
        sections.insert(0, Section("What cannot be right", told, table=finding_table(found.findings)))
    if any(name in found.signals for names in _PANELS.values() for name in names):
        text = "Signs are seen best here: in a bend to the left omega and the steering are positive."
        sections.append(Section("Signals", text, signals_over_time(found)))
    if "x" in found.signals and "y" in found.signals:
        sections.append(Section("Path", "Where the car was by its odometry; the dot is the start.", path(found)))
    notes = "".join(f" {note[0].upper()}{note[1:].rstrip('.?')}." for note in found.notes)
    summary = f"{found.duration:.1f} s with {len(found.topics)} {'topics' if found.time is None else 'columns'}.{notes}"
    return Report(f"Inspection of {found.name}", summary, sections, table=topic_table(found))


@styled
def signals_over_time(found: Inspection) -> Figure:
    """The suggested signals, one panel for each quantity that is there."""
    panels = {title: [one for one in names if one in found.signals] for title, names in _PANELS.items()}
    panels = {title: names for title, names in panels.items() if names}
    figure, axes = sheet(0.4 + 1.35 * len(panels), len(panels), sharex=True, squeeze=False)
    axes = axes[:, 0]
    for panel, (title, names) in zip(axes, panels.items(), strict=True):
        for k, name in enumerate(names):
            one = found.signals[name]
            step = max(1, len(one.topic.time) // MAX_POINTS)
            colour = MEASURED if k == 0 else PALETTE[k - 1]
            panel.plot(one.topic.time[::step], one.values[::step], color=colour, lw=0.9, label=name.replace("_", " "))
        panel.set_ylabel(title)
        if len(names) > 1:
            panel.legend(loc="upper right", ncols=len(names))
    axes[-1].set_xlabel("time since the log's first message (s)")
    axes[-1].set_xlim(0.0, found.duration)
    return figure


@styled
def path(found: Inspection) -> Figure:
    """The driven path."""
    x, y = found.signals["x"].values, found.signals["y"].values
    figure = Figure(figsize=(0.6 * WIDTH, 0.5 * WIDTH), layout="constrained")
    panel = figure.subplots()
    panel.plot(x, y, color=MEASURED, lw=0.9)
    panel.plot(x[:1], y[:1], "o", color=PALETTE[1])
    panel.set_aspect("equal", adjustable="datalim")
    panel.set_xlabel("x (m)")
    panel.set_ylabel("y (m)")
    return figure
