"""One self-contained HTML file: a head that says what was done how, a table, sections with a figure each.

Figures are inlined, nothing is loaded from elsewhere, so the file can be mailed and archived. Used by every command
that ends with a report.
"""

from __future__ import annotations

import base64
import html
import io
import platform
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime, timezone
from importlib.resources import files
from pathlib import Path
from typing import Literal

import matplotlib as mpl
import yaml
from jinja2 import Environment, StrictUndefined
from matplotlib.figure import Figure

from dynssm_ros import __version__
from dynssm_ros.files import replacing
from dynssm_ros.reporting.tables import Table
from dynssm_ros.signals.findings import Finding

State = Literal["ok", "look", "wrong"]
RASTER_DPI = 160  # of the rasterised parts of a figure
_FIGURE = re.compile(r'<h2>([^<]*)</h2>\s*<p>([^<]*)</p>\s*<img[^>]* alt="[^"]*" src="(data:[^"]*)">')


@dataclass(frozen=True)
class Section:
    """A part of a report: one or two sentences on how to read the figure below them, or the table below that.

    On a screen the ``zoomed`` figure stands for the ``figure``, which is printed.
    """

    title: str
    text: str
    figure: Figure | str | None = None  # or its ``data:`` address
    table: Table | None = None
    zoomed: str = ""  # HTML of reporting/interactive.py


@dataclass(frozen=True)
class Verdict:
    """A line that a report begins with: what was judged, how it is, why, and the page with more about it."""

    name: str
    state: State
    text: str
    link: str = ""


def data_verdicts(findings: Sequence[Finding]) -> tuple[Verdict, ...]:
    """A line on the signals that contradict each other; none if none do."""
    return (Verdict("data", "wrong", "; ".join(finding.line for finding in findings)),) if findings else ()


@dataclass(frozen=True)
class Report:
    """A report as data: the result in a sentence or two, the main figures below, and the sections in order of reading.

    The ``protocol`` says by name how it was obtained (recording, commands, split, integrator, seeds ...).
    """

    title: str
    summary: str
    sections: Sequence[Section]
    protocol: Mapping[str, str] = field(default_factory=dict)
    table: Table | None = None
    verdicts: Sequence[Verdict] = ()

    def html(self) -> str:
        """The report as HTML text."""
        environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
        environment.filters["svg_uri"] = svg_uri
        made = f"{datetime.now(timezone.utc):%Y-%m-%d %H:%M} UTC"
        protocol = dict(self.protocol) | {
            "Made": f"{made} by dynssm_ros {__version__}, Python {platform.python_version()}, {platform.machine()}"
        }
        return environment.from_string(_template("report.html.j2")).render(report=self, protocol=protocol)

    def save(self, path: str | Path) -> None:
        """Writes the HTML file, atomically."""
        text = self.html()
        with replacing(path) as aside:
            aside.write_text(text, encoding="utf-8")


class Prose:
    """Titles and texts of a page's sections and protocol, from ``templates/PAGE.yaml``; values fill the ``{names}``."""

    def __init__(self, page: str, **values: object) -> None:
        self.words = yaml.safe_load(_template(f"{page}.yaml"))
        self._values = values

    def section(
        self, name: str, figure: Figure | None = None, table: Table | None = None, zoomed: str = "", **more: object
    ) -> Section:
        """The section of a name, its texts filled with ``more`` values too."""
        title, text = (words.format(**self._values, **more) for words in self.words[name])
        return Section(title, text, figure, table, zoomed)

    def protocol(self, **more: object) -> dict[str, str]:
        """How what is reported was obtained, by name."""
        return {name: words.format(**self._values, **more) for name, words in self.words["protocol"].items()}


def _template(name: str) -> str:
    return files(__package__).joinpath("templates", name).read_text(encoding="utf-8")


def figures_of(page: Path) -> list[Section]:
    """The sections with a figure of a report that was saved."""
    found = _FIGURE.findall(page.read_text(encoding="utf-8"))
    return [Section(html.unescape(title), html.unescape(text), figure) for title, text, figure in found]


def svg_uri(figure: Figure | str) -> str:
    """The figure as a ``data:`` address of an SVG image; the same figure gives the same text."""
    if isinstance(figure, str):
        return figure
    buffer = io.BytesIO()
    with mpl.rc_context({"svg.hashsalt": "dynssm"}):
        bare = dict.fromkeys(("Date", "Creator", "Format", "Type"))
        figure.savefig(buffer, format="svg", dpi=RASTER_DPI, metadata=bare)
    return "data:image/svg+xml;base64," + base64.b64encode(buffer.getvalue()).decode("ascii")
