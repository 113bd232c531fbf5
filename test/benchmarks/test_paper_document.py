"""From results to the document: what is pooled, what is compared, what is said where something lacks."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.paper import document, tables
from benchmarks.paper.plan import Search, load_plan
from benchmarks.paper.reference import load_reference
from benchmarks.paper.results import Results
from benchmarks.paper.stale import NOTE, marked
from benchmarks.paper.summary import summary
from dynssm_ros.learning.losses import COMPONENTS
from dynssm_ros.vehicle import COEFFICIENTS

STATE_SIGNALS = ("v_x", "v_y", "omega")
SPLITS = {"slow": "slow to fast", "right": "right to left", "straight": "straight to corner"}
MODELS = (
    "persistence", "mid_range", "single_track", "ddm_av21", "dynssm_av21_paper", "dynssm_av21", "dynssm_av21_no_innovation",
    "dynssm_av21_no_online",
)  # fmt: skip
LEVELS = {
    "persistence": 1.0, "mid_range": 0.9, "single_track": 0.8, "ddm_av21": 0.6, "dynssm_av21_paper": 0.4, "dynssm_av21": 0.3,
    "dynssm_av21_no_innovation": 0.5, "dynssm_av21_no_online": 0.31,
}  # fmt: skip
UNTRAINED = ("persistence", "mid_range", "single_track")


def entry(rmse, seed=None, ade=0.1, coverage=None, theta=None):
    """What a score writes, with the same number for all states unless three are given."""
    rmse = np.broadcast_to(rmse, 3).tolist()
    mean, std = theta or (0.0, 0.0)
    statistics = {"mean": mean, "std": std, "bounds": [-1.0, 9.0], "at_bound": 0.25}
    return {
        "rmse": dict(zip(STATE_SIGNALS, rmse, strict=True)),
        "max_error": dict.fromkeys(STATE_SIGNALS, 3 * rmse[0]),
        "ade": ade,
        "fde": 2 * ade,
        "coverage_90": None if coverage is None else dict.fromkeys(STATE_SIGNALS, coverage),
        "coefficients": None if theta is None else dict.fromkeys(COEFFICIENTS, statistics),
        "seed": seed,
    }


def score(test, models):
    """The content of a step that evaluates one test."""
    about = {
        "rows": 100,
        "starts": 10,
        "duration_s": 9.0,
        "horizon_s": 0.6,
        "persistence_rmse": dict.fromkeys(STATE_SIGNALS, 1.0),
    }
    return {"tests": {test: about | {"models": models}}}


def seeds_of(model):
    return (None,) if model in UNTRAINED else (0,) if model == "ddm_av21" else (0, 1, 2)


@pytest.fixture
def scores():
    """Scores of one study on three splits; errors grow by a hundredth with the seed."""
    return {
        f"scores/{split}.lookahead.json": score(
            test,
            {
                model: [
                    entry(
                        level * (1 + 0.01 * (seed or 0)), seed, coverage=None if seed is None else 0.9, theta=(4.0, 0.5)
                    )
                    for seed in seeds_of(model)
                ]
                for model, level in LEVELS.items()
            },
        )
        for split, test in SPLITS.items()
    }


@pytest.fixture
def make(scores):
    """Results of the study ``unseen`` alone; keywords replace parts."""
    plan = load_plan()
    study = plan.studies["unseen"].model_copy(update={"models": MODELS, "splits": tuple(SPLITS)})
    right = plan.splits["right"]
    third = right.model_copy(update={"test": {SPLITS["straight"]: next(iter(right.test.values()))}})
    seeds = {
        name: model.model_copy(update={"seeds": 1 if name == "ddm_av21" else None})
        for name, model in plan.models.items()
    }
    cars = {name: car.model_copy(update={"coefficients": "unseen"}) for name, car in plan.cars.items()}
    plan = plan.model_copy(
        update={
            "studies": {"unseen": study},
            "cars": cars,
            "models": seeds,
            "splits": plan.splits | {"straight": third},
        }
    )
    cost = {"parameters": 10, "flops": 20, "latency_us": {"p50": 5.0, "p99": 6.0}, "integrator": "euler", "substeps": 1}

    def results(**changes):
        parts = {
            "plan": plan, "reference": load_reference(), "scores": scores, "races": {}, "rates": {}, "tries": {},
            "losses": {}, "networks": {}, "costs": dict.fromkeys(MODELS, cost),
            "missing": {}, "reasons": {}, "made": "Made: today",
        }  # fmt: skip
        return Results(**parts | changes)

    return results


def cells(table, first):
    """The row of a table that begins with ``first``, as shown."""
    (row,) = (row for row in table.cells if row[0].text == first)
    return [cell.text for cell in row[1:]]


def test_tests_are_pooled_by_kind_and_seeds_give_the_spread(make, scores):
    scores["scores/slow.lookahead.json"] = score("slow to fast", {"dynssm_av21": [
        entry((0.1, 0.2, 0.3), seed, ade=0.7) for seed in (0, 1, 2)]})  # fmt: skip
    (comparison,) = make().comparisons
    expected = [np.sqrt((first**2 + 2 * (0.3 * 1.01**0) ** 2) / 3) for first in (0.1, 0.2, 0.3)]
    per_seed = np.array([
        [np.sqrt((first**2 + 2 * (0.3 * (1 + 0.01 * seed)) ** 2) / 3) for first in (0.1, 0.2, 0.3)] for seed in (0, 1, 2)
    ])  # fmt: skip
    found = comparison.rmse("dynssm_av21")
    np.testing.assert_allclose(per_seed[0], expected)
    np.testing.assert_allclose([each.mean for each in found], per_seed.mean(axis=0))
    np.testing.assert_allclose([each.std for each in found], per_seed.std(axis=0, ddof=1))
    assert comparison.max_error("dynssm_av21")[0].mean == pytest.approx(3 * 0.3 * 1.01)
    assert [each.mean for each in comparison.displacement("dynssm_av21")] == pytest.approx([0.3, 0.6])


def test_a_model_appears_only_with_results_on_every_test(make, scores):
    models = scores["scores/right.lookahead.json"]["tests"]["right to left"]["models"]
    del models["ddm_av21"]
    models["dynssm_av21"] = models["dynssm_av21"][:1]
    (comparison,) = make().comparisons
    assert "ddm_av21" not in comparison.models
    assert comparison.seeds("dynssm_av21") == 1
    assert comparison.seeds("dynssm_av21_no_innovation") == 3


def test_ablations_are_told_from_the_paper_s_configuration(make, scores):
    for content in scores.values():
        for test in content["tests"].values():
            test["models"]["dynssm_av21_paper_no_ssm"] = [entry(0.45, s) for s in (0, 1, 2)]
    results = make()
    study = results.plan.studies["unseen"]
    study = study.model_copy(update={"models": (*MODELS, "dynssm_av21_paper_no_ssm")})
    (comparison,) = make(plan=results.plan.model_copy(update={"studies": {"unseen": study}})).comparisons
    assert comparison.ablations("dynssm_av21") == {
        "no_innovation": "dynssm_av21_no_innovation", "no_online": "dynssm_av21_no_online"
    }  # fmt: skip
    assert comparison.ablations("dynssm_av21_paper") == {"no_ssm": "dynssm_av21_paper_no_ssm"}
    assert comparison.bases == ("dynssm_av21_paper", "dynssm_av21")
    assert comparison.compared == (
        "persistence",
        "mid_range",
        "single_track",
        "ddm_av21",
        "dynssm_av21_paper",
        "dynssm_av21",
    )
    table = tables.ablation_table(comparison, results, "dynssm_av21_paper")
    assert cells(table, "w/o SSM encoder")[:2] == ["0.450 ± 0.000", "0.0286"]
    assert cells(table, "w/o SSM encoder")[7:12:2] == ["79,500", "139,800", "2,000"]


def test_relative_errors_are_those_over_persistence_test_by_test(make, scores):
    scores["scores/slow.lookahead.json"]["tests"]["slow to fast"]["persistence_rmse"] = dict.fromkeys(
        STATE_SIGNALS, 0.5
    )
    (comparison,) = make().comparisons
    table = tables.relative_table(comparison)
    assert cells(table, "`ddm_av21`") == ["1.20"] * 3 + ["0.600"] * 6
    assert [column.full_heading for column in table.columns[1:4]] == [f"slow to fast: {c}" for c in ("v_x", "v_y", "ω")]


def test_reductions_are_shares_of_the_errors_of_ddm(make):
    results = make()
    table = tables.reduction_table(results.comparisons, results.reference, "real")
    assert cells(table, "`dynssm_av21`")[1:] == ["49.5"] * 3 + ["0.00"] * 2  # 1 - 0.303 / 0.6
    assert cells(table, "DynSSM, the paper's table")[1:] == ["27.2", "73.9", "53.7", "2.58", "18.5"]
    assert cells(table, "DynSSM, the paper's abstract: up to, over DDM or FTHD")[1:4] == ["27.2", "73.9", "88.8"]


def test_the_paper_s_model_is_told_what_it_misses(make):
    results = make()
    plain = tables.paper_model_table(results.comparisons[0])
    assert plain is not None
    assert cells(plain, "v_x") == ["0.404", "0.673", "yes"]
    assert cells(plain, "ADE") == ["0.100", "1.00", "no: `ddm_av21`"]
    study = results.plan.studies["unseen"].model_copy(update={"wanted": {"v_x": 0.4, "omega": 0.5}})
    (other,) = make(plan=results.plan.model_copy(update={"studies": {"unseen": study}})).comparisons
    wanted = tables.paper_model_table(other)
    assert wanted is not None
    assert cells(wanted, "v_x") == ["0.404", "0.400", "0.673", "no: what is wanted"]
    assert cells(wanted, "ω") == ["0.404", "0.500", "0.673", "yes"]


def test_the_paper_s_numbers_stand_beside_and_are_never_the_best(make):
    results = make()
    table = tables.ablation_table(results.comparisons[0], results, "dynssm_av21")
    assert cells(table, "full model") == ["0.303 ± 0.003"] * 3 + ["10", "20", "5.00"]
    assert cells(table, "physics only, calibrated")[0] == "0.800"
    best = {(row[0].text, k) for row in table.cells for k, cell in enumerate(row) if cell.best}
    assert best == {("full model", 1), ("full model", 2), ("full model", 3)}
    theirs = tables.ablation_table(results.comparisons[0], results, "dynssm_av21_paper")
    assert cells(theirs, "physics only, calibrated")[:2] == ["0.800", "–"]
    assert cells(theirs, "physics only, θ_0 in the middle of the bounds")[:2] == ["0.900", "0.0350"]
    published = tables.published_table(results.comparisons, results.reference["open_loop"]["real"])
    assert cells(published, "FTHD, the paper's")[1:4] == ["0.0270", "0.938", "0.0338"]
    assert not any(cell.best for row in published.cells for cell in row)


@pytest.mark.parametrize(
    ("level", "sentence"),
    [
        (0.31, "No ablation is better than the full model beyond the spread over seeds."),
        (0.2995, "No ablation is better than the full model beyond the spread over seeds."),
        (0.20, "Better than the full model beyond the spread over seeds: w/o online layer in v_x by 33.3 %, "
               "w/o online layer in v_y by 33.3 %, w/o online layer in ω by 33.3 %."),
    ],
)  # fmt: skip
def test_an_ablation_that_beats_the_full_model_is_named(make, scores, level, sentence):
    for content in scores.values():
        for test in content["tests"].values():
            test["models"]["dynssm_av21_no_online"] = [entry(level * (1 + 0.01 * s), s) for s in (0, 1, 2)]
    (comparison,) = make().comparisons
    assert tables.better_ablations(comparison, "dynssm_av21") == sentence


@pytest.mark.parametrize(("level", "named"), [(0.2995, False), (0.25, True)])
def test_a_variant_that_was_trained_once_is_taken_to_vary_as_the_full_model_does(make, scores, level, named):
    for content in scores.values():
        for test in content["tests"].values():
            test["models"]["dynssm_av21_no_online"] = [entry(level, 0)]
    assert ("w/o online layer" in tables.better_ablations(make().comparisons[0], "dynssm_av21")) == named


def test_one_training_of_the_full_model_says_nothing_about_the_spread(make, scores):
    for content in scores.values():
        for test in content["tests"].values():
            test["models"]["dynssm_av21"] = [entry(0.3, 0)]
    assert "not known" in tables.better_ablations(make().comparisons[0], "dynssm_av21")


def test_coefficients_are_pooled_with_the_spread_between_trainings(make, scores):
    for content in scores.values():
        for test in content["tests"].values():
            test["models"]["dynssm_av21"] = [entry(0.3, s, theta=(4.0 + s, 0.5)) for s in (0, 1, 2)]
    results = make()
    table = tables.coefficient_table(results.comparisons[0], results)
    assert cells(table, "C_f")[:2] == ["0.5 … 2", "0.730 ± 0.260"]
    assert cells(table, "C_f")[-3:] == ["-1 … 9", "5.00 ± 0.957", "25.0"]  # sqrt(0.25 + 2 / 3)
    assert cells(table, "C_m1 (N)")[:2] == ["–", "–"]


def test_models_without_coefficients_have_no_coefficient_table(make, scores):
    for content in scores.values():
        for test in content["tests"].values():
            for model in ("dynssm_av21", "dynssm_av21_paper"):
                test["models"][model] = [entry(0.3, 0)]
    results = make()
    assert tables.coefficient_table(results.comparisons[0], results) is None


def test_coverage_is_in_percent_and_the_cost_leaves_ablations_out(make):
    results = make()
    assert tables.coverage_table(results.comparisons).rows[1][2].mean == pytest.approx(90.0)
    names = [row[0] for row in tables.cost_table(results).rows]
    assert "`dynssm_av21`" in names
    assert "`dynssm_av21_no_innovation`" not in names
    assert cells(tables.cost_table(results), "DynSSM, AV-21, the paper's")[:3] == ["81,000", "180,000", "2,000"]


def test_values_that_are_not_numbers_are_dashes(make, scores):
    for content in scores.values():
        for test in content["tests"].values():
            broken = entry(0.6, 0)
            broken["rmse"], broken["fde"] = dict.fromkeys(STATE_SIGNALS), None
            test["models"]["ddm_av21"] = [broken]
    results = make()
    (comparison,) = results.comparisons
    assert cells(tables.error_table(comparison), "`ddm_av21`") == ["–", "–", "–", "0.100", "–"]
    assert cells(tables.reduction_table([comparison], results.reference, "real"), "`dynssm_av21`")[1:4] == ["–"] * 3
    assert "ddm_av21" in document.markdown(results, {})


def test_the_document_has_every_section_and_shows_its_figures(make, tmp_path):
    path = tmp_path / "docs" / "results.md"
    document.write(make(), path)
    text = path.read_text()
    assert re.findall(r"^#+ (.+)$", text, flags=re.M) == [
        "Results", "In short", "How it was measured", "Full-size car",
        "Against the published models", "Unseen driving, commands `lookahead`",
        "Coefficients", "Stated uncertainty", "Suspect figures of the paper", "Cost",
    ]  # fmt: skip
    shown = set(re.findall(r"!\[[^\]]+\]\(([^)]+)\)", text))
    assert shown == {"results_persistence.png", "results_ablations_unseen_dynssm_av21.png"}
    assert {file.name for file in path.parent.iterdir()} == {"results.md", *shown}
    for line in text.splitlines():
        assert line == line.rstrip()


def test_what_lacks_is_said_and_the_rest_is_there(make, scores):
    key = "scores/right.lookahead.json"
    del scores[key]
    reason = "extract putnam: no such log"
    text = document.markdown(make(missing={"extract putnam": "no such log"}, reasons={key: reason}), {})
    assert "> - extract putnam: no such log" in text
    assert f"*unseen driving, lookahead*: measured in part; {reason}." in text
    assert "slow to fast: v_x" in text
    assert "right to left" not in text
    nothing = document.markdown(make(scores={}, costs={}, reasons=dict.fromkeys((*scores, key), reason)), {})
    assert f"not measured; {reason}." in nothing
    assert "|" not in nothing


def test_a_study_of_given_recordings_asks_for_them(make):
    plan = load_plan()
    plan = plan.model_copy(update={"studies": {"track": plan.studies["track"]}})
    text = document.markdown(make(plan=plan, scores={}), {})
    assert (
        "*another track, lookahead*: not measured, no recording was given with `test=NAME=R.parquet`. The paper's"
        in text
    )
    assert 'ARGS="test=LVMS=lvms.parquet"' in text


def test_persistence_with_lower_errors_than_the_paper_s_model_is_a_suspect_figure(make, scores):
    plan = load_plan().with_tests({"LVMS": 0.04})
    study = plan.studies["track"].model_copy(update={"models": ("persistence",)})
    plan = plan.model_copy(update={"studies": {"track": study}})
    found = score("LVMS", {"persistence": [entry(0.01)]})
    found["tests"]["LVMS"]["persistence_rmse"] = {"v_x": 0.05, "v_y": 0.007, "omega": 0.009}
    text = document.markdown(make(plan=plan, scores={"scores/whole.lookahead.json": found}), {})
    assert (
        "- DynSSM, full-size car: on LVMS (another track, lookahead) predicting that nothing changes has lower errors than "
        "the paper's model in v_y (0.007, 0.019)." in text
    )
    assert "predicting that nothing changes" not in document.markdown(make(), {})


def test_quick_runs_say_so(make):
    assert "Not results" not in document.markdown(make(), {})
    assert "**Not results:** a quick run" in document.markdown(make(quick=True), {})


def short(results):
    """The first half page as text."""
    found = summary(results)
    return "\n".join([found["table"], *found["lines"]])


def test_the_first_half_page_says_how_often_the_network_earned_its_place(make):
    text = short(make(networks={"dynssm_av21": (2, 9), "dynssm_orca": (0, 3)}))
    assert "It did in 2 of 9 (`dynssm_av21`), 0 of 3 (`dynssm_orca`) trainings." in text
    assert "trainings." not in short(make())


def test_errors_that_are_but_roundings_are_equal(make, scores):
    for content in scores.values():
        for test in content["tests"].values():
            test["models"]["single_track"] = [entry(1e-13, ade=1e-13)]
            test["models"]["dynssm_av21"] = [entry(1e-9, 0, ade=1e-9)]
            test["models"]["ddm_av21"] = [entry(1e-3, 0, ade=1e-3)]
    text = short(make())
    assert "No rival wins by more than 2 % in any study." in text
    (row,) = (line for line in text.splitlines() if line.startswith("| unseen driving, lookahead"))
    cells = [cell.strip() for cell in row.split("|")]
    assert cells[4] == cells[6] == "1.00"
    assert cells[8] == "0.0100"


def test_the_first_half_page_says_what_helps_and_where_a_rival_wins(make, scores):
    for content in scores.values():
        for test in content["tests"].values():
            test["models"]["ddm_av21"] = [entry(0.6, 0, ade=0.05)]
    text = short(make())
    row = next(line for line in text.splitlines() if line.startswith("| unseen driving, lookahead"))
    assert [cell.strip() for cell in row.split("|")[2:-1]] == [
        "development", "`single_track`", "0.379", "`persistence`", "1.00",
        "`dynssm_av21_paper`", "0.750", "`ddm_av21`", "2.00",
    ]  # fmt: skip
    assert (
        "A rival wins by more than 2 % in: unseen driving, lookahead, path: `ddm_av21`, our errors are 100 % larger."
        in text
    )
    assert (
        "`dynssm_av21` on unseen driving, lookahead, errors without its parts: w/o innovation filter +67 % one step"
        in text
    )
    assert summary(make(scores={})) is None


def test_the_terms_of_the_loss_are_a_figure(make, tmp_path):
    history = {f"{part}/{term}": [2.0, 1.0] for part in ("train", "validation") for term in COMPONENTS}
    results = make(losses={"dynssm_av21_paper": {"history": history, "best_epoch": 2}})
    document.write(results, tmp_path / "results.md")
    assert "](results_losses_dynssm_av21_paper.png)" in (tmp_path / "results.md").read_text()
    assert (tmp_path / "results_losses_dynssm_av21_paper.png").stat().st_size > 1000


def test_learning_rates_that_were_tried_are_shown_with_the_chosen_one(make, tmp_path):
    found = {"history": {"validation/prediction": [3.0, 1.0, 2.0]}, "best_epoch": 2, "unexplained": 0.25}
    results = make(rates={"ddm_av21": {0.001: [found], 0.004: [found | {"unexplained": each} for each in (1.0, 2.0)]}})
    rows = tables.rate_table(results).cells
    assert [[cell.text for cell in row] for row in rows] == [
        ["`ddm_av21`", "slow", "0.001", "1.00", "0.250", "2", "yes"],
        ["`ddm_av21`", "slow", "0.004", "1.00 ± 0.00", "1.50 ± 0.71", "2, 2", ""],
    ]  # fmt: skip
    document.write(results, tmp_path / "results.md")
    assert "](results_rates.png)" in (tmp_path / "results.md").read_text()
    assert (tmp_path / "results_rates.png").stat().st_size > 1000


def test_settings_that_were_tried_are_shown_below_the_model_as_it_is(make):
    weak = {"loss": {"parameters": 1e-5}, "training": {"batch_size": 64}}
    search = Search(split="ethz", commands="topics", model="dynssm_orca_paper", tries={"weak": weak})
    rmse = dict(zip(STATE_SIGNALS, (0.1, 0.2, 0.3), strict=True))
    found = {"history": {"validation/prediction": [3.0, 1.0, 2.0]}, "best_epoch": 2, "validation_rmse": rmse}
    results = make(tries={"orca": {"": [found], "weak": [found | {"best_epoch": 3}, found]}})
    results = replace(results, plan=results.plan.model_copy(update={"searches": {"orca": search}}))
    assert [[cell.text for cell in row] for row in tables.search_table(results).cells] == [
        ["`dynssm_orca_paper`", "ethz", "–", "1.00", "0.100", "0.200", "0.300", "2"],
        ["`dynssm_orca_paper`", "ethz", "loss.parameters 1e-05, training.batch_size 64", *["1.00 ± 0.00"],
         "0.100 ± 0.000", "0.200 ± 0.000", "0.300 ± 0.000", "3, 2"],
    ]  # fmt: skip
    assert "loss.parameters 1e-05" in document.markdown(results, {})


def test_a_page_is_marked_stale_as_soon_as_a_setting_changes(make, tmp_path):
    results = make()
    document.write(results, tmp_path / "results.md")
    page = (tmp_path / "results.md").read_text()
    assert marked(page, results.plan) == page
    changed = results.plan.models["dynssm_av21"].model_copy(update={"change": {"history": 0.8}})
    other = results.plan.model_copy(update={"models": results.plan.models | {"dynssm_av21": changed}})
    stale = marked(page, other)
    assert stale.startswith(f"# Results\n\n{NOTE}\n\n")
    assert marked(stale, other) == stale
    assert marked(stale, results.plan) == page
