"""The plan: what is shipped holds together, tests share no row with training, mistakes get one line."""

from __future__ import annotations

import copy
from pathlib import Path

import numpy as np
import pytest
import yaml

import benchmarks.rivals
from benchmarks.paper.parts import cut, quantity
from benchmarks.paper.plan import Part, Range, Study, load_plan
from benchmarks.paper.published import published_drive
from benchmarks.paper.reference import load_reference, suspects
from benchmarks.paper.results import by_name
from dynssm_ros.configuration import config_root
from dynssm_ros.errors import ConfigurationError, RecordingError
from dynssm_ros.signals.extraction import extract
from dynssm_ros.signals.inputs import WINDOW_COLUMNS
from dynssm_ros.signals.recording import Recording, RecordingInfo
from dynssm_ros.signals.signal_map import load_signal_map
from dynssm_ros.vehicle import COEFFICIENTS

T_s = 0.04


REPOSITORY = Path(__file__).resolve().parents[2]


def make_recording(v_x, omega, segment=None):
    N = len(v_x)
    columns = {name: np.zeros(N) for name in WINDOW_COLUMNS} | {"v_x": v_x, "omega": omega}
    info = RecordingInfo(sampling_time=T_s, commands="none", source=("planted",))
    time = np.round(np.arange(N) * T_s * 1e9).astype(np.int64)
    return Recording(info, time, np.zeros(N, np.int32) if segment is None else segment, columns)


@pytest.fixture(scope="module")
def plan():
    return load_plan()


@pytest.fixture
def content():
    return yaml.safe_load((REPOSITORY / "benchmarks" / "paper" / "plan.yaml").read_text())


@pytest.fixture
def drive():
    """475 s that change between slow and fast, left and right, straight and corner."""
    t = np.arange(0.0, 475.0, T_s)
    return make_recording(20.0 + 8.0 * np.sin(t / 17.0), 0.2 * np.sin(t / 5.0))


def test_no_test_of_the_shipped_plan_shares_a_row_with_its_training(plan, drive):
    for name, split in plan.splits.items():
        for test in split.test.values():
            if test.recording == split.train.recording:
                trained, tested = cut(drive, split.train), cut(drive, test)
                assert len(trained) > 1000, name
                assert len(tested) > 1000, name
                assert not set(trained.time) & set(tested.time), name


def test_every_shipped_model_is_in_the_plan_and_every_change_fits(plan):
    used = {model.base or name for name, model in plan.models.items()}
    folders = (config_root() / "models", Path(benchmarks.rivals.__file__).parent)
    shipped = {path.stem for folder in folders for path in folder.glob("*.yaml")}
    assert shipped <= used
    assert {name: plan.configured(name).name for name in plan.models} == {name: name for name in plan.models}
    assert plan.configured("dynssm_av21_no_online").online is None
    assert plan.configured("dynssm_orca_paper_no_gru").physics.nominal == "mid_range"
    assert plan.configured("dynssm_orca_paper_calibrated").physics.nominal == "calibrated"


def test_every_ablation_of_the_plan_has_words(plan):
    for car in plan.cars.values():
        for model in plan.models:
            if model.startswith((f"{car.full}_", f"{car.paper}_")) and model != car.paper:
                assert plan.models[model].variant, model


def test_a_part_is_cut_into_segments_where_rows_are_left_out(drive):
    part = Part(recording="x", where=(Range(quantity="time", at_least=16.0, outside=(100.0, 200.0)),))
    rows = cut(drive, part)
    seconds = (rows.time - drive.time[0]) / 1e9
    assert seconds[0] == 16.0
    assert not ((seconds >= 100.0) & (seconds < 200.0)).any()
    assert rows.segment.tolist() == [int(t >= 200.0) for t in seconds]


