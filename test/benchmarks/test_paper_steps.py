"""The steps of a plan: each once, with all that it needs; and a whole small run."""

from __future__ import annotations

import json

import pytest
import torch

from benchmarks.paper.plan import Plan, load_plan
from benchmarks.paper.results import read_results
from benchmarks.paper.schedule import steps_of
from benchmarks.paper.steps import Evaluate, Take, Train, UnavailableError
from benchmarks.tasks import output, perform, split_available
from dynssm_ros.configuration import validate
from dynssm_ros.files import digest
from dynssm_ros.learning.models.registry import merge
from dynssm_ros.runtime.artifact import open_artifact
from dynssm_ros.signals.recording import Recording
from dynssm_ros.vehicle import load_vehicle

SMALL = {
    "logs": {"away": {"bag": "nowhere", "signals": "default", "rate": 50.0}},
    "drives": {
        "club": {"vehicle": "orca", "track": "club", "duration": 8.0, "plant": "euler", "seed": 0},
        "club_b": {"vehicle": "orca", "track": "club_b", "duration": 4.0, "plant": "euler", "seed": 1},
    },
    "cars": {
        "orca": {
            "vehicle": "orca", "start": "mid_range", "min_speed": 0.0, "reference": "sim", "horizon": 0.1,
            "full": "dynssm_orca", "ddm": "ddm_orca", "fthd": "fthd_orca", "coefficients": "track",
        },
    },
    "splits": {
        "club": {
            "car": "orca",
            "train": {"recording": "club"},
            "test": {"club b": {"recording": "club_b"}, "late": {"recording": "club", "where": [
                {"quantity": "time", "at_least": 6.0}]}},
        },
        "away": {"car": "orca", "train": {"recording": "club"}, "test": {"away": {"recording": "away"}}},
        "given": {"car": "orca", "train": {"recording": "club"}},
    },
    "models": {
        "ridge_orca": {"base": "ridge", "change": {"history": 0.3}, "seeds": 1},
        "dynssm_orca": {"base": "dynssm_paper_orca", "change": {"physics": {"nominal": "calibrated"}}},
        "ddm_orca": {"vehicle": "orca"}, "fthd_orca_ddm": {"vehicle": "orca"}, "fthd_orca": {"vehicle": "orca"},
    },
    "studies": {
        "track": {
            "title": "another track", "text": "T.", "splits": ["club"], "commands": "topics",
            "models": ["persistence", "single_track", "ridge_orca", "dynssm_orca"], "seeds": 2,
        },
        "absent": {
            "title": "absent", "text": "T.", "splits": ["away"], "commands": "topics", "models": ["persistence"], "seeds": 1,
        },
        "given": {
            "title": "given", "text": "T.", "splits": ["given"], "commands": "topics", "models": ["ridge_orca"], "seeds": 1,
        },
    },
    "stride": 20, "calls": 5, "epochs": 1,
    "quick": {"epochs": 1, "seeds": 1, "stride": 20, "duration": 4.0},
}  # fmt: skip


@pytest.fixture(scope="module")
def plan():
    return validate(Plan, SMALL, "small")


@pytest.fixture(scope="module")
def small_run(plan, tmp_path_factory):
    """The small plan as it was run: its folder, steps, outcomes and results."""
    root = tmp_path_factory.mktemp("paper")
    steps = steps_of(plan, None, {})
    available = split_available(steps)[0]
    for step in sorted(available, key=lambda step: len(step.uses)):
        assert perform(step, root, [other.key for other in available if output(other, root).exists()]) is None
    return root, steps, available, read_results(plan, root, steps)


@pytest.fixture(scope="module")
def quick_run(plan, tmp_path_factory):
    """The split that is there, with models that take no epochs: its folder, and results."""
    study = plan.studies["track"].model_copy(
        update={"models": ("persistence", "mid_range", "single_track", "ridge_orca"), "seeds": 1}
    )
    small = plan.model_copy(update={"studies": {"track": study}})
    root = tmp_path_factory.mktemp("quick_run")
    steps = steps_of(small, None, {})
    needed = [step for step in split_available(steps)[0] if not step.key.startswith("costs")]
    for step in sorted(needed, key=lambda step: len(step.uses)):
        assert perform(step, root, [other.key for other in needed if output(other, root).exists()]) is None
    return root, read_results(small, root, steps)


def by_key(steps):
    return {step.key: step for step in steps}


def test_each_step_of_the_shipped_plan_is_there_once_with_what_it_builds_on():
    plan = load_plan()
    for given in ({}, {"vegas": "vegas.parquet"}):
        steps = steps_of(plan.with_tests(dict.fromkeys(given, 0.04)), None, given)
        keys = [step.key for step in steps]
        assert len(set(keys)) == len(keys)
        assert all({*step.needs, *step.uses} <= set(keys) for step in steps)
        assert {step.key for step in steps if isinstance(step, Take)} == {
            f"recordings/{name}.parquet" for name in given
        }
        assert ("scores/whole.lookahead.json" in keys) == bool(given)


