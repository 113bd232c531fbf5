"""The generalisation matrix: its cells, their split, ratios and page; one cell from laps to scores."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.matrix import ablations
from benchmarks.matrix import scored_cells as of_cells
from benchmarks.matrix.scored_cells import CARS, CHANGES, NOISE_LEVELS, PLANTS, Cell, Training, simulated_cells
from benchmarks.matrix.scores import (
    ABLATIONS,
    BASELINES,
    RIVALS,
    drive,
    model_folder,
    models_of,
    read_cell,
    score_cell,
    train_model,
)
from benchmarks.matrix.scores_page import errors, generalisation_page, heat_map, ratios, summary
from dynssm_ros.learning.models.registry import load_model_config

HERE = Path()


def scores(**levels):
    """Scores of a cell in which every model has one level of error."""
    return {
        "scores": {
            name: {"rmse": [level, 2 * level, 3 * level], "ade": level, "fde": level, "coverage": [0.9, 0.9, 0.9]}
            for name, level in levels.items()
        },
        "network_gain": {"dynssm": 0.02},
        "rows": 100,
    }


def test_every_combination_is_a_cell_and_names_are_unique():
    every = list(simulated_cells())
    assert len(every) == len(CARS) * len(PLANTS) * len(NOISE_LEVELS) * len(CHANGES)
    assert len({cell.name for cell in every}) == len(every)


def test_the_split_hangs_on_the_name_alone_and_is_about_even():
    every = list(simulated_cells())
    again = {cell.name: cell.is_test for cell in simulated_cells()}
    assert all(again[cell.name] == cell.is_test for cell in reversed(every))
    assert 0.35 < np.mean([cell.is_test for cell in every]) < 0.65


def test_of_real_logs_those_that_are_marked_are_test_cells():
    measured = list(of_cells.measured_cells())
    assert {cell.change for cell in measured if cell.is_test} == {
        "free_driving_1027", "circles_right_03_ramp_1653", "tape_and_tiles_right_03_ramp_1758",
    }  # fmt: skip
    trained = {log[0] for cell in measured for log in cell.training.logs}
    assert not trained & {cell.change for cell in measured if cell.is_test}


def test_no_measured_cell_shares_a_row_with_its_training():
    for cell in of_cells.measured_cells():
        for name, start, end in cell.logs:
            for other, begins, ends in cell.training.logs:
                assert other != name or end <= begins or ends <= start, cell.name


def test_ablations_are_model_files():
    for content in ABLATIONS.values():
        overrides = {key: value for key, value in content.items() if key != "base"}
        assert load_model_config(content["base"], overrides).name == content["base"]


def test_rivals_are_model_files_for_both_sizes_of_cars():
    for name, content in RIVALS.items():
        for size in ("orca", "av21"):
            assert load_model_config(content["base"].format(size=size)).name in (name, f"{name}_{size}")


def test_sets_are_of_different_models():
    assert set(models_of(["shipped"])) < set(models_of(["shipped", "ablations"]))


def test_ratios_are_to_the_best_baseline_of_each_quantity():
    content = scores(persistence=4.0, single_track=3.0, single_track_ewma=2.0, ridge=2.5, rls=1.0, dynssm=0.5)
    np.testing.assert_allclose(ratios(content, "dynssm"), 0.5)
    np.testing.assert_allclose(ratios(content, "dynssm", ("rls",)), 0.25)
    np.testing.assert_allclose(errors(content, "dynssm"), [0.5, 1.0, 1.5, 0.5, 0.5])
    exact = scores(**dict.fromkeys(BASELINES, 1e-9), dynssm=1e-7)
    assert np.isnan(ratios(exact, "dynssm")).all()


def test_the_page_has_means_worst_cells_and_exact_cells():
    training = Training("orca-euler-exact", "orca", ("orca", "euler", "exact"))
    usual = dict.fromkeys(BASELINES, 1.0)
    known = {
        Cell(training, "a"): scores(**usual, dynssm=0.5),
        Cell(training, "b"): scores(**usual, dynssm=2.0),
        Cell(training, "c"): scores(**dict.fromkeys(BASELINES, 1e-9), dynssm=1e-7),
    }
    known = {replace(cell, marked=False): content for cell, content in known.items()}
    content = summary(known)
    parts = [content[name] for name in ("development", "test") if content[name]["cells"]]
    assert sum(part["cells"] for part in parts) == 3
    text = generalisation_page(known, ["part=all"], "generalisation.png", 2)
    assert "dodo.py group=generalisation part=all`" in text
    assert "2 cells are missing" in text
    assert "![Heat map" in text
    assert len(heat_map(known).axes[0].get_yticklabels()) == 3


def test_the_page_says_how_near_the_noise_of_the_sensors_the_errors_are():
    training = Training("orca-euler-three", "orca", ("orca", "euler", "three"))
    known = {Cell(training, "a"): scores(**dict.fromkeys(BASELINES, 0.06), dynssm=0.03)}
    assert next(iter(known)).noise == pytest.approx((0.03, 0.03, 0.09))
    (part,) = (part for part in summary(known).values() if part["cells"])
    np.testing.assert_allclose(part["models"]["dynssm"]["over_noise"], [1.0, 2.0, 1.0])
    assert "1.00, 2.00, 1.00 (`dynssm`)" in generalisation_page(known, [], "x.png", 0)
    assert Cell(Training("dart-free", "racer"), "circles").noise is None


@pytest.mark.slow
def test_a_cell_from_laps_to_scores(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    short = {"orca": replace(CARS["orca"], seconds=(20.0, 6.0))}
    monkeypatch.setattr(of_cells, "CARS", short)
    monkeypatch.setattr("benchmarks.matrix.scores.MODELS", {name: {"base": name} for name in ("rls", "ridge")})
    training = Training("orca-euler-usual", "orca", ("orca", "euler", "usual"))
    drive(training, tmp_path, HERE)
    for name in ("rls", "ridge"):
        train_model(training, name, tmp_path)
        assert (model_folder(training, name, tmp_path) / "model.yaml").is_file()
    monkeypatch.setattr("benchmarks.matrix.scores.models_of", lambda _: {"rls": {}, "ridge": {}})
    cell = Cell(training, "steering")
    score_cell(cell, tmp_path, HERE, ["shipped"])
    content = read_cell(cell, tmp_path)
    assert content is not None
    assert set(content["scores"]) == {*BASELINES, "rls (offline)"}
    assert np.all(errors(content, "rls") < errors(content, "single_track"))


def of_models(**levels):
    """Scores of a cell: one-step errors of one level, and the square of it along the path."""
    return {
        "scores": {name: {"rmse": [e, e, e], "ade": e * e, "fde": e, "coverage": None} for name, e in levels.items()}
    }


def test_a_part_earns_what_errors_grow_without_it():
    part = ablations.Part("network", "full", "less")
    one, other = list(simulated_cells())[:2]
    found = ablations.earned({one: of_models(full=1.0, less=2.0), other: of_models(full=1.0, less=0.5)}, part)
    assert found == (pytest.approx(1.0), pytest.approx(1.0), 2)
    assert not found.earns
    found = ablations.earned({one: of_models(full=1.0, less=1.1), other: of_models(third=1.0)}, part)
    assert found == (pytest.approx(1.1), pytest.approx(1.21), 1)
    assert found.earns
    assert ablations.earned({one: of_models(third=1.0)}, part) is None
    exact = ablations.earned({one: of_models(full=1e-9, less=1e-7)}, part)
    assert exact[:2] == (1.0, 1.0), "no ratio where both are exact"


def test_every_ablation_has_a_row_on_its_page():
    shown = {name for part in ablations.PARTS for name in part[1:]}
    assert set(ABLATIONS) <= shown
    known = {cell: of_models(**dict.fromkeys(shown, 1.0)) for cell in simulated_cells()}
    text = ablations.ablations_page(known, ["part=all", "sets=shipped,ablations"])
    assert text.count("| 1.000 | 1.000 | 1.000 | 1.000 | no |") == len(ablations.PARTS)
    assert "dodo.py group=generalisation part=all sets=shipped,ablations`" in text