def test_all_ranges_of_a_part_hold(drive):
    part = Part(recording="x", where=(Range(quantity="speed", at_least=21.0), Range(quantity="yaw_rate", below=0.0)))
    rows = cut(drive, part)
    assert 0 < len(rows) < len(drive)
    # the means over a second lag the values by little here
    assert rows["v_x"].min() > 20.5
    assert rows["omega"].max() < 0.03


def test_quantities_are_means_over_a_second_and_stop_at_gaps():
    v_x = np.repeat([10.0, 30.0], 50)
    recording = make_recording(v_x, np.full(100, -0.1))
    speed = quantity(recording, "speed")
    assert speed[49] == pytest.approx(20.0, abs=0.5)
    np.testing.assert_allclose(speed[[0, 30, 70, 99]], [10.0, 10.0, 30.0, 30.0])
    np.testing.assert_allclose(quantity(recording, "lateral_acceleration")[[0, 99]], [1.0, 3.0])
    gap = make_recording(v_x, np.zeros(100), np.repeat([0, 1], 50).astype(np.int32))
    np.testing.assert_allclose(quantity(gap, "speed"), v_x)


def test_given_recordings_are_the_tests_of_splits_without(plan):
    given = plan.with_tests({"vegas": 0.04, "mobil": 0.02, "again": 0.04})
    assert given.splits["whole"].test == {name: Part(recording=name) for name in ("vegas", "again")}
    assert given.splits["ethz_given"].test == {"mobil": Part(recording="mobil")}
    assert given.splits["lap_1"] == plan.splits["lap_1"]
    assert plan.with_tests({}).splits["whole"].test == {}
    with pytest.raises(ConfigurationError, match="test=putnam: the plan has a recording of that name"):
        plan.with_tests({"putnam": 0.04})
    with pytest.raises(ConfigurationError, match=r"test=slow: sampling time 0.1 s; expected 0.02 s or 0.04 s"):
        plan.with_tests({"slow": 0.1})


def test_splits_with_the_same_training_share_it(plan):
    assert plan.home("ethz_given") == "ethz"
    assert {name: plan.home(name) for name in ("lap_1", "whole", "slow")} == {n: n for n in ("lap_1", "whole", "slow")}


def test_the_papers_cars_are_scored_over_its_horizons(plan):
    horizons = {car.reference: car.horizon for car in plan.cars.values()}
    assert {data: horizons[data] for data in ("real", "sim")} == {"real": 0.6, "sim": 0.3}  # caption of tab:open_loop


def test_figures_of_the_paper_that_contradict_each_other_are_listed():
    reference = load_reference()
    assert suspects(reference) == [
        "DDM, small car: the FDE, 0.0016 m, is below the ADE, 0.00759 m",
        "FTHD, small car: the RMSE of omega, 0.483, is above its maximum, 0.289",
    ]
    planted = copy.deepcopy(reference)
    planted["open_loop"]["real"]["DynSSM"]["rmse"]["v_x"] = 1.0
    assert "DynSSM, full-size car: the RMSE of v_x, 1, is above its maximum, 0.927" in suspects(planted)


def test_a_quick_plan_is_shorter_in_everything(plan):
    quick = plan.shortened()
    assert quick.epochs == plan.quick.epochs
    assert {study.seeds for study in quick.studies.values()} == {1}
    assert max(drive.duration for drive in quick.drives.values()) <= plan.quick.duration
    assert {name: study.splits for name, study in quick.studies.items()} == {
        name: study.splits[:1] for name, study in plan.studies.items()
    }


def test_all_models_have_the_same_seeds_but_those_in_closed_form(plan):
    for study in plan.studies.values():
        assert study.seeds >= 3
        fewer = {plan.configured(m).kind for m in study.models if m in plan.models and len(plan.seeds(study, m)) < 3}
        assert fewer <= {"ridge", "rls", "gp", "on_track"}


