"""What a diagnosis shows: improvements with intervals, systematic parts, just detectable sizes, words, figures."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dynssm_ros.identification.problem.car import CarEstimate
from dynssm_ros.identification.problem.fit import IdentificationProblem
from dynssm_ros.identification.problem.windows import RecordedRows, SimulationWindows
from dynssm_ros.identification.result.diagnosis import EXTENDED, GIVEN, RECALIBRATED, Diagnosis, NotJudged
from dynssm_ros.identification.result.improvement import Improvement, measure_improvement
from dynssm_ros.identification.result.minimum_effect import minimum_detectable
from dynssm_ros.identification.search.candidates import Candidate
from dynssm_ros.reporting.diagnosis_figures import (
    cause_pictures,
    errors_over,
    errors_over_time,
    improvement_by_horizon,
    simulated_and_measured,
)
from dynssm_ros.reporting.diagnosis_report import diagnosis_report
from dynssm_ros.reporting.diagnosis_words import as_text, left_in_words, moved_in_words, pattern_in_words, size_in_words
from dynssm_ros.signals.findings import Finding
from dynssm_ros.signals.recording import Recording
from dynssm_ros.signals.signal_map import STATE_SIGNALS
from dynssm_ros.simulation.laps import simulate
from dynssm_ros.track.tracks import load_track
from dynssm_ros.vehicle import Vehicle, load_vehicle
from dynssm_ros.vehicle.effects import EFFECTS

AV21 = load_vehicle("av21")
TRUE = AV21.with_effect("drag", {"coefficient": 0.5}).with_effect("steering_gain", {"factor": 1.1})
STEPS = 10
Lagging = tuple[Recording, Vehicle, Diagnosis]


def driven(noise: float, straight: bool = False) -> SimulationWindows:
    run = simulate(TRUE, load_track("road_course"), duration=40.0, seed=2)
    stds = noise * np.array([0.02, 0.02, 0.003])
    measured = run.measured + stds * np.random.default_rng(0).standard_normal(run.measured.shape)
    rows = np.concatenate([measured.T, run.feedback.T, (run.command - run.feedback).T])
    if straight:
        rows[[1, 2, 4, 6]] = 0.0
    time = (run.time - run.time[0]) / 1e9
    track = RecordedRows(rows, {"t": time}, AV21.sampling_time, time, np.zeros(len(time), dtype=np.intp))
    return SimulationWindows(track, np.arange(8, rows.shape[1] - 2 * STEPS - 1, STEPS // 2), 2 * STEPS, 8, "euler")


@pytest.fixture(scope="module")
def improvement() -> Improvement:
    """Of the true car over one that lacks both effects, and over one that lacks the weaker one."""
    cars = {GIVEN: AV21, RECALIBRATED: AV21.with_effect("steering_gain", {"factor": 1.1}), EXTENDED: TRUE}
    return measure_improvement(driven(1.0), {name: CarEstimate.of(vehicle) for name, vehicle in cars.items()}, STEPS)


def test_errors_are_those_of_simulations_from_every_start(improvement: Improvement) -> None:
    assert improvement.horizons.tolist() == [0.04, STEPS * 0.04, 2 * STEPS * 0.04]
    expected = np.sqrt((improvement.windows.errors(CarEstimate.of(AV21))[:, STEPS - 1] ** 2).mean(axis=0))
    np.testing.assert_allclose(improvement.rmse[GIVEN][improvement.horizon], expected)


def test_reductions_lie_in_their_intervals_and_hang_on_what_they_are_measured_from(improvement: Improvement) -> None:
    at = improvement.horizon
    for name in (GIVEN, RECALIBRATED):
        low, high = improvement.interval_from(name)
        reduction = improvement.reduction_from(name)
        np.testing.assert_allclose(reduction, 1 - improvement.rmse[EXTENDED] / improvement.rmse[name])
        assert ((low <= reduction) & (reduction <= high)).all()
    assert improvement.interval[0, at, 1] > 0.4  # steering: most of the error sideways
    assert improvement.reduction_from(RECALIBRATED)[at, 1] < 0.5 * improvement.reduction[at, 1]  # drag: little of it
    assert improvement.reduction_from(RECALIBRATED)[at, 0] > 0.2


def test_what_a_right_car_leaves_is_noise_and_the_systematic_part_is_gone(improvement: Improvement) -> None:
    at = improvement.horizon
    assert improvement.explained_variance[GIVEN][at].share[1] > 0.5
    assert (improvement.explained_variance[EXTENDED][at].share < 0.1).all()
    assert not improvement.explained_variance[EXTENDED][at].is_there
    assert improvement.systematic_gone(GIVEN)[at, 1] > 0.95
    assert np.isnan(
        replace(improvement, errors=dict.fromkeys(improvement.errors, improvement.errors[EXTENDED])).systematic_gone(
            EXTENDED
        )[0]
    ).any()


def test_twice_the_noise_hides_effects_about_twice_as_large() -> None:
    found = [Candidate("yaw_rate_bias", ("bias",)), Candidate("steering_lag", ("time_constant",))]
    sizes = []
    for noise in (1.0, 2.0):
        windows = driven(noise)
        problem = IdentificationProblem(replace(windows, starts=windows.starts[::2], steps=STEPS), CarEstimate.of(TRUE))
        sizes.append(minimum_detectable(problem, problem.fit(CarEstimate.of(TRUE), (), rounds=1), found))
    for effect in sizes[0]:
        assert 1.3 < sizes[1][effect] / sizes[0][effect] < 2.7
        assert sizes[0][effect] < 0.5 * EFFECTS[effect].magnitude().span


def test_straight_driving_shows_no_steering_error() -> None:
    problem = IdentificationProblem(replace(driven(1.0, straight=True), steps=STEPS), CarEstimate.of(AV21))
    fit = problem.fit(CarEstimate.of(AV21), (), rounds=1)
    assert minimum_detectable(problem, fit, [Candidate("steering_gain", ("factor",))]) == {
        "steering_gain": float("inf")
    }


def test_words_say_cause_size_evidence_gain_and_what_to_do(lagging: Lagging) -> None:
    found = lagging[2]
    (cause,) = found.causes
    words = as_text(found)
    assert words.startswith("cause: The simulation lacks: steering_lag.")
    assert f"steering_lag: {size_in_words(cause)}" in " ".join(words.split())
    assert (
        "Evidence: on parts of the drive that were left out the logarithm of the predictive likelihood is better"
        in words
    )
    assert moved_in_words(replace(found, moved={})) == []
    (sentence,) = moved_in_words(replace(found, moved={"D_f": -4.0}))
    assert sentence.startswith("Recalibrated: the front tyres' peak force (D_f) is ")
    assert sentence.endswith(": 4.0 of its standard deviations.")
    stuck = replace(cause, on_bound=("time_constant",))
    assert size_in_words(stuck).endswith(" or farther from neutral (at its bound) s")
    assert "Error on held-out laps 0.52 s ahead:" in words
    for channel in STATE_SIGNALS:
        assert f"   {channel} (" in words
    assert max(len(line) for line in words.splitlines() if line.startswith("   What")) <= 113
    assert left_in_words(found) == ""


def test_findings_are_told_the_largest_first_but_what_persistence_does_as_well_before(lagging: Lagging) -> None:
    found = lagging[2]
    shares = [one.explains for one in found.conclusions]
    assert shares == sorted(shares, reverse=True)
    ours = found.improvement.errors
    spoilt = {name: errors + np.array([0.0, 50.0, 0.0]) for name, errors in ours.items()}
    lost = replace(found, improvement=replace(found.improvement, errors=spoilt))
    assert next((one.kind, one.subject) for one in lost.conclusions) == ("no_better", "v_y")
    assert (
        as_text(lost).splitlines()[1].startswith("1. The steering explains nothing of v_y: 0.52 s ahead it errs by 50")
    )
    blind = replace(found, not_judged=(NotJudged("mass", "weighed", ""), NotJudged("drag", "unseen", "coasting down")))
    assert as_text(blind).endswith(
        "Cannot be judged on these laps:\n   mass: weighed\n   drag: what would show it is coasting down"
    )
    assert [section.title for section in diagnosis_report(blind).sections][-1] == "What cannot be judged"


def test_signals_that_contradict_each_other_are_told_before_the_causes(lagging: Lagging) -> None:
    found = lagging[2]
    wrong = Finding(
        what="v_y_sign", told="v_y over the path's is -1.00", size=-1.0, low=-1.1, high=-0.9, expected="1",
        remedy="v_y: scale: -1",
    )  # fmt: skip
    together = found.recordings.recording
    info = together.info.model_copy(update={"findings": (wrong,)})
    spoilt = replace(found, recordings=replace(found.recordings, recording=replace(together, info=info)))
    assert " ".join(as_text(spoilt).splitlines()[1:3]) == f"Signals that cannot be right: {wrong.line}."
    first, *rest = diagnosis_report(spoilt).verdicts
    assert (first.name, first.state) == ("data", "wrong")
    assert diagnosis_report(found).verdicts == tuple(rest)
    assert ("cause", "look") in [(each.name, each.state) for each in rest]
    assert [each["what"] for each in spoilt.to_json("")["findings"]] == ["v_y_sign"]


def test_an_error_that_grew_is_called_more_and_not_negatively_less(lagging: Lagging) -> None:
    found = lagging[2]
    ours = found.improvement.errors
    doubled = replace(found.improvement, errors={**ours, EXTENDED: 2.0 * ours[GIVEN]})
    lines = as_text(replace(found, improvement=doubled)).splitlines()
    channels = [line for line in lines if line.startswith(tuple(f"   {channel} (" for channel in STATE_SIGNALS))]
    assert len(channels) == 3
    assert all(": 100 % more than as given, " in line for line in channels)
    assert not any("-" in line.split("as given, ")[-1] for line in channels)


def test_a_pattern_names_signals_and_the_place(improvement: Improvement) -> None:
    left = improvement.explained_variance[GIVEN][improvement.horizon]
    assert "lateral acceleration" in pattern_in_words(left)
    somewhere = replace(left, stretch=dict.fromkeys(STATE_SIGNALS, (100.0, 200.0)))
    assert "farthest off 100 to 200 m into the lap" in pattern_in_words(somewhere)
    assert "too weak" in pattern_in_words(replace(left, share=np.zeros(3)))


def test_the_json_measures_from_both_cars(lagging: Lagging) -> None:
    content = lagging[2].to_json("vehicle.yaml")
    assert set(content["improvement"]) >= {
        "before",
        "recalibrated",
        "after",
        "reduction",
        "reduction_from_recalibrated",
    }
    assert set(content["systematic"]) == {"before", "recalibrated", "after", "gone"}
    assert "steering_lag" not in content["minimum_detectable"]
    assert content["minimum_detectable"]["steering_offset"] > 0


def test_the_report_shows_one_step_and_the_horizon_over_time_place_and_signals(lagging: Lagging) -> None:
    page = diagnosis_report(lagging[2]).html()
    assert page.count("data:image/svg+xml") == 10
    for title in ("Simulated and measured", "Systematic error and noise", "Errors over time", "Errors against speed",
                  "Errors against steering", "Errors against throttle", "Errors against position on the lap",
                  "Errors against lateral acceleration", "What these laps would show", "Nominal values"):  # fmt: skip
        assert f"<h2>{title}</h2>" in page
    assert EFFECTS["steering_lag"].SUMMARY in page


def test_figures_have_a_row_for_one_step_and_one_for_the_horizon(improvement: Improvement) -> None:
    axes = errors_over("speed (m/s)", improvement.windows.data.rows[0, improvement.windows.starts], improvement).axes
    assert [a.get_ylabel() for a in axes[::3]] == ["0.04 s ahead", "0.4 s ahead"]
    assert len(improvement_by_horizon(improvement).axes) == 3
    lines = simulated_and_measured(improvement).axes[1].lines
    assert [line.get_label() for line in lines] == ["measured", GIVEN, RECALIBRATED, EXTENDED]
    x, y = (np.asarray(v) for v in lines[-1].get_data())
    starts = np.isin(np.round(x / 0.04), np.round(np.asarray(lines[0].get_xdata()) / 0.04))
    assert np.isfinite(y[starts]).any()


def test_lines_break_where_there_is_nothing(improvement: Improvement) -> None:
    x = np.linspace(0.0, 1.0, len(improvement.windows.starts))
    line = errors_over("speed (m/s)", np.where(x < 0.5, x, x + 9.0), improvement).axes[0].lines[0]
    speed, mean = (np.asarray(values, dtype=float) for values in line.get_data())
    assert np.isnan(mean[1:-1]).all()
    assert (speed[0] < 0.5, speed[-1] > 9.5) == (True, True)


def test_each_cause_has_a_picture_of_how_much_where_and_when(lagging: Lagging) -> None:
    found = lagging[2]
    windows, (cause,) = found.improvement.windows, found.causes
    with_it = found.improvement.errors["extended"][:, found.improvement.horizon]
    assert cause.without.shape == with_it.shape
    ratio = np.sqrt((with_it**2).mean(axis=0) / (cause.without**2).mean(axis=0))
    assert cause.heldout_improvement == pytest.approx(1.0 - np.sqrt((ratio**2).mean()))
    figure = cause_pictures(windows, cause.without, with_it, EFFECTS[cause.effect](**cause.values))
    size, there, over = (panel for panel in figure.axes if panel.get_label() != "<colorbar>")
    np.testing.assert_allclose([bar.get_height() for bar in size.patches[3:]], ratio)
    assert "where" in there.get_title("left")
    assert "when" in over.get_title("left")


def test_each_recording_has_panels_of_its_own_time(lagging: Lagging) -> None:
    found = lagging[2]
    windows, (cause,) = found.improvement.windows, found.causes
    half = len(windows.starts) // 2
    second = np.arange(windows.data.rows.shape[1]) >= windows.starts[half]
    clock = windows.data.context["t"] - np.where(second, 7000.0, 0.0)
    data = replace(windows.data, number=second.astype(np.intp), context=windows.data.context | {"t": clock})
    both = replace(windows, data=data)
    improvement = replace(found.improvement, windows=both)
    with_it = improvement.errors["extended"][:, improvement.horizon]
    figure = cause_pictures(both, cause.without, with_it, EFFECTS[cause.effect](**cause.values))
    panels = [panel for panel in figure.axes if panel.get_label() != "<colorbar>"]
    assert [panel.get_title("left")[:4] for panel in panels] == ["erro", "wher", "when", ""]
    times = [errors_over_time(improvement, k).axes[0].lines[0].get_xdata() for k in (0, 1)]
    own = [clock[both.starts[:half]], clock[both.starts[half:]]]
    for drawn, t in zip(times, own, strict=True):
        assert (np.nanmin(np.asarray(drawn)), np.nanmax(np.asarray(drawn))) == (t.min(), t.max())


def test_the_bank_of_a_cambered_road_is_drawn_along_the_lap(lagging: Lagging) -> None:
    found = lagging[2]
    windows, (cause,) = found.improvement.windows, found.causes
    s = np.linspace(0.0, 900.0, windows.data.rows.shape[1])
    place = {"s": s % 300.0, "lap_length": np.full(len(s), 300.0), "bend": np.sin(2 * np.pi * s / 300.0)}
    placed = replace(windows, data=replace(windows.data, context=windows.data.context | place))
    with_it = found.improvement.errors["extended"][:, found.improvement.horizon]
    camber = EFFECTS["road_bank"](camber=0.1)
    drawn = np.asarray(cause_pictures(placed, cause.without, with_it, camber).axes[-1].lines[0].get_ydata())
    assert (drawn.min(), drawn.max()) == pytest.approx((-np.degrees(0.1), np.degrees(0.1)), rel=1e-2)
    assert camber.along_lap(np.linspace(0.0, 1.0, 5)) is None


def test_a_curve_along_the_lap_is_drawn_and_its_range_told(lagging: Lagging) -> None:
    found = lagging[2]
    (cause,) = found.causes
    wave = {f"knot_{k}": float(0.05 * np.cos(np.pi * k / 4)) for k in range(1, 8)}
    values = {"angle": 0.01, **wave}
    bank = replace(cause, effect="road_bank", values=values, std=dict.fromkeys(values, 1e-3))
    assert size_in_words(bank) == "road bank (deg) from -2.01 to 3.16 along the lap, 8 parameters"
    with_it = found.improvement.errors["extended"][:, found.improvement.horizon]
    figure = cause_pictures(found.improvement.windows, bank.without, with_it, EFFECTS["road_bank"](**values))
    line = np.asarray(figure.axes[-1].lines[0].get_ydata())
    assert line.max() == pytest.approx(np.degrees(0.01 + 0.05 * (4 + 2 * np.cos(np.pi / 4)) / 6), rel=1e-3)
