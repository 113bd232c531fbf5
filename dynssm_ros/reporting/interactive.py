"""Figures that can be zoomed: Plotly's, with its library inside the page, so that nothing is loaded from elsewhere."""

from __future__ import annotations

import html
from collections.abc import Mapping

import numpy as np
import plotly.graph_objects as go
from plotly.io import to_html
from plotly.subplots import make_subplots

from dynssm_ros.arrays import Vector
from dynssm_ros.reporting.evaluation_figures import MEASURED, PALETTE, UNITS, cut_at_holes, model_colours
from dynssm_ros.signals.recording import PAUSE_S, without_pauses
from dynssm_ros.signals.signal_map import STATE_SIGNALS

MOST_ROWS = 30_000
"""Rows that are drawn: ten minutes at 50 Hz. More make pages slow to open."""
_INPUT_COLOURS = (PALETTE[6], PALETTE[7], PALETTE[8])
_TITLES = {"v_x": "v<sub>x</sub>", "v_y": "v<sub>y</sub>", "omega": "ω"}
_HINT = (
    "Drag to zoom, double-click to go back, click a name to hide it. "
    f"The first {MOST_ROWS:,} rows, with gaps cut to {PAUSE_S:g} s."
)
_HEIGHT = 720  # pixels


def predicted_and_measured(
    time: Vector, measured: Vector, predicted: Mapping[str, Vector], inputs: Mapping[str, Vector]
) -> str:
    """Values at the left and errors at the right over the whole time, zoomed together, above the inputs; as HTML.

    Args:
        time: of the rows (s), ``(N,)``; lines break where it jumps, and longer jumps than ``PAUSE_S`` are cut to that.
        measured: states, ``(N, 3)``.
        predicted: states by model, ``(N, 3)``.
        inputs: by name, ``(N,)``.
    """
    time = without_pauses(time)
    figure = make_subplots(rows=4, cols=2, shared_xaxes="all", vertical_spacing=0.03, horizontal_spacing=0.09)
    colours = {"measured": MEASURED} | model_colours(list(predicted))
    for name, states in {"measured": measured, **predicted}.items():
        for row, values in enumerate(states.T, 1):
            _draw(figure, time, values, colours[name], at=(row, 1), name=name, showlegend=row == 1)
            if name != "measured":
                _draw(figure, time, values - measured[:, row - 1], colours[name], at=(row, 2), name=name)
    for (name, values), colour in zip(inputs.items(), _INPUT_COLOURS, strict=False):
        for column in (1, 2):
            _draw(figure, time, values, colour, at=(4, column), name=name, showlegend=column == 1)
    for row, channel in enumerate(STATE_SIGNALS, 1):
        title = f"{_TITLES[channel]} ({UNITS[channel]})"
        figure.update_yaxes(title_text=title, row=row, col=1)
        figure.update_yaxes(title_text=title.replace(" (", " error ("), row=row, col=2)
    figure.update_yaxes(title_text=", ".join(inputs), row=4)
    figure.update_xaxes(title_text="time (s)", row=4)
    figure.update_layout(
        template="simple_white", height=_HEIGHT, margin={"l": 60, "r": 10, "t": 10, "b": 40}, hovermode="x unified",
        legend={"orientation": "h", "y": 1.02, "yanchor": "bottom"}, dragmode="zoom",
        font={"family": "system-ui, sans-serif"},
    )  # fmt: skip
    config = {"displaylogo": False, "responsive": True}
    drawn = str(to_html(figure, config=config, include_plotlyjs=True, full_html=False, div_id="zoomed"))
    return f'<p class="caption">{_HINT}</p>{drawn}'


def _draw(
    figure: go.Figure, time: Vector, values: Vector, colour: str, *, at: tuple[int, int], name: str,
    showlegend: bool = False,
) -> None:  # fmt: skip
    """A line in the panel ``at`` (row, column), with 24 bits of each value: enough to see, half of the page."""
    t, drawn = cut_at_holes(time, values)
    name = html.escape(name)  # it reads a few tags
    row, col = at
    figure.add_trace(
        go.Scattergl(
            x=t.astype(np.float32), y=drawn.astype(np.float32), mode="lines", name=name, legendgroup=name,
            showlegend=showlegend, line={"color": colour, "width": 2.4 if colour == MEASURED else 1.2}, connectgaps=False,
        ),
        row=row,
        col=col,
    )  # fmt: skip