def test_a_remark_in_the_plan_has_no_numbers(plan):
    study = plan.studies["orca"].model_dump()
    with pytest.raises(ValueError, match="a number; expected words and the date alone"):
        Study.model_validate(study | {"remark": "Ahead by 7 %."})
    Study.model_validate(study | {"remark": "Ahead (2026-11-23)."})


def test_learning_rates_that_are_tried_hold_the_shipped_one(plan):
    for sweep in plan.sweeps.values():
        assert plan.configured(sweep.model).training.learning_rate in sweep.rates


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (lambda c: c["models"].update(gpt_av21={}), "models: 'gpt_av21' is neither a file nor a shipped name"),
        (lambda c: c["cars"]["orca"].update(vehicle="trabant"), "vehicles: 'trabant' is neither a file nor"),
        (lambda c: c["studies"]["laps"]["models"].append("x"), "studies.laps.models: 'x' is not one of"),
        (lambda c: c["studies"]["laps"]["splits"].append("x"), "studies.laps.splits: 'x' is not one of"),
        (lambda c: c["studies"]["laps"]["splits"].append("ethz"), "studies.laps.splits: of several cars"),
        (
            lambda c: c["studies"]["laps"]["splits"].append("lap_1"),
            "studies.laps.splits: tests of the same name: lap 1",
        ),
        (lambda c: c["splits"]["lap_1"]["train"].update(recording="x"), "splits.lap_1: 'x' is not one of "),
        (lambda c: c["splits"]["slow"]["train"]["where"].append({"quantity": "speed"}), "speed: no limit; expected"),
        (lambda c: c["splits"]["slow"].update(car="x"), "splits.slow.car: 'x' is not one of"),
        (lambda c: c["cars"]["av21"].update(ddm="x"), "cars.av21: 'x' is not one of"),
        (lambda c: c["drives"]["oval"]["effects"].append({"name": "magic"}), "unknown effect 'magic'"),
        (lambda c: c["searches"]["orca"]["tries"].update(x={"loss": {"y": 1}}), "loss.y: Extra inputs"),
        (lambda c: c["searches"]["orca"].update(model="x"), "searches.orca.model: 'x' is not one of"),
        (lambda c: c.update(strides=3), "strides: Extra inputs"),
    ],
)
def test_a_mistake_in_the_plan_is_one_line(content, tmp_path, change, expected):
    changed = copy.deepcopy(content)
    change(changed)
    path = tmp_path / "plan.yaml"
    path.write_text(yaml.safe_dump(changed))
    with pytest.raises(ConfigurationError) as error:
        load_plan(path)
    assert expected in str(error.value)
    assert str(error.value).startswith(str(path))
    assert "\n" not in str(error.value)


def test_the_reference_has_every_table_for_both_cars():
    reference = load_reference()
    for data in ("real", "sim"):
        assert list(reference["open_loop"][data]) == ["DDM", "FTHD", "DynSSM"]
        assert set(reference["coefficients"][data]) == {
            c for c in COEFFICIENTS if not c.startswith("C_m") and c[:3] != "C_r"
        } | {"C_r"}
    # the paper's own sums: the abstract's shares follow from its table, the last one against FTHD
    real = reference["open_loop"]["real"]
    shares = 1 - by_name(real["DynSSM"]["rmse"]) / by_name(real["DDM"]["rmse"])
    np.testing.assert_allclose(shares[:2], by_name(reference["claims"]["rmse"])[:2], atol=1e-3)
    assert 1 - real["DynSSM"]["rmse"]["omega"] / real["FTHD"]["rmse"]["omega"] == pytest.approx(
        reference["claims"]["rmse"]["omega"], abs=1e-3
    )
    assert reference["ablation"]["real"]["full"]["rmse"] == real["DynSSM"]["rmse"]


def test_the_bounds_in_the_reference_are_those_of_the_shipped_vehicles():
    from dynssm_ros.vehicle import load_vehicle

    for data, name in (("real", "av21_paper"), ("sim", "orca")):
        vehicle = load_vehicle(name)
        for coefficient, row in load_reference()["coefficients"][data].items():
            assert tuple(row["bounds"]) == vehicle.coefficients[coefficient].bounds, coefficient


