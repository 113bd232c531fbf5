"""Several seeds of one model become one row; everything else stays a row of its own."""

from __future__ import annotations

import shutil

import numpy as np
import pytest
import yaml

from dynssm_ros.evaluation.open_loop import evaluate
from dynssm_ros.evaluation.score import grouped
from dynssm_ros.reporting.evaluation_report import coefficient_table, markdown, summary_table, verdict
from dynssm_ros.runtime.baselines import Persistence
from dynssm_ros.runtime.registry import load_model
from dynssm_ros.signals.extraction import extract
from dynssm_ros.signals.signal_map import load_signal_map


@pytest.fixture(scope="module")
def recording(laps_bag):
    return extract([laps_bag], load_signal_map("default"), 50.0).select(slice(0, 300))


@pytest.fixture
def trained(small_model, tmp_path):
    """Opens the small model as if it had been trained with another seed or recipe, and adapted and erred otherwise."""

    def train(seed, bias=0.0, **recipe):
        folder = shutil.copytree(small_model, tmp_path / f"run{len(list(tmp_path.iterdir()))}")
        card = yaml.safe_load((folder / "model.yaml").read_text())
        card["training"]["seed"] = card["architecture"]["training"]["seed"] = seed
        card["architecture"]["training"] |= recipe
        (folder / "model.yaml").write_text(yaml.safe_dump(card))
        model = load_model(folder)
        plain, car = model.predict, model.vehicle

        def predict(windows):
            place = 0.5 + 0.4 * np.sin(10 * windows[:, -1, :1])
            theta = car.lower + place * (car.upper - car.lower)
            return plain(windows)._replace(state=plain(windows).state + bias, theta=theta)

        model.predict = predict
        return model

    return train


def score(recording, models):
    return evaluate(recording, models, calls=3)


def test_folders_of_one_model_with_several_seeds_are_one_group(recording, trained):
    evaluation = score(recording, {"a": trained(0), "still": Persistence(), "b": trained(7)})
    assert list(evaluation.groups) == ["small", "still"]
    assert evaluation.groups["small"].seeds == [0, 7]
    assert evaluation.groups["small"].first is evaluation.scores["a"]
    assert evaluation.groups["still"].seeds == []


def test_one_folder_keeps_the_label_that_it_was_given(recording, trained):
    assert list(score(recording, {"mine": trained(3)}).groups) == ["mine"]


@pytest.mark.parametrize(
    ("one", "other"),
    [({"seed": 0}, {"seed": 0}), ({"seed": 0}, {"seed": 1, "epochs": 99})],
    ids=["same seed", "another recipe"],
)
def test_folders_that_differ_by_more_or_less_than_the_seed_stay_apart(recording, trained, one, other):
    assert list(score(recording, {"a": trained(**one), "b": trained(**other)}).groups) == ["a", "b"]


def test_seeds_that_a_recipe_starts_from_are_seeds_too(recording, trained):
    models = {"a": trained(0, start={"seed": 0}), "b": trained(1, start={"seed": 1})}
    assert list(score(recording, models).groups) == ["small"]


def test_baselines_are_never_joined(recording):
    assert list(score(recording, {"a": Persistence(), "b": Persistence()}).groups) == ["a", "b"]


def test_a_group_states_mean_and_sample_standard_deviation(recording, trained):
    biases = (0.0, 0.1, 0.4)
    evaluation = score(recording, {f"run {k}": trained(k, bias) for k, bias in enumerate(biases)})
    alone = [single.rmse for single in evaluation.scores.values()]
    group = evaluation.groups["small"]
    np.testing.assert_allclose(group.mean(lambda each: each.rmse), np.mean(alone, axis=0))
    np.testing.assert_allclose(group.std(lambda each: each.rmse), np.std(alone, axis=0, ddof=1))
    entry = evaluation.to_json()["models"]["small"]
    assert entry["rmse"]["v_x"] == pytest.approx(np.mean(alone, axis=0)[0])
    assert entry["std"]["rmse"]["v_x"] == pytest.approx(np.std(alone, axis=0, ddof=1)[0])
    assert entry["seeds"] == [0, 1, 2]
    assert entry["parameters"] == group.first.model.parameters
    assert entry["coefficients"]["B_f"] == group.first.coefficients.to_json()["B_f"]  # the same in all three
    assert (
        entry["regimes"]["speed"].keys()
        == evaluation.scores["run 0"].to_json(evaluation.regimes)["regimes"]["speed"].keys()
    )


def test_a_seed_that_diverges_leaves_no_mean(recording, trained):
    entry = score(recording, {"a": trained(0), "b": trained(1, np.nan)}).to_json()["models"]["small"]
    assert entry["rmse"]["v_x"] is None
    assert entry["std"]["ade"] is None


def test_tables_show_mean_spread_and_number_of_seeds(recording, trained):
    evaluation = score(recording, {"a": trained(0), "b": trained(1, 0.1), "still": Persistence()})
    table = summary_table(evaluation)
    small, still = table.cells
    assert small[0].text == "small"
    assert all(cell.spread.startswith("± ") for cell in small[1:9])
    assert not any(cell.spread for cell in still)
    assert "small: n = 2, seeds 0, 1" in table.caption
    assert f"{small[1].value} ± " in markdown(evaluation)
    assert [len(row) for row in coefficient_table(evaluation.groups["small"]).rows] == [9] * 17
    assert coefficient_table(evaluation.groups["still"]) is None
    assert verdict(evaluation).startswith("Best path over ")
    assert "Predicted best one step ahead: v_x by " in verdict(evaluation)


def test_grouping_keeps_the_order_of_first_appearance(recording, trained):
    scores = score(recording, {"p": Persistence(), "a": trained(0), "q": Persistence(), "b": trained(1)}).scores
    assert list(grouped(scores)) == ["p", "small", "q"]