def test_a_given_drive_is_predicted_by_the_trainings_that_are_there_anyway():
    given = {"mobil": "mobil.parquet"}
    plan = load_plan()
    steps = by_key(steps_of(plan.with_tests({"mobil": 0.02}), None, given))
    ours, theirs = (steps[f"scores/{split}.topics.json"] for split in ("ethz", "ethz_given"))
    assert set(theirs.trained) <= set(ours.trained)
    assert theirs.vehicle == ours.vehicle
    without = {step.key for step in steps_of(plan, None, {})}
    assert set(steps) - without == {"recordings/mobil.parquet", "scores/ethz_given.topics.json"}


def test_rollouts_are_as_long_as_the_car_s_horizon(plan):
    steps = by_key(steps_of(load_plan(), None, {}))
    assert steps["scores/ethz.topics.json"].recipe()["horizon"] == 0.3
    assert steps["scores/lap_2.lookahead.json"].recipe()["horizon"] == 0.6
    assert steps["scores/lap_2.lookahead.json"].nominal == "av21_paper"


def test_every_training_of_a_split_is_evaluated():
    steps = steps_of(load_plan(), None, {})
    others = ("rates/", "searches/")
    trained = {step.key for step in steps if isinstance(step, Train) and not step.key.startswith(others)}
    assert trained == {key for step in steps if isinstance(step, Evaluate) for key in step.trained}


def test_studies_that_share_a_split_share_its_trainings(plan):
    other = plan.studies["track"].model_copy(update={"models": ("ridge_orca", "dynssm_orca"), "seeds": 1})
    both = plan.model_copy(update={"studies": {"other": other, "track": plan.studies["track"]}})
    (alone,) = (step for step in steps_of(plan, None, {}) if step.key == "scores/club.topics.json")
    (shared,) = (step for step in steps_of(both, None, {}) if step.key == "scores/club.topics.json")
    assert set(shared.trained) == set(alone.trained)
    assert len(alone.trained) == 3  # ridge once, the full model with two seeds
    assert shared.untrained == alone.untrained == ("persistence", "single_track")


def test_a_model_is_trained_on_the_car_that_the_plan_says():
    steps = by_key(steps_of(load_plan(), None, {}))
    full = steps["models/slow.lookahead/dynssm_av21.0"]
    assert full.vehicle == "vehicles/slow.lookahead.yaml"
    assert full.vehicle in full.needs
    assert steps["models/slow.lookahead/ddm_av21.0"].vehicle == "av21_paper"
    assert steps["models/slow.lookahead/ddm_av21.0"].needs == ("recordings/putnam.parquet",)


def test_a_calibrated_car_is_not_calibrated_again_by_the_training():
    steps = by_key(steps_of(load_plan(), None, {}))
    assert steps["models/slow.lookahead/dynssm_av21.0"].recipe()["model"]["physics"]["nominal"] == "calibrated"
    own = steps["models/lap_2.lookahead/dynssm_av21_paper.0"].recipe()
    calibrated = steps["models/lap_2.lookahead/dynssm_av21_paper_calibrated.0"].recipe()
    assert [each["model"]["physics"]["nominal"] for each in (own, calibrated)] == ["mid_range", "calibrated"]


def test_a_sweep_trains_one_model_at_each_rate_without_restarts():
    steps = by_key(steps_of(load_plan(), None, {}))
    rates = {key: step for key, step in steps.items() if key.startswith("rates/slow.lookahead/ddm_av21.")}
    settings = [step.recipe()["model"]["training"] for step in rates.values()]
    assert [each["learning_rate"] for each in settings] == list(load_plan().sweeps["ddm_av21"].rates)
    assert {each["restarts"] for each in settings} == {0}
    plain = steps["models/slow.lookahead/ddm_av21.0"].recipe()
    same = settings[1] | {"restarts": plain["model"]["training"]["restarts"]}
    assert plain["model"]["training"] == same


@pytest.mark.parametrize("name", load_plan().searches)
def test_a_search_trains_the_model_with_the_fields_of_each_try(name):
    plan = load_plan()
    search, steps = plan.searches[name], by_key(steps_of(plan, None, {}))
    own = steps[f"models/{search.split}.{search.commands}/{search.model}.0"].recipe()
    for attempt, other in search.tries.items():
        tried = steps[f"searches/{search.split}.{search.commands}/{search.model}.{attempt}.0"].recipe()
        assert tried | {"model": own["model"]} == own
        assert tried["model"] == merge(own["model"], other) != own["model"], attempt