@pytest.mark.parametrize(
    ("name", "vehicle", "data"), [("dynssm_paper_av21", "av21_paper", "real"), ("dynssm_paper_orca", "orca", "sim")]
)
def test_the_papers_model_has_the_papers_size(name, vehicle, data):
    """Its ablation without GRU has the operations of the full model, so the paper does not count those of a GRU."""
    from dynssm_ros.learning.export import count_flops
    from dynssm_ros.learning.models.registry import build_model, load_model_config
    from dynssm_ros.runtime.artifact import Normalisation
    from dynssm_ros.vehicle import load_vehicle

    none = Normalisation(input_mean=(0,) * 7, input_std=(1,) * 7, state_scale=(1,) * 3, increment_scale=(1,) * 3)
    config, car = load_model_config(name), load_vehicle(vehicle)
    model, H = build_model(config, car, none), config.rows(car.sampling_time)
    of_gru = 2 * H * sum(weight.numel() for key, weight in model.named_parameters() if "gru.weight" in key)
    paper = load_reference()["open_loop"][data]["DynSSM"]
    assert sum(weight.numel() for weight in model.parameters()) == pytest.approx(paper["parameters"], rel=0.05)
    assert count_flops(model, H) - of_gru == pytest.approx(paper["flops"], rel=0.05)


def test_an_unreadable_plan_is_named():
    with pytest.raises(ConfigurationError, match=r"nowhere.yaml: cannot be read"):
        load_plan(Path("nowhere.yaml"))


def test_a_published_drive_is_the_recording_that_its_bag_is(orca_bag):
    """``ethz_pure_pursuit.npz`` and its bag are the same data."""
    recording = published_drive(orca_bag.with_suffix(".npz"))
    of_bag = extract([orca_bag], load_signal_map("default"), 50.0)
    assert recording.info.commands == of_bag.info.commands
    assert recording.T_s == of_bag.T_s
    for name in of_bag.columns:
        np.testing.assert_allclose(recording[name], of_bag[name], atol=1e-12, err_msg=name)


def test_another_file_is_no_published_drive(tmp_path):
    np.savez(
        tmp_path / "a.npz",
        time=np.arange(3.0),
        states=np.zeros((6, 3)),
        dstates=np.zeros((7, 3)),
        inputs=np.zeros((2, 2)),
    )
    with pytest.raises(RecordingError, match=r"dstates of shape \(7, 3\); expected \(8, 3\) for 3 times"):
        published_drive(tmp_path / "a.npz")
    with pytest.raises(RecordingError, match="expected arrays time, states, dstates, inputs"):
        published_drive(tmp_path / "nowhere.npz")


def test_a_published_csv_is_the_recording_that_its_bag_is(putnam):
    """The bag of Putnam Park was made from the CSV; stamps of its reports are 5 and 7 ms off."""
    signals = load_signal_map(str(REPOSITORY / "benchmarks" / "paper" / "deep_dynamics_csv.yaml"))
    of_csv = extract([putnam.with_suffix(".csv")], signals, 25.0)
    of_bag = extract([putnam], load_signal_map("av21"), 25.0)
    first = np.searchsorted(of_csv.time, of_bag.time[0] - 1000)  # the bag's reports begin later; stamps in ns
    later = of_csv.select(slice(first, first + len(of_bag)))
    assert len(of_bag) > 11_890
    np.testing.assert_allclose(later.time, of_bag.time, atol=1000)
    for name, error in {"v_x": 1e-6, "v_y": 1e-6, "omega": 1e-6, "r_fb": 0.01, "delta_fb": 1e-3}.items():
        assert np.quantile(np.abs(later[name] - of_bag[name]), 0.99) < error, name
