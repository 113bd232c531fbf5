"""Races of the plan: driven as planned, and told of with the paper's numbers beside."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest
import yaml

from benchmarks.paper.figures import lap_over_speed_scale
from benchmarks.paper.plan import load_plan
from benchmarks.paper.race_document import claimed, write_races
from benchmarks.paper.racing import NUMBERS
from benchmarks.paper.results import read_results
from benchmarks.paper.schedule import race_key, steps_of
from dynssm_ros.errors import ConfigurationError
from dynssm_ros.vehicle import load_vehicle, save_vehicle

RACE = {
    "title": "A lap",
    "text": "T.",
    "track": "club",
    "models": ("true", "single_track"),
    "figures": ("coefficients",),
}


@pytest.fixture(scope="module")
def plan():
    """The shipped plan with one short race."""
    shipped = load_plan()
    race = shipped.races["ethz_mobil"].model_copy(update=RACE)
    return shipped.model_copy(update={"races": {"lap": race}})


@pytest.fixture(scope="module")
def root(plan, tmp_path_factory):
    """A run in which nothing but the calibration and the race is done."""
    folder = tmp_path_factory.mktemp("run")
    step = race_step(plan)
    save_vehicle(load_vehicle("orca"), folder / step.calibrated, "The car itself.")
    step.make(folder, frozenset())
    return folder


def race_step(plan):
    return next(step for step in steps_of(plan, None, {}) if step.key == race_key("lap"))


def document(plan, root, path):
    results = read_results(plan, root, steps_of(plan, None, {}))
    write_races(results, root, path)
    return path.read_text()


@pytest.mark.slow
def test_models_without_training_drive_and_those_that_are_not_there_are_left_out(plan, root):
    driven = json.loads((root / race_key("lap") / NUMBERS).read_text())
    assert list(driven["models"]) == ["true", "single_track"]
    assert driven["models"]["true"]["completed"]
    assert driven["models"]["true"]["lap_time_s"] == pytest.approx(driven["line_lap_time_s"], rel=0.05)
    # the calibrated car is the car itself here, so both drive alike but for the integrator
    assert driven["models"]["single_track"]["lap_time_s"] == pytest.approx(
        driven["models"]["true"]["lap_time_s"], rel=0.01
    )
    assert (root / race_key("lap") / "coefficients.png").stat().st_size > 10_000


def test_the_document_sets_the_papers_rows_beside(plan, root, tmp_path):
    text = document(plan, root, tmp_path / "results_race.md")
    rows = [line.split(" | ") for line in text.splitlines() if line.startswith("| ")]
    assert ["| DynSSM, the paper's", "4.880"] in [row[:2] for row in rows]
    assert any(row[0] == "| the plant's own model" for row in rows)
    assert "Lap time against the plant's own model: `single_track`" in text
    assert (tmp_path / "results_race_lap_coefficients.png").is_file()
    assert "](results_race_lap_coefficients.png)" in text


def test_races_that_differ_in_their_pace_make_a_figure_together(plan, root, tmp_path):
    """Three of them do, two do not; the published times are those of the race that has them beside."""
    lap = plan.races["lap"]
    laps = {f"lap_{k}": lap.model_copy(update={"speed_scale": 0.8 + k / 10, "paper": None}) for k in range(3)}
    laps["lap_0"] = laps["lap_0"].model_copy(update={"paper": "ETHZMobil", "title": "The first"})
    driven = json.loads((root / race_key("lap") / NUMBERS).read_text())
    for k, name in enumerate(laps):
        (tmp_path / race_key(name)).mkdir(parents=True)
        driven["models"]["single_track"]["lap_time_s"] = None if k == 2 else 9.0
        (tmp_path / race_key(name) / NUMBERS).write_text(json.dumps(driven))
        shutil.copy(root / race_key("lap") / "coefficients.png", tmp_path / race_key(name))
    for count, shown in ((3, True), (2, False)):
        some = plan.model_copy(update={"races": dict(list(laps.items())[:count])})
        text = document(some, tmp_path, tmp_path / f"{count}.md")
        assert ("](3_lap_0_pace.png)" in text) == shown
        assert (tmp_path / f"{count}_lap_0_pace.png").is_file() == shown


def test_lap_times_over_the_pace(tmp_path):
    """What was completed is a line, what was not a mark at the top, and the paper's times are level."""
    figure = lap_over_speed_scale(
        {"a": {0.8: 6.0, 0.9: 5.5, 1.0: None}, "b": {0.8: 6.5, 0.9: 6.4, 1.0: 6.3}},
        {"the line": {0.8: 5.9, 0.9: 5.2, 1.0: 4.7}},
        {"theirs": 4.88},
    )
    (axes,) = figure.axes
    lines = {line.get_label(): line for line in axes.lines if not line.get_label().startswith("_")}
    np.testing.assert_array_equal(lines["a"].get_ydata(), [6.0, 5.5, np.nan])
    np.testing.assert_array_equal(lines["the line"].get_xdata(), [0.8, 0.9, 1.0])
    top = axes.get_ylim()[1]
    lost = [line for line in axes.lines if line.get_linestyle() == "None" and len(line.get_ydata())]
    assert [list(line.get_ydata()) for line in lost] == [[top]]
    assert [text.get_text() for text in axes.texts] == ["theirs: 4.88 s"]
    figure.savefig(tmp_path / "speed_scale.png")


def test_the_papers_claim_stands_beside_what_its_model_does(plan, root, tmp_path):
    """Laps of 5 s by the paper's model and of 5.05 s by DDM: 0.99 %."""
    whole = load_plan()
    results = read_results(whole, root, [])
    race = whole.races["ethz_mobil"]
    laps = {
        "dynssm_orca_paper": {"lap_time_s": 5.0},
        "ddm_orca": {"lap_time_s": 5.05},
        "fthd_orca": {"lap_time_s": None},
    }
    assert claimed(results, race, laps) == (
        "The paper's claim: up to 13.2 % faster than the published models. Here `dynssm_orca_paper` is faster by "
        "+0.99 % than `ddm_orca`."
    )
    assert claimed(results, whole.races["grip_patch"], laps) == ""


def test_a_race_that_could_not_be_driven_says_why(plan, root, tmp_path):
    away = plan.races["lap"].model_copy(update={"track": "tracks/moon.csv"})
    elsewhere = plan.model_copy(update={"races": {"away": away}})
    text = document(elsewhere, root, tmp_path / "results_race.md")
    assert "*Not measured*: " in text
    assert "is not in the data folder" in text


def test_what_decides_the_laps_is_in_the_recipe(plan):
    step = race_step(plan)
    assert step.recipe()["race"]["speed_scale"] == 1.0
    assert "text" not in step.recipe()["race"]
    assert set(step.uses) == set(step.trained.values()) == set()


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"split": "moon"}, "races.lap.split: 'moon' is not one of"),
        (
            {"models": ["true", "dynssm_av21"]},
            "races.lap.models: 'dynssm_av21' is not one of true, mid_range, persistence, single_track",
        ),
    ],
)
def test_names_of_a_race_exist(tmp_path, plan, change, expected):
    content = plan.model_dump(mode="json")
    content["races"]["lap"] |= change
    path = tmp_path / "plan.yaml"
    path.write_text(yaml.safe_dump(content))
    with pytest.raises(ConfigurationError, match=r"races\.lap") as error:
        load_plan(path)
    assert expected in str(error.value)