def test_what_is_trained_on_decides_the_identity_of_a_training(plan):
    (step,) = (step for step in steps_of(plan, None, {}) if step.key == "models/club.topics/ridge_orca.0")
    strict = plan.models["ridge_orca"].model_copy(update={"change": {"history": 0.3, "penalty": 2.0}})
    changed = plan.model_copy(update={"models": plan.models | {"ridge_orca": strict}})
    (longer,) = (step for step in steps_of(changed, None, {}) if step.key == "models/club.topics/ridge_orca.0")
    assert step.recipe() != longer.recipe()
    assert json.loads(json.dumps(step.recipe())) == step.recipe()


def test_the_same_files_have_the_same_digest(tmp_path):
    for folder, content in (("a", "x"), ("b", "x"), ("c", "y")):
        (tmp_path / folder / "d").mkdir(parents=True)
        (tmp_path / folder / "d" / "f").write_text(content)
    assert digest(tmp_path / "a") == digest(tmp_path / "b") != digest(tmp_path / "c")


def test_a_log_that_is_not_there_is_unavailable(plan, tmp_path):
    step = by_key(steps_of(plan, tmp_path, {}))["recordings/away.parquet"]
    with pytest.raises(UnavailableError, match="nowhere is not in the data folder"):
        step.recipe()


@pytest.mark.slow
def test_the_small_run_measures_all_that_it_can(small_run):
    root, _, outcomes, results = small_run
    track, absent, given = results.comparisons
    assert track.tests == ("club b", "late")
    assert track.models == ("persistence", "single_track", "ridge_orca", "dynssm_orca")
    assert [track.seeds(model) for model in track.models] == [1, 1, 1, 2]
    assert {score["seed"] for score in track.entries("dynssm_orca")} == {0, 1}
    assert track.rmse("persistence")[0].mean > 0.0
    assert "scores/away.topics.json" not in {step.key for step in outcomes}
    assert absent.tests == given.planned == ()
    assert absent.reasons == ["extract away: nowhere is not in the data folder (--data or DYNSSM_DATA)"]
    assert results.missing == {"extract away": "nowhere is not in the data folder (--data or DYNSSM_DATA)"}
    assert set(results.costs) == {
        "persistence",
        "single_track",
        "single_track_ewma",
        "single_track_ekf",
        "ridge_orca",
        "dynssm_orca",
    }
    assert (
        results.costs["ridge_orca"]["parameters"]
        == open_artifact(root / "models/club.topics/ridge_orca.0").card.parameters
    )


@pytest.mark.slow
def test_calibration_starts_mid_range_and_finds_the_simulated_car(quick_run):
    root, results = quick_run
    vehicle, truth = load_vehicle(root / "vehicles/club.topics.yaml"), load_vehicle("orca")
    assert vehicle.coefficients["B_f"].nominal == pytest.approx(truth.coefficients["B_f"].nominal, rel=1e-3)
    assert results.comparisons[0].rmse("single_track")[0].mean < 1e-6
    assert results.comparisons[0].rmse("mid_range")[0].mean > 1e-3


@pytest.mark.slow
def test_a_test_part_is_scored_and_nothing_else(quick_run):
    root, results = quick_run
    track = results.comparisons[0]
    recording = Recording.load(root / "recordings/club.parquet")
    late = int(((recording.time - recording.time[0]) / 1e9 >= 6.0).sum())
    assert track.test("late")["rows"] == late - 15  # windows of 15 rows and the row to predict
    assert track.test("late")["horizon_s"] == 0.1


@pytest.mark.slow
def test_fine_tuning_goes_on_from_the_model_that_the_split_has_anyway(plan, tmp_path):
    """A planted mark in the first model's checkpoint comes out of the second's."""
    study = plan.studies["track"].model_copy(update={"models": ("fthd_orca_ddm", "fthd_orca"), "seeds": 1})
    short = plan.drives["club"].model_copy(update={"duration": 3.0})
    small = plan.model_copy(update={"studies": {"track": study}, "drives": plan.drives | {"club": short}})
    steps = by_key(steps_of(small, None, {}))
    ddm, fthd = (steps[f"models/club.topics/{name}.0"] for name in ("fthd_orca_ddm", "fthd_orca"))
    assert fthd.start == ddm.key
    steps["recordings/club.parquet"].make(tmp_path, frozenset())
    ddm.make(tmp_path, frozenset(ddm.needs))
    checkpoint = tmp_path / f"{ddm.key}.checkpoint.pt"
    content = torch.load(checkpoint, weights_only=True)
    content["history"]["train/prediction"] = [123.0]
    torch.save(content, checkpoint)
    fthd.make(tmp_path, frozenset((*fthd.needs, ddm.key)))
    metrics = json.loads((tmp_path / fthd.key / "metrics.json").read_text())
    assert metrics["start"]["history"]["train/prediction"] == [123.0]
