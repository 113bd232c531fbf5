"""Pages of results: jinja2 templates (``benchmarks/templates``) filled with numbers, tables and figures."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from matplotlib.figure import Figure

from dynssm_ros.files import replacing

_DPI = 130  # of figures
_TEMPLATES = Environment(
    loader=FileSystemLoader(Path(__file__).with_name("templates")), undefined=StrictUndefined, trim_blocks=True,
    lstrip_blocks=True, autoescape=False,  # noqa: S701 - Markdown of our own numbers
)  # fmt: skip


def render(page: str, **values: Any) -> str:
    """The page ``benchmarks/templates/PAGE.md`` as Markdown, filled with ``values``; one blank line at most in a row."""
    text = _TEMPLATES.get_template(f"{page}.md").render(**values)
    return re.sub(r"\n{3,}", "\n\n", text).strip() + "\n"


def table(headings: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Cells of words as a Markdown table."""
    lines = [headings, ["---"] * len(headings), *rows]
    return "\n".join(re.sub("  +", " ", f"| {' | '.join(line)} |") for line in lines)


def command(group: str, arguments: Sequence[str]) -> str:
    """By which a page of a group of ``benchmarks/dodo.py`` is made."""
    return " ".join(["python -m doit -n 2 -f benchmarks/dodo.py", f"group={group}", *arguments])


def several(names: Iterable[str]) -> str:
    """Names as code, apart by commas."""
    return ", ".join(f"`{name}`" for name in names)


_TEMPLATES.globals |= {"table": table, "command": command}
_TEMPLATES.filters |= {"several": several}


def save_figure(figure: Figure, path: Path, *, tight: bool = False) -> str:
    """Writes a figure of a page aside as PNG and renames it; equal figures are equal files. Returns the file's name.

    A ``tight`` picture ends where the outermost labels do.
    """
    with replacing(path) as aside:
        figure.savefig(
            aside, format="png", dpi=_DPI, metadata={"Software": None}, bbox_inches="tight" if tight else None
        )
    return path.name


def save_page(text: str, path: Path) -> None:
    """Writes a page aside, renames it, and prints it."""
    with replacing(path) as aside:
        aside.write_text(text, encoding="utf-8")
    print(text)
