"""Reports: self-contained, complete, and safe with any name."""

from __future__ import annotations

import base64
import json
import re
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest

from dynssm_ros.evaluation.open_loop import evaluate
from dynssm_ros.reporting.evaluation_figures import latency_histogram
from dynssm_ros.reporting.evaluation_report import (
    coefficient_table,
    coverage_table,
    markdown,
    open_loop_report,
    regime_table,
    summary_table,
    verdict,
)
from dynssm_ros.reporting.interactive import predicted_and_measured
from dynssm_ros.reporting.page import Report, Section, svg_uri
from dynssm_ros.reporting.tables import Column, Table
from dynssm_ros.runtime.baselines import Persistence, SingleTrack
from dynssm_ros.runtime.contract import WindowPrediction
from dynssm_ros.signals.findings import Finding
from dynssm_ros.signals.inputs import WINDOW_COLUMNS
from dynssm_ros.signals.recording import Recording, RecordingInfo
from dynssm_ros.track.lines import Line
from dynssm_ros.vehicle import load_vehicle

T_s = 0.02


class Adaptive:
    """The truth with coefficients that move and stated variances."""

    name, T_s, H, commands, parameters, flops = "adaptive<b>", 0.0, 3, None, 10, 20
    card, origin, online = None, "the truth", None

    def __init__(self, vehicle):
        self.vehicle, self.truth = vehicle, SingleTrack(vehicle)

    def predict(self, windows):
        share = 0.5 + 0.4 * np.sin(windows[:, -1, :1] * np.arange(1.0, 18))
        theta = self.vehicle.lower + share * (self.vehicle.upper - self.vehicle.lower)
        return self.truth.predict(windows)._replace(theta=theta, variance=np.full((len(windows), 3), 1e-6))


