"""Selection and the choice of the integrator on short synthetic drives."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from dynssm_ros.identification.problem.car import CarEstimate
from dynssm_ros.identification.problem.fit import IdentificationProblem
from dynssm_ros.identification.problem.recordings import CrossValidation, Folds
from dynssm_ros.identification.problem.windows import SimulationWindows, fit_windows, recorded_rows
from dynssm_ros.identification.result.diagnose import _not_confirmed
from dynssm_ros.identification.search.candidates import Candidate, Responses, ScoredCandidate, ScoreTest
from dynssm_ros.identification.search.confirmation import Confirmation, LeaveOneOut
from dynssm_ros.identification.search.integrator import _with_what_hides, search_causes
from dynssm_ros.identification.search.selection import Refined, Search
from dynssm_ros.identification.search.size_search import SizeSearch
from dynssm_ros.identification.tuning import CONVERGED, DECISIVE_DELTA_BIC
from dynssm_ros.signals.recording import Recording
from dynssm_ros.simulation.laps import as_recording, simulate
from dynssm_ros.track.lap_position import lap_context
from dynssm_ros.track.tracks import load_track
from dynssm_ros.vehicle import Vehicle, load_vehicle
from dynssm_ros.vehicle.effects import EFFECTS

ORCA, NOISE = load_vehicle("orca"), (0.005, 0.005, 0.02)
OTHERS = tuple(
    sorted(set(EFFECTS) - {"steering_lag", "yaw_inertia", "drag", "front_grip", "steering_offset"})
)  # untried
BUT_DRAG = tuple(sorted(set(EFFECTS) - {"drag"}))
FEW = [
    Candidate("steering_offset", ("offset",)),
    Candidate("drive_gain", ("factor",)),
    Candidate("front_grip", ("factor",)),
    Candidate("drag", ("coefficient",)),
]


def windows(**effects: dict[str, float]) -> SimulationWindows:
    return stepped("euler", NOISE, tuple((name, tuple(values.items())) for name, values in effects.items()))


@cache  # windows are not written to
def stepped(
    plant: str, noise: tuple[float, float, float], effects: tuple[tuple[str, tuple[tuple[str, float], ...]], ...] = ()
) -> SimulationWindows:
    car = ORCA.with_effects((name, dict(values)) for name, values in effects)
    run = simulate(car, load_track("club"), duration=25.0, plant=plant, noise=noise)
    recording = as_recording(run)
    data = recorded_rows(recording, lap_context(recording, None))
    return fit_windows(recording, data, 0.3, 0.0)


def search(vehicle: Vehicle = ORCA, **effects: dict[str, float]) -> Search:
    given = windows(**effects).with_integrator("euler", vehicle)
    car = CarEstimate.of(vehicle)
    return Search(IdentificationProblem(given, car), car, FEW, quarters(given))


def quarters(given: SimulationWindows) -> CrossValidation:
    quarter = np.arange(len(given)) * 4 // len(given)
    return CrossValidation(*3 * (Folds(quarter, quarter),))


def test_a_pair_is_found_the_stronger_first_and_with_its_sizes() -> None:
    found = search(steering_offset={"offset": 0.03}, drive_gain={"factor": 1.15}).run()
    assert {one.candidate.effect for one in found.chosen} == {"steering_offset", "drive_gain"}
    improvements = [one.confirmed_improvement for one in found.chosen]
    assert improvements == sorted(improvements, reverse=True)
    assert min(one.delta_bic for one in found.chosen) > DECISIVE_DELTA_BIC
    assert found.fit.car.effects["steering_offset"]["offset"] == pytest.approx(0.03, rel=0.1)
    assert found.fit.car.effects["drive_gain"]["factor"] == pytest.approx(1.15, rel=0.05)
    assert all(one.confirmation is not None and one.confirmation.holds for one in found.chosen)


@pytest.mark.slow
def test_a_search_that_begins_anew_finds_what_one_without_the_effect_does(monkeypatch: pytest.MonkeyPatch) -> None:
    searching, fresh = (search(steering_offset={"offset": 0.03}, drive_gain={"factor": 1.15}) for _ in range(2))
    first = searching.run().chosen[0].candidate.effect
    again = searching.reject(first)
    fresh.found = [one for one in fresh.found if one.effect != first]
    expected = fresh.run()
    assert [one.candidate for one in again.chosen] == [one.candidate for one in expected.chosen]
    assert again.fit.objective == pytest.approx(expected.fit.objective, abs=CONVERGED)
    monkeypatch.setattr(searching._problem, "fit", None)  # nothing of it is fitted another time
    assert [one.candidate for one in searching.reject(first).chosen] == [one.candidate for one in again.chosen]


def test_nothing_is_chosen_where_nothing_is_hidden() -> None:
    found = search().run()
    assert found.chosen == []
    assert found.fit is found.base


def test_leaving_one_out_is_a_fit_without_it() -> None:
    searching = search(steering_offset={"offset": 0.03})
    found = searching.run()
    (one,) = found.chosen
    without = searching.leave_out(found, one)
    assert "steering_offset" not in without.car.effects
    assert without.objective - found.fit.objective == pytest.approx(one.improvement, rel=0.5)


def test_a_candidate_is_fitted_before_it_is_dropped_for_a_promise_that_no_size_keeps() -> None:
    known = ORCA.with_nominal(ORCA.nominal, 0.01 * np.abs(ORCA.nominal) + 1e-6)
    given, car = windows(odometry_lever_arm={"x": 0.02}).with_integrator("euler", known), CarEstimate.of(known)
    problem = IdentificationProblem(given, car)
    near = problem.fit(car, ())
    trial = SizeSearch(problem, near, car, 8.0, problem.tempering)
    wrong = ScoredCandidate(Candidate("odometry_lever_arm", ("x", "y")), {"x": -3.0, "y": 2.0}, 1e5)
    start = trial.start(wrong)
    assert start.car.effects["odometry_lever_arm"]["x"] == pytest.approx(0.02, rel=0.1)
    assert start.expected_delta_bic > 100.0
    assert trial.start(replace(wrong, improvement=10.0)).expected_delta_bic < 0.0, "it would not pay"


def test_a_promise_is_measured_on_as_many_windows_as_it_was_made_on(monkeypatch: pytest.MonkeyPatch) -> None:
    known = ORCA.with_nominal(ORCA.nominal, 0.01 * np.abs(ORCA.nominal) + 1e-6)
    given, car = windows(odometry_lever_arm={"x": 0.02}).with_integrator("euler", known), CarEstimate.of(known)
    problem = IdentificationProblem(given, car)
    near = problem.fit(car, ())
    candidate = Candidate("odometry_lever_arm", ("x",))
    (kept,) = ScoreTest(problem, near, Responses(problem, car, near.errors)).try_all([candidate])
    some, there = problem.part(near, 4)
    monkeypatch.setattr(some, "fit", None)  # the tried sizes do
    start = SizeSearch(some, there, car, 8.0, problem.tempering).start(kept)
    assert start.expected_delta_bic == pytest.approx(kept.improvement - 8.0, rel=0.4)


def test_evidence_that_does_not_repeat_does_not_pay() -> None:
    searching = search()
    fit = searching.base
    everywhere = Confirmation(np.array([3.0, 4.0, 5.0, -1.0]), 4.0, 0.0, np.zeros(3))
    strong = Refined(FEW[0], fit, 100.0, 90.0, everywhere, 5.0)
    assert strong.pays
    once = replace(everywhere, improvement=np.array([20.0, -1.0, -2.0, -0.5]))
    assert not replace(strong, confirmation=once).pays
    assert not replace(strong, confirmation=replace(everywhere, std=12.0)).pays
    assert not replace(strong, delta_bic=DECISIVE_DELTA_BIC).pays
    assert not replace(strong, sure=2.9).pays
    assert not replace(strong, confirmation=None).pays
    centre_known = 0.02 * (ORCA.constants.l_f + ORCA.constants.l_r)
    for effect, values, sure, pays in (
        ("grip", {"factor": 0.85}, 10.0, True),
        ("grip", {"factor": 0.95}, 50.0, False),
        ("grip", {"factor": 0.884}, 6.2, False),  # 0.9 standard deviations more than any car
        ("load_transfer", {"height": -0.011}, 11.5, True),
        ("load_transfer", {"height": -0.011}, 10.5, False),
        ("odometry_lever_arm", {"x": -1.1 * centre_known}, 34.0, True),
        ("odometry_lever_arm", {"x": 0.9 * centre_known}, 50.0, False),
        ("odometry_lever_arm", {"x": 0.9 * centre_known, "y": 0.9 * centre_known}, 20.0, True),
    ):
        sized = replace(strong, candidate=Candidate(effect, tuple(values)), sure=sure, least=fit.car.least(effect, 0.3))
        assert replace(sized, fit=replace(fit, car=fit.car.with_effect(effect, values))).pays == pays
    for length, pays in ((0.5, True), (0.8, False)):
        values = {"factor": 0.8, "centre": 0.3, "length": length}
        sized = replace(strong, candidate=Candidate("grip_patch", tuple(values)))
        sized = replace(sized, fit=replace(fit, car=fit.car.with_effect("grip_patch", values)))
        assert sized.pays == pays, "a patch as long as can be is everywhere"
        assert sized.strangeness == (False, False, True, False)
    once_alone = replace(everywhere, least=2.0)
    assert replace(strong, confirmation=once_alone).pays
    assert not replace(strong, confirmation=replace(once_alone, std=6.0)).pays


def test_what_is_not_confirmed_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    searching = search(steering_offset={"offset": 0.03})
    (best, *_) = searching.ranked(())
    assert searching.eliminated(()).unconfirmed is None, "it would be"
    once = Confirmation(np.array([24.0, 24.0, -240.0, 24.0]), 100.0, 0.0, np.zeros(3))
    monkeypatch.setattr(searching._kept.left_out, "compare", lambda without, fit: once)
    doubtful = searching.eliminated(()).unconfirmed
    assert doubtful is not None
    assert doubtful.candidate == best.candidate
    (note,) = _not_confirmed(doubtful)
    assert note.startswith("steering_offset (offset 0.0")
    assert "+24, +24, -240, +24. Nothing of it is kept. What would tell: driving straight" in note
    assert list(_not_confirmed(None)) == []


def test_what_was_known_decides_where_left_out_parts_tell_nothing() -> None:
    level = Confirmation(np.array([1.0, -1.0, 0.5, -0.5]), 2.0, 5.0, np.zeros(3))
    assert level.holds
    assert not replace(level, known=3.0).holds
    assert not replace(level, improvement=np.array([-1.0, -1.0, -0.5, -0.5])).holds


def test_what_was_known_takes_nothing_from_what_left_out_parts_tell() -> None:
    """Where one quarter of the drive goes to the limit, its improvement makes the standard error large."""
    confirmed = Confirmation(np.array([44.0, 1.0, 3.0, 3.0]), 41.0, 0.0, np.zeros(3))
    assert confirmed.holds
    assert replace(confirmed, known=61.0).holds
    assert not replace(confirmed, known=61.0, improvement=np.array([24.0, 1.0, 3.0, 3.0])).holds
    assert not replace(confirmed, known=61.0, improvement=np.array([54.0, -1.0, -1.0, -1.0])).holds


def test_a_gain_that_is_hardly_evidence_tells_nothing_apart() -> None:
    little = Confirmation(np.array([0.5, 0.4, 0.6, 0.5]), 0.1, 0.5, np.zeros(3))
    assert little.alike
    assert not replace(little, known=1.5).alike
    assert replace(little, known=1.5, std=4.0).alike


@pytest.mark.slow
def test_what_no_car_has_gives_way_to_what_cannot_be_told_from_it() -> None:
    """Without downforce, tyres that gain less force than load are like a centre of gravity that is lower than measured."""
    av21 = load_vehicle("av21")
    car = av21.with_effect("load_sensitivity", {"exponent": 0.5})
    run = simulate(car, load_track("road_course"), duration=40.0, plant="rk4", noise=(0.005, 0.005, 0.001))
    recording = as_recording(run)
    data = recorded_rows(recording, lap_context(recording, None))
    given = fit_windows(recording, data, 0.5, 0.0).with_integrator("rk4", av21)
    known = CarEstimate.of(av21.with_nominal(av21.nominal, 0.001 * (av21.upper - av21.lower)))
    lower, sensitive = Candidate("load_transfer", ("height",)), Candidate("load_sensitivity", ("exponent",))
    searching = Search(IdentificationProblem(given, known), known, [lower, sensitive], quarters(given))
    strange = searching.eliminated((next(r.candidate for r in searching.ranked(()) if r.candidate == lower),))
    assert [one.is_met for one in strange.chosen] == [False]
    assert strange.alternatives == {"load_transfer": ["load_sensitivity"]}
    found = searching.run()
    assert [one.candidate for one in found.chosen] == [sensitive]
    assert found.alternatives == {"load_sensitivity": ["load_transfer"]}
    chosen = [lower]
    searching._prefer_ordinary(chosen)
    assert chosen == [sensitive]


@pytest.mark.parametrize(("factor", "named"), [(0.93, []), (0.85, ["front_grip"])])
def test_what_leaning_loads_take_from_a_front_axle_is_no_cause(factor: float, named: list[str]) -> None:
    known = ORCA.with_nominal(ORCA.nominal, 0.01 * np.abs(ORCA.nominal) + 1e-6)
    found = search(known, front_grip={"factor": factor}).run()
    assert [one.candidate.effect for one in found.chosen] == named


@pytest.mark.parametrize("name", sorted(EFFECTS))
def test_every_variant_of_an_effect_is_compared_with_its_least_size(name: str) -> None:
    neutral = {parameter: about.neutral for parameter, about in EFFECTS[name].PARAMETERS.items()}
    car = CarEstimate.of(ORCA).with_effect(name, neutral)
    for variant in EFFECTS[name].variants():
        fit: Any = SimpleNamespace(car=car)
        one = Refined(Candidate(name, variant), fit, 0.0, 0.0, least=car.least(name, 0.1))
        assert (one.beyond <= 0.0) == (one.least > 0.0)


def test_what_the_file_has_already_must_change_noticeably_to_be_a_cause() -> None:
    assert CarEstimate.of(ORCA).least("steering_lag", 0.1) == 0.0
    late = ORCA.with_effect("steering_lag", {"time_constant": 0.05})
    assert CarEstimate.of(late).least("steering_lag", 0.1) == EFFECTS["steering_lag"].TYPICAL[0]


def test_left_out_parts_are_predicted_by_the_others() -> None:
    given = windows(steering_offset={"offset": 0.03}).with_integrator("euler", ORCA)
    problem = IdentificationProblem(given, CarEstimate.of(ORCA))
    without = problem.fit(CarEstimate.of(ORCA), ())
    car = without.car.with_effect("steering_offset", {"offset": 0.03})
    fit = problem.fit(car, FEW[0].free, without)
    found = LeaveOneOut(problem, quarters(given)).compare(without, fit)
    # as good on rows that were left out as the likelihood of all of them says, but for what was fitted to each
    log_likelihood = (
        problem.log_likelihood(fit.errors, fit.noise) - problem.log_likelihood(without.errors, without.noise)
    ).sum()
    assert found.improvement.sum() == pytest.approx(log_likelihood, rel=0.3)
    assert found.holds
    assert len(found.improvement) == 4
    nothing = LeaveOneOut(problem, quarters(given)).compare(fit, fit)
    np.testing.assert_array_equal(nothing.improvement, 0.0)
    assert nothing.alike or nothing.std == 0.0


@pytest.mark.parametrize("plant", ["euler", pytest.param("rk4", marks=pytest.mark.slow)])
def test_the_integrator_is_that_of_the_data(plant: str) -> None:
    given = stepped(plant, NOISE)
    found = search_causes(given, CarEstimate.of(ORCA), quarters(given), exclude=OTHERS)
    assert found.problem.windows.integrator == plant
    assert [one.candidate.effect for one in found.selection.chosen] == []
    assert np.isfinite(found.selection.fit.objective)


@pytest.mark.parametrize("stated", [*(pytest.param(one, marks=pytest.mark.slow) for one in (None, "rk4")), "euler"])
def test_the_integrator_is_that_of_the_file_where_the_data_do_not_say(stated: str | None) -> None:
    given = stepped("rk4", (0.2, 0.2, 1.0))
    car = CarEstimate.of(ORCA.model_copy(update={"integrator": stated}))
    found = search_causes(given, car, quarters(given), exclude=BUT_DRAG)
    assert found.problem.windows.integrator == (stated or "rk4")


def test_what_hides_the_steps_never_makes_a_fit_worse(monkeypatch: pytest.MonkeyPatch) -> None:
    given, car = windows().with_integrator("euler", ORCA), CarEstimate.of(ORCA)
    problem = IdentificationProblem(given, car)
    fit = problem.fit(car, ())
    closer, worse = (replace(fit, objective=fit.objective + change) for change in (-1.0, 1.0))
    monkeypatch.setattr(problem, "fit", lambda *_: closer)
    assert _with_what_hides(problem, fit) is closer
    monkeypatch.setattr(problem, "fit", lambda *_: worse)
    assert _with_what_hides(problem, fit) is fit


@pytest.mark.slow
def test_another_yaw_inertia_is_not_taken_for_euler_steps() -> None:
    """Steps of 40 ms that act half a step late are to a car of this yaw inertia what it is to one of less."""
    av21 = load_vehicle("av21")
    known = CarEstimate.of(av21.with_nominal(av21.nominal, 0.01 * np.abs(av21.nominal) + 1e-6))
    car = av21.with_effect("yaw_inertia", {"factor": 0.65})
    recording = as_recording(
        simulate(car, load_track("road_course"), duration=40.0, plant="rk4", noise=(0.01, 0.01, 0.002))
    )
    given = fit_windows(recording, recorded_rows(recording, lap_context(recording, None)), 0.5, 0.0)
    found = search_causes(given, known, quarters(given), exclude=OTHERS)
    assert found.problem.windows.integrator == "rk4"
    assert [one.candidate.effect for one in found.selection.chosen] == ["yaw_inertia"]
    assert found.selection.fit.car.effects["yaw_inertia"]["factor"] == pytest.approx(0.65, abs=0.05)


@pytest.mark.slow
def test_inputs_that_changed_between_the_rows_go_on_a_line() -> None:
    fast = ORCA.model_copy(update={"sampling_time": ORCA.sampling_time / 4})
    recording = as_recording(
        simulate(fast, load_track("club"), duration=18.0, plant="rk4", noise=(0.002, 0.002, 0.005))
    )
    slow = recording.info.model_copy(update={"sampling_time": ORCA.sampling_time})
    every = Recording(
        slow,
        recording.time[::4],
        recording.segment[::4],
        {name: values[::4] for name, values in recording.columns.items()},
    )
    given = fit_windows(every, recorded_rows(every, lap_context(every, None)), 0.3, 0.0)
    found = search_causes(given, CarEstimate.of(ORCA), quarters(given), exclude=BUT_DRAG)
    windows = found.problem.windows
    assert (windows.integrator, windows.hold) == ("rk4", "first")
    held = IdentificationProblem(replace(windows, hold="zero"), CarEstimate.of(ORCA), found.problem.tempering)
    assert held.fit(CarEstimate.of(ORCA), ()).objective > found.search.base.objective + 100.0
