"""Candidates and the score test on short synthetic drives: what can be tried, and what a trial finds."""

from __future__ import annotations

import numpy as np
import pytest

from dynssm_ros.identification.problem.car import CarEstimate
from dynssm_ros.identification.problem.fit import IdentificationProblem
from dynssm_ros.identification.problem.windows import fit_windows, recorded_rows
from dynssm_ros.identification.search.candidates import Candidate, Responses, ScoreTest, candidates
from dynssm_ros.simulation.laps import as_recording, simulate
from dynssm_ros.track.lap_position import lap_context
from dynssm_ros.track.tracks import load_track
from dynssm_ros.vehicle import load_vehicle

ORCA, CLUB = load_vehicle("orca"), load_track("club")


def problem(with_lap: bool = True, **effects: dict[str, float]) -> IdentificationProblem:
    car = ORCA.with_effects(effects.items())
    recording = as_recording(simulate(car, CLUB, duration=25.0, noise=(0.005, 0.005, 0.02)))
    context = lap_context(recording, CLUB.centre if with_lap else None)
    windows = fit_windows(recording, recorded_rows(recording, context), 0.3, 0.0)
    return IdentificationProblem(windows.with_integrator("euler", ORCA), CarEstimate.of(ORCA))


def test_a_candidate_tells_amounts_from_shapes() -> None:
    patch = Candidate("grip_patch", ("factor", "centre", "length"))
    assert (patch.amplitudes, patch.shapes, patch.local) == (("factor",), ("centre", "length"), True)
    drag = Candidate("drag", ("coefficient",))
    assert (drag.shapes, drag.local) == ((), False)
    assert drag.free == (("drag", "coefficient"),)


def test_a_candidate_pays_for_what_is_fitted_or_searched_and_not_for_the_speed_that_was_driven() -> None:
    assert Candidate("drag", ("coefficient",)).cost == 1
    assert Candidate("gear_shift", ("factor",), held=(("up", 16.0), ("down", 13.0))).cost == 3
    assert Candidate("drive_map", ("half",), held=(("top", 30.0),)).cost == 1


def test_what_cannot_be_tried_is_said_and_why() -> None:
    found, left = candidates(problem(with_lap=False), CarEstimate.of(ORCA))
    assert left["load_sensitivity"].startswith("load_transfer false")
    assert "grip_patch" in left
    assert "s" in left["grip_patch"]
    assert {"drag", "mass", "steering_offset"} <= {candidate.effect for candidate in found}
    assert "grip_patch" not in {candidate.effect for candidate in found}
    lagging = ORCA.with_effect("steering_lag", {"time_constant": 0.05})
    assert candidates(problem(), CarEstimate.of(lagging))[1]["steering_lag"] == "the vehicle file has it already"


@pytest.mark.parametrize(
    ("effect", "values"),
    [("steering_offset", {"offset": 0.02}), ("drive_gain", {"factor": 1.2}), ("steering_lag", {"time_constant": 0.06})],
)
def test_the_score_test_ranks_the_hidden_effect_first_and_sizes_it(effect: str, values: dict[str, float]) -> None:
    given = problem(**{effect: values})
    fit = given.fit(CarEstimate.of(ORCA), ())
    test = ScoreTest(given, fit, Responses(given, fit.car, fit.errors))
    tried = [Candidate(name, (parameter,)) for name, parameter in (
        ("steering_offset", "offset"), ("drive_gain", "factor"), ("steering_lag", "time_constant"), ("drag", "coefficient"),
    )]  # fmt: skip
    best = max(test.try_all(tried), key=lambda scored: scored.improvement)
    assert best.candidate.effect == effect
    ((name, true),) = values.items()
    neutral = 1.0 if name == "factor" else 0.0
    assert np.sign(best.values[name] - neutral) == np.sign(true - neutral)
    assert 0.3 < (best.values[name] - neutral) / (true - neutral) < 3.0


@pytest.mark.slow
def test_without_anything_hidden_no_candidate_pays() -> None:
    given = problem()
    fit = given.fit(CarEstimate.of(ORCA), ())
    test = ScoreTest(given, fit, Responses(given, fit.car, fit.errors))
    price = np.log(given.windows.target.size)
    found = candidates(given, fit.car)[0]
    scored = test.try_all([candidate for candidate in found if not candidate.local])
    assert max(each.improvement - price * len(each.candidate.parameters) for each in scored) < 10.0