class Tags(HTMLParser):
    """The tags of a page with their attributes, and its style; what scripts hold is text."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.found, self.style, self._inside = [], "", ""
        self.feed(page)

    def handle_starttag(self, tag, attrs):
        self.found.append((tag, dict(attrs)))
        self._inside = tag

    def handle_data(self, data):
        self.style += data if self._inside == "style" else ""

    def handle_endtag(self, tag):
        self._inside = ""


@pytest.fixture(scope="module")
def evaluation():
    """An ORCA car that follows its own equations on a wavy course, with a pose."""
    car = load_vehicle("orca")
    truth, N = SingleTrack(car), 220
    matrix = np.zeros((N, 7))
    matrix[:, 3] = 0.3 + 0.1 * np.sin(0.05 * np.arange(N))
    matrix[:, 4] = 0.08 * np.sin(0.1 * np.arange(N))
    matrix[0, 0] = 1.5
    for k in range(N - 1):
        matrix[k + 1, :3] = truth.predict(matrix[k][None, None]).state[0]
    columns = {name: matrix[:, k] for k, name in enumerate(WINDOW_COLUMNS)}
    columns |= {"x": np.cumsum(matrix[:, 0]) * T_s, "y": np.sin(np.arange(N) / 30), "theta": np.zeros(N)}
    info = RecordingInfo(sampling_time=T_s, commands="none", source=("planted",))
    time = (np.arange(N) * T_s * 1e9).astype(np.int64)
    recording = Recording(info, time, np.zeros(N, np.int32), columns)
    models = {m.name: m for m in (Adaptive(car), truth, Persistence())}
    return evaluate(recording, models, name="run <i>1</i>.parquet", calls=20)


@pytest.fixture(scope="module")
def report(evaluation):
    return open_loop_report(evaluation)


@pytest.fixture(scope="module")
def page(report):
    return report.html()


def test_perfect_models_have_no_error(evaluation):
    score = evaluation.scores["single_track"]
    np.testing.assert_array_equal(score.rmse, 0.0)
    assert score.rollout.ade < 1e-15
    np.testing.assert_array_equal(evaluation.scores["adaptive<b>"].coverage_90, 1.0)


def test_report_has_a_section_for_everything_that_there_is(report):
    assert [section.title for section in report.sections] == [
        "Error relative to persistence",
        "Predicted and measured",
        "Predicted and measured change",
        "Rollouts",
        "Trajectories",
        "Errors by speed",
        "Errors by lateral acceleration",
        "Errors by throttle",
        "Errors over the position on the lap",
        "Where adaptive<b> errs",
        "Adapted coefficients of adaptive<b>",
        "Use of the ranges by adaptive<b>",
        "Stated uncertainty",
        "Latency",
    ]
    assert all(section.text for section in report.sections)
    bare = [section for section in report.sections if section.figure is None and section.table is None]
    assert [section.text for section in bare] == [
        "Not shown: the car completes no lap in the recording, and no track was given."
    ]


def test_errors_are_placed_on_the_line_that_is_given(evaluation):
    circle = np.linspace(0.0, 2 * np.pi, 100, endpoint=False)
    around = Line(3.0 * np.stack([np.cos(circle), np.sin(circle)], axis=1))
    (section,) = (s for s in open_loop_report(replace(evaluation, line=around)).sections if "lap" in s.title)
    assert section.figure.axes[-1].get_xlim() == (0.0, around.length)


def test_a_recording_without_positions_is_said_to_have_none(evaluation):
    columns = {name: evaluation.recording[name] for name in WINDOW_COLUMNS}
    blind = evaluate(replace(evaluation.recording, columns=columns), {"still": Persistence()}, calls=3)
    sections = {section.title: section for section in open_loop_report(blind).sections}
    assert sections["Errors over the position on the lap"].text == (
        "Not shown: the recording holds no positions (x, y)."
    )
    assert not any(title.startswith("Where") for title in sections)


def test_page_loads_nothing_from_elsewhere(page):
    tags = Tags(page)
    addresses = [value for _, given in tags.found for name, value in given.items() if name in ("src", "href")]
    assert addresses
    assert all(address.startswith("data:") for address in addresses)
    assert not {"link", "iframe", "object"} & {tag for tag, _ in tags.found}
    assert not re.search(r"@import|url\(", tags.style)
    for encoded in re.findall(r'src="data:image/svg\+xml;base64,([^"]+)"', page):
        svg = base64.b64decode(encoded).decode()
        assert not re.search(r'href="(?!#|data:)', svg)


def test_the_zoomed_figure_has_the_values_of_each_row_and_no_line_across_a_gap() -> None:
    time = np.array([0.0, 0.02, 0.04, 9.0, 9.02])
    measured, predicted = np.arange(15.0).reshape(5, 3), np.arange(15.0).reshape(5, 3) + 0.5
    drawn = predicted_and_measured(time, measured, {"a<b>": predicted}, {"r": time})
    data = json.loads(re.search(r"Plotly\.newPlot\(\s*\"zoomed\",\s*(\[.*?\]),\s*\{\"template\"", drawn, re.S)[1])

    def values(of, axis):
        return np.frombuffer(base64.b64decode(of[axis]["bdata"]), of[axis]["dtype"])

    assert len(data) == 3 + 2 * 3 + 2
    np.testing.assert_allclose(values(data[0], "x"), [0.0, 0.02, 0.04, np.nan, 1.04, 1.06], rtol=1e-6)
    np.testing.assert_array_equal(values(data[0], "y"), [0.0, 3.0, 6.0, np.nan, 9.0, 12.0])
    np.testing.assert_array_equal(values(data[4], "y"), [0.5, 0.5, 0.5, np.nan, 0.5, 0.5])
    assert "a<b>" not in drawn


def test_page_shows_every_figure(report, page):
    figures = [section for section in report.sections if section.figure is not None]
    assert len(figures) == 12
    assert page.count("<img") == len(figures)


def test_page_says_what_was_done_how(page):
    for part in ("planted", "50 Hz", "whole recording", "none: command inputs are zero", "dynssm_ros", "0.6 s", "UTC"):
        assert part in page


def test_names_cannot_inject_markup(page):
    assert "<b>" not in page
    assert "<i>" not in page
    assert "adaptive&lt;b&gt;" in page


def test_summary_table_marks_the_best(evaluation):
    cells = summary_table(evaluation).cells
    assert [cell.best for cell in cells[1][1:9]] == [True] * 8
    assert [cell.best for cell in cells[2][1:9]] == [False] * 8


def test_markdown_holds_the_same_table(evaluation):
    text = markdown(evaluation)
    assert summary_table(evaluation).markdown() in text
    assert verdict(evaluation) in text
    assert regime_table(evaluation, "throttle").markdown() in text
    assert coefficient_table(evaluation.groups["adaptive<b>"]).markdown() in text
    assert coverage_table(evaluation).markdown() in text
    assert re.findall(r"^#+ .*", text, flags=re.M) == [
        "# Open-loop evaluation on run <i>1</i>.parquet",
        "## RMSE by speed",
        "## RMSE by lateral acceleration",
        "## RMSE by throttle",
        "## Coefficients of adaptive<b>",
        "## Stated uncertainty",
    ]


def test_regime_tables_hold_each_model_s_rmse_in_the_rows_of_the_regime(evaluation):
    table = regime_table(evaluation, "speed")
    regimes = [regime for regime in evaluation.regimes if regime.quantity == "speed"]
    errors = evaluation.scores["persistence"].state - evaluation.measured
    expected = [np.sqrt(np.mean(errors[regime.member, k] ** 2)) for k in range(3) for regime in regimes]
    np.testing.assert_allclose([spread.mean for spread in table.rows[2][1:]], expected)
    assert [column.group for column in table.columns[1 :: len(regimes)]] == [
        "v_x RMSE (m/s)",
        "v_y RMSE (m/s)",
        "ω RMSE (rad/s)",
    ]


def test_coefficient_tables_show_bounds_statistics_and_rests(evaluation):
    car, score = load_vehicle("orca"), evaluation.scores["adaptive<b>"]
    table = coefficient_table(evaluation.groups["adaptive<b>"])
    name, unit, lower, upper, *statistics = table.rows[-1]
    assert (name, unit, lower, upper) == ("I_z", "kg m²", *car.coefficients["I_z"].bounds)
    inertia = score.theta[:, -1]
    expected = [inertia.mean(), inertia.std(), inertia.min(), inertia.max(), 0.0]
    np.testing.assert_allclose([spread.mean for spread in statistics], expected)


def test_verdict_names_the_best_model_against_persistence(evaluation):
    assert "100 % below persistence" in verdict(evaluation)


def test_verdict_of_models_that_all_diverge_says_so(evaluation):
    class Lost(Persistence):
        def predict(self, windows):
            return WindowPrediction(np.full((len(windows), 3), np.nan), None, None)

    lost = evaluate(evaluation.recording, {"lost": Lost()}, calls=3)
    assert verdict(lost) == "No model gave finite predictions."
    for section in open_loop_report(lost).sections:
        if section.figure is not None:
            section.figure.set_layout_engine("none")  # takes most of the time
            section.figure.draw_without_rendering()


def test_a_small_report_needs_only_title_summary_and_sections(tmp_path):
    table = Table((Column("a"), Column("b", "m")), [["x", 1.5]])
    figure = latency_histogram({"node": np.array([1.0, 2.0])}, "ms")
    Report("Demo", "It works.", [Section("One", "Look.", figure), Section("Two", "Read.", table=table)]).save(
        tmp_path / "r.html"
    )
    page = (tmp_path / "r.html").read_text()
    assert page.count("<img") == 1
    assert "1.50" in page
    assert [p.name for p in tmp_path.iterdir()] == ["r.html"]


def test_the_same_figure_gives_the_same_image():
    samples = {"m": np.arange(1.0, 50)}
    assert svg_uri(latency_histogram(samples)) == svg_uri(latency_histogram(samples))


def test_signals_that_contradict_each_other_come_first(evaluation):
    wrong = Finding(
        what="steering_sign", told="omega over curvature is -1.00", size=-1.0, low=-1.1, high=-0.9, expected="1",
        remedy="steering_feedback: scale: -1",
    )  # fmt: skip
    info = evaluation.recording.info.model_copy(update={"findings": (wrong,)})
    spoilt = replace(evaluation, recording=replace(evaluation.recording, info=info))
    (said,) = open_loop_report(spoilt).verdicts
    assert (said.name, said.state, said.text) == ("data", "wrong", wrong.line)
    assert f"- Signals that cannot be right: {wrong.line}" in markdown(spoilt)
    assert open_loop_report(evaluation).verdicts == ()
    assert "cannot be right" not in markdown(evaluation)
