"""Patterns that were planted in the errors of a simulated car are found, and nothing else."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import dynssm_ros
from dynssm_ros.arrays import Vector
from dynssm_ros.errors import RecordingError
from dynssm_ros.evaluation.residuals.anatomy import ModelAnatomy, anatomy, model_anatomy
from dynssm_ros.evaluation.residuals.diagnosed import ExaminedDiagnosis, left_by
from dynssm_ros.evaluation.residuals.evidence import chances, holm
from dynssm_ros.evaluation.residuals.learner import left_to_learn
from dynssm_ros.evaluation.residuals.patterns import ADVICE, Pattern
from dynssm_ros.evaluation.residuals.regimes import situations
from dynssm_ros.evaluation.residuals.sizes import quantum, speeds_of
from dynssm_ros.identification.result.diagnosis import Diagnosis
from dynssm_ros.reporting.diagnosis_report import diagnosis_report
from dynssm_ros.reporting.diagnosis_words import as_text
from dynssm_ros.reporting.evaluation_report import summary_table
from dynssm_ros.runtime.registry import load_model
from dynssm_ros.signals.recording import Recording
from dynssm_ros.vehicle import Vehicle, load_vehicle

NOISE = (0.005, 0.005, 0.02)


@pytest.fixture(scope="module")
def healthy() -> Recording:
    """A minute and a half of a car that is just what its file says, with noisy sensors."""
    return dynssm_ros.recorded(dynssm_ros.simulate("orca", "club", duration=90.0, noise=NOISE, seed=3))


def taken_apart(recording: Recording, learn: bool = False) -> ModelAnatomy:
    physics = load_model("single_track", load_vehicle("orca"))
    return anatomy(recording, {"physics": physics}, physics, learn=learn).models["physics"]


def with_column(recording: Recording, name: str, values: Vector) -> Recording:
    return replace(recording, columns=recording.columns | {name: values})


def test_a_healthy_car_has_no_pattern(healthy: Recording) -> None:
    assert taken_apart(healthy).patterns == ()


def test_a_correction_each_second_is_found_with_period_and_share(healthy: Recording) -> None:
    clean = taken_apart(healthy).errors
    values, mark = clean.values.copy(), clean.number % 50 == 17
    step = 6.0 * values[:, 1].std()
    values[mark, 1] += step
    found, *others = model_anatomy(replace(clean, values=values), situations(clean), learn=False).patterns
    assert (found.channel, found.family, found.size["period_s"]) == ("v_y", "time", pytest.approx(1.0))
    assert found.size["phase_s"] == pytest.approx(17 * 0.02)
    assert others == []
    planted = 1.0 - np.sum((values[:, 1] - step * mark) ** 2) / np.sum(values[:, 1] ** 2)
    assert found.share == pytest.approx(planted, abs=0.02)


def test_an_estimate_that_is_pulled_back_each_second_is_found(healthy: Recording) -> None:
    rows = np.arange(len(healthy))
    drifting = healthy["v_y"] + 0.03 * (rows / 50 - np.ceil(rows / 50))
    found = [each for each in taken_apart(with_column(healthy, "v_y", drifting)).patterns if each.channel == "v_y"]
    assert (found[0].family, found[0].size["period_s"]) == ("time", pytest.approx(1.0))
    assert found[0].share > 0.4


def test_lines_that_are_near_each_other_are_told_as_one_period(healthy: Recording) -> None:
    clean = taken_apart(healthy).errors
    values, t = clean.values.copy(), clean.seconds
    values[:, 1] += values[:, 1].std() * (np.sin(2 * np.pi * t / 0.217) + 0.7 * np.sin(2 * np.pi * t / 0.228))
    found = model_anatomy(replace(clean, values=values), situations(clean), learn=False).patterns
    first, *others = [each.size["period_s"] for each in found if "period_s" in each.size]
    assert first == pytest.approx(0.217, rel=0.01)
    assert not any(0.9 < period / first < 1.1 for period in others)


def test_spikes_are_counted(healthy: Recording) -> None:
    rng = np.random.default_rng(1)
    omega = healthy["omega"].copy()
    at = rng.choice(np.arange(100, len(omega) - 100), 25, replace=False)
    omega[at] += rng.choice([-1.0, 1.0], 25) * 0.5
    spikes = [each for each in taken_apart(with_column(healthy, "omega", omega)).patterns if each.kind == "spikes"]
    (found,) = [each for each in spikes if each.channel == "omega"]
    assert found.size["events"] == pytest.approx(25, abs=3)
    assert found.share > 0.3


def test_speeds_at_which_large_errors_come_are_named_as_ranges_and_none_by_chance(healthy: Recording) -> None:
    clean = taken_apart(healthy).errors
    v_x, rng = clean.driven[:, 0], np.random.default_rng(4)
    low, high = np.percentile(v_x, [40, 60])
    within, anywhere = np.flatnonzero((v_x > low) & (v_x < high)), np.arange(len(v_x))
    told = []
    for rows in (within, anywhere):
        large = np.zeros(len(v_x), bool)
        large[rng.choice(rows, 40, replace=False)] = True
        told.append(speeds_of(clean, large))
    (named,), chance = told[0][:1], told[1]
    assert low - 0.1 < named[0] < named[1] < high + 0.1
    assert chance == ()


@pytest.mark.slow
def test_a_drive_in_other_steps_than_the_file_names_the_integrator_and_no_delay() -> None:
    drive = dynssm_ros.simulate("orca", "club", duration=60.0, noise=NOISE, seed=3, plant="rk4")
    found = taken_apart(dynssm_ros.recorded(drive)).patterns
    told, *others = found
    assert others == []
    assert (told.kind, told.channel, told.size) == ("integrator", "omega", {"integrator": "rk4"})
    assert told.share > 0.9
    assert told.picture is not None
    assert told.picture.y[1] < told.picture.y[0]


def test_a_learner_finds_what_no_test_looks_for(healthy: Recording) -> None:
    clean = taken_apart(healthy).errors
    v_x, delta = clean.driven[:, 0], clean.applied[:, 1]
    product = np.sin(2 * np.pi * (v_x - v_x.mean()) / v_x.std()) * np.tanh(delta / delta.std())
    values = clean.values.copy()
    values[:, 0] += 2.0 * values[:, 0].std() * product / product.std()
    found = left_to_learn(replace(clean, values=values))["v_x"]
    assert 0.6 < found.share < 0.85  # 0.8 of the squared error is planted
    assert (
        found.share - found.filtered > 0.1
    )  # as the rest lasts for some rows, a filter of the last errors knows it too
    assert found.p < 1e-4
    assert next(iter(found.uses)) == "v_x"


def test_a_drive_that_is_too_short_is_refused(healthy: Recording) -> None:
    with pytest.raises(RecordingError, match="expected 24 s"):
        taken_apart(healthy.select(slice(0, 600)))


def test_a_signal_in_steps_is_known_by_its_step() -> None:
    smooth = np.sin(np.linspace(0, 30, 4000))
    assert quantum(np.round(smooth / 0.05) * 0.05) == pytest.approx(0.05)
    assert quantum(smooth) == 0.0


def test_chances_of_sums_without_a_mean_are_uniform() -> None:
    sums = np.random.default_rng(0).standard_t(3, (30, 4000))
    found = chances(sums)
    assert np.mean(found < 0.05) < 0.06
    assert np.mean(found < 0.001) < 0.002


def test_a_diagnosed_car_leaves_no_pattern_but_one_that_no_effect_has(
    lagging: tuple[Recording, Vehicle, Diagnosis],
) -> None:
    found = lagging[2]
    clean = left_by(found)
    assert clean is not None
    assert clean.patterns == ()
    log, data = found.recordings.recording, found.windows.data
    rows = data.rows.copy()
    rows[1] += 0.1 * (np.arange(len(log)) % 25 == 7)
    spoilt = replace(found, windows=replace(found.windows, data=replace(data, rows=rows)))
    left = left_by(spoilt)
    assert left is not None
    assert {(each.channel, each.family, each.size["period_s"]) for each in left.patterns} == {("v_y", "time", 1.0)}
    told = [line for line in as_text(spoilt, left).splitlines() if left.patterns[0].words in line]
    assert len(told) == 1
    examined = ExaminedDiagnosis.of(spoilt)
    assert [each.words for each in examined.patterns] == [each.words for each in left.patterns]
    assert [each["words"] for each in examined.to_json("car.yaml")["patterns"]] == [
        each.words for each in left.patterns
    ]
    page = diagnosis_report(spoilt, left)
    assert page.sections[1].title == "What is left, v_y: in time"
    assert [each.name for each in page.verdicts].count("step") == min(3, len(left.patterns))


def test_holm_rejects_as_long_as_each_is_below_its_level() -> None:
    assert holm([0.04, 0.001, 0.02], 0.05) == [True, True, True]
    assert holm([0.04, 0.001, 0.03], 0.05) == [False, True, False]


def test_an_evaluation_says_what_is_left_to_learn(healthy: Recording) -> None:
    scored = dynssm_ros.evaluate(healthy, ["single_track", "persistence"], "orca", stride=500, left_to_learn=True)
    left = scored.to_json()["left_to_learn"]
    assert left["persistence"]["v_x"]["share"] > 0.5 > left["single_track"]["v_x"]["share"]
    heads = [column.group for column in summary_table(scored).columns]
    assert heads.count("left to learn") == 3


def test_steering_that_acts_two_samples_late_is_told_with_its_delay(healthy: Recording) -> None:
    ahead = {name: np.roll(healthy[name], -2) for name in ("delta_fb", "delta_cmd")}
    late = replace(healthy, columns=healthy.columns | ahead)
    found = [each for each in taken_apart(late).patterns if each.kind == "steering_delay"]
    assert found
    for each in found:
        assert each.size["low_s"] <= 0.04 <= each.size["high_s"]


def test_resistance_at_some_speeds_is_told_with_the_speeds(healthy: Recording) -> None:
    clean = taken_apart(healthy).errors
    values, v_x = clean.values.copy(), clean.driven[:, 0]
    values[v_x > np.percentile(v_x, 60), 0] += 0.01
    found = model_anatomy(replace(clean, values=values), situations(clean), learn=False).patterns[0]
    assert (found.channel, found.kind) == ("v_x", "speed")
    assert found.size["error_per_s"] == pytest.approx(0.01 / 0.02, rel=0.4)


@pytest.mark.parametrize("seed", range(3))
def test_errors_of_which_nothing_can_be_fitted_have_no_period(healthy: Recording, seed: int) -> None:
    clean = taken_apart(healthy).errors
    wild = np.random.default_rng(seed).standard_t(1.2, clean.values.shape)
    found = model_anatomy(replace(clean, values=wild), situations(clean), learn=False).patterns
    assert {each.kind for each in found} <= {"spikes"}


def test_errors_in_a_gear_and_after_its_changes_are_told(healthy: Recording) -> None:
    gear = 1.0 + (healthy["v_x"] > np.median(healthy["v_x"]))
    clean = taken_apart(with_column(healthy, "gear", gear)).errors
    for planted, kind, words in (
        (gear[clean.rows] == 2, "gear", "in gear 2"),
        ((gear[clean.rows] == 2) & (clean.applied[:, 0] > 0.1), "gear_and_pedal", "under throttle in gear 2"),
        (
            np.diff(gear, prepend=1.0)[clean.rows] > 0,
            "time_since_a_change_up_of_the_gear",
            "0 to 0.1 s after a change up",
        ),
    ):
        values = clean.values.copy()
        values[planted, 0] -= 0.02
        found = model_anatomy(replace(clean, values=values), situations(clean), learn=False).patterns[0]
        assert (found.channel, found.kind) == ("v_x", kind)
        assert words in found.words


@pytest.mark.parametrize("length", [0.05, 0.08])
def test_errors_that_come_with_the_way_are_those_of_the_wheels(healthy: Recording, length: float) -> None:
    turned = 2 * np.pi * np.cumsum(healthy["v_x"]) * healthy.T_s / length
    found, *others = taken_apart(with_column(healthy, "v_x", healthy["v_x"] + 0.005 * np.sin(turned))).patterns
    assert (found.channel, found.kind) == ("v_x", "wheel_synchronous")
    assert "wheel_synchronous" not in {each.kind for each in others}, "the same wheel is told once"
    assert found.size["period_m"] == pytest.approx(length, rel=0.01)
    assert "circumference" in found.advice
    assert found.to_json()["advice"] == found.advice


def test_a_pattern_that_a_team_can_act_on_says_how() -> None:
    kinds = {"period", "period_of_size", "period_of_spikes", "echo", "wheel_synchronous", "spikes", "quantised", "repeated",
             "clipped", "steering_delay", "throttle_delay", "integrator", "gear", "speed", "heading"}  # fmt: skip
    assert kinds <= set(ADVICE)
    assert Pattern("v_x", "where", "speed", "", 0.1, 0.0).advice
    assert not Pattern("v_y", "where", "speed", "", 0.1, 0.0).advice, "no drive force pushes sideways"
