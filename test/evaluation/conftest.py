"""Drawing figures in tests."""

from __future__ import annotations

import io
from collections.abc import Callable

import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure


@pytest.fixture
def drawn() -> Callable[[Figure], list[Axes]]:
    """Draws a figure and returns its visible axes."""

    def draw(figure: Figure) -> list[Axes]:
        sink = io.BytesIO()
        figure.savefig(sink, format="png", dpi=40)
        assert len(sink.getvalue()) > 1000
        return [axes for axes in figure.axes if axes.axison]

    return draw
