"""One table, three formats."""

from __future__ import annotations

from io import StringIO

import numpy as np
import pytest
from rich.console import Console

from dynssm_ros.evaluation.spread import SeedSpread, spreads
from dynssm_ros.reporting.tables import Column, Table, percent, text


@pytest.fixture
def table():
    columns = (
        Column("model", brief=True),
        Column("v_x", "m/s", "RMSE", "min", brief=True),
        Column("v_y", "m/s", "RMSE", "min"),
        Column("share", "", "", "max", brief=True),
        Column("size", brief=True),
    )
    rows = [["a|b", 0.02, 0.5, 0.1, 1234], ["[red]", 0.01, float("nan"), 0.9, 0], ["c", None, float("inf"), 0.9, 7]]
    return Table(columns, rows, "Three models.")


def marked(table):
    return {(k, j) for k, row in enumerate(table.cells) for j, cell in enumerate(row) if cell.best}


def test_the_best_value_of_a_column_is_marked_and_ties_share_the_mark(table):
    assert marked(table) == {(1, 1), (1, 3), (2, 3)}


def test_nothing_is_best_without_a_rival(table):
    assert marked(Table(table.columns, table.rows[:1])) == set()


@pytest.mark.parametrize(
    ("value", "shown"),
    [
        (None, "–"), (float("nan"), "–"), (float("-inf"), "–"), ("x", "x"), (85193, "85,193"), (0, "0"),
        (0.0209, "0.0209"),
        (0.02, "0.0200"), (999.7, "1,000"), (SeedSpread(0.02, 0.3, 2), "0.0200"),
        (1e-7, "1.00e-07"), (150.0, "150"), (12345.6, "12,346"), (np.float64(0.5), "0.500"),
    ],
)  # fmt: skip
def test_values_show_with_three_digits_and_a_dash_for_what_is_not_a_number(value, shown):
    assert text(value) == shown


@pytest.mark.parametrize(
    ("value", "shown"),
    [
        (SeedSpread(0.02891, 0.00042, 3), "0.0289 ± 0.0004"), (SeedSpread(0.02, 7e-6, 2), "0.0200 ± 0.0000"),
        (SeedSpread(4374.0, 110.2, 2), "4,374 ± 110"), (SeedSpread(12.0, 1.25, 2), "12.0 ± 1.2"),
        (SeedSpread(1.2e-7, 3.4e-8, 2), "1.20e-07 ± 3.4e-08"), (SeedSpread(0.02, 0.0, 1), "0.0200"),
        (SeedSpread(float("nan"), float("nan"), 2), "–"),
    ],
)  # fmt: skip
def test_a_spread_over_seeds_has_the_decimals_of_its_mean(value, shown):
    ((cell,),) = Table((Column("a"),), [[value]]).cells
    assert cell.text == shown


def test_values_that_look_alike_share_the_mark():
    columns = (Column("model"), Column("v_x", best="min"))
    table = Table(columns, [["a", 1.0 / 3.0], ["b", SeedSpread(1.0 / 3.0 + 1e-15, 1e-16, 3)], ["c", 0.334]])
    assert marked(table) == {(0, 1), (1, 1)}


def test_spreads_are_compared_by_their_means():
    columns = (Column("model"), Column("v_x", best="min"))
    table = Table(columns, [["a", SeedSpread(0.02, 0.5, 2)], ["b", SeedSpread(0.03, 0.0, 1)], ["c", 0.025]])
    assert marked(table) == {(0, 1)}
    assert "| a | **0.0200 ± 0.5000** |" in table.markdown()


def test_spreads_of_several_runs_are_mean_and_sample_standard_deviation():
    one, two = spreads([np.array([1.0, 5.0]), np.array([3.0, 5.0])])
    assert (one.mean, one.n) == (2.0, 2)
    assert one.std == pytest.approx(np.sqrt(2))
    assert two == SeedSpread(5.0, 0.0, 2)
    assert spreads([np.array([7.0])]) == [SeedSpread(7.0, 0.0, 1)]


def test_percent_is_whole():
    assert percent(0.573) == "57 %"


def test_groups_span_their_columns(table):
    assert table.groups == [("", 1), ("RMSE", 2), ("", 1), ("", 1)]
    assert Table((Column("a"), Column("b")), []).groups == []


def test_brief_keeps_the_marked_columns(table):
    assert [c.title for c in table.brief.columns] == ["model", "v_x", "share", "size"]
    assert table.brief.rows[0] == ["a|b", 0.02, 0.1, 1234]


def test_markdown_escapes_pipes_and_sets_the_best_in_bold(table):
    lines = table.markdown().splitlines()
    assert lines[0] == "| model | RMSE v_x (m/s) | RMSE v_y (m/s) | share | size |"
    assert lines[1] == "| --- | ---: | ---: | ---: | ---: |"
    assert lines[2] == "| a\\|b | 0.0200 | 0.500 | 0.100 | 1,234 |"
    assert lines[3] == "| [red] | **0.0100** | – | **0.900** | 0 |"
    assert lines[-1] == "Three models."


def test_terminal_shows_names_as_they_are(table):
    sink = StringIO()
    Console(file=sink, width=100).print(table.rich())
    assert "[red]" in sink.getvalue()
    assert "0.0100" in sink.getvalue()


def test_terminal_stacks_the_spread_below_the_mean():
    sink = StringIO()
    Console(file=sink, width=100).print(Table((Column("a"),), [[SeedSpread(0.02, 0.003, 2)]]).rich())
    above, below = (line.strip() for line in sink.getvalue().splitlines() if "0.0" in line)
    assert (above, below) == ("0.0200", "± 0.0030")
