"""The robustness matrix: its cells, their split, its tracks and its page."""

from collections import Counter
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks.matrix import seeds, step_times
from benchmarks.matrix.raced_cells import CHANGES, OBJECTIVES, PACE, PLANTS, TRACKS, Cell, cells, variation
from benchmarks.matrix.races import AS_IS, race_model, read_cell
from benchmarks.matrix.races_page import closed_loop_page, lap_times, learned_laps, learning_page, summary
from benchmarks.matrix.scored_cells import CARS, NOISE_LEVELS
from benchmarks.matrix.scores import model_folder
from dynssm_ros.control.horizon_model import HorizonModel
from dynssm_ros.control.nmpc import Nmpc
from dynssm_ros.control.race import Course, Start
from dynssm_ros.control.race_models import true_model
from dynssm_ros.control.reference import load_reference
from dynssm_ros.control.settings import Settings, _slip
from dynssm_ros.simulation.plant import make_plant
from dynssm_ros.track.tracks import load_track
from dynssm_ros.vehicle import Applied, load_vehicle
from dynssm_ros.vehicle.kinematics import axle_direction


def outcome(lap, violation=False, completed=True):
    return {
        "completed": completed, "violation": violation, "lap_times_s": [lap + 0.1, lap], "solve_ms": {"p50": 2.0, "p99": 3.0},
        "infeasible": 0, "late": 1,
    }  # fmt: skip


def test_every_combination_is_a_cell_and_all_that_is_drawn_occurs():
    every = list(cells())
    assert len({cell.name for cell in every}) == len(every) == len(CARS) * len(TRACKS) * len(CHANGES)
    assert 0.35 < np.mean([cell.is_test for cell in every]) < 0.65
    assert set(Counter(cell.plant for cell in every)) == set(PLANTS)
    assert set(Counter(cell.noise for cell in every)) == set(NOISE_LEVELS)
    assert set(Counter((cell.objective, cell.late) for cell in every)) == {
        (o, d) for o in OBJECTIVES for d in (True, False)
    }


@pytest.mark.parametrize("track", TRACKS)
def test_a_variation_can_be_driven_and_is_another_track(track):
    name, seed = track
    base = load_track(name)
    bent = variation(base, seed)
    assert bent.name == f"{name}_{seed}"
    assert np.abs(base.project(bent.centre.points)[1]).max() > 0.25 * float(base.width_left[0])
    np.testing.assert_array_equal(bent.centre.points, variation(base, seed).centre.points)
    assert (
        1.0 / np.abs(bent.centre.curvature(bent.centre.s)).max()
        > 0.75 / np.abs(base.centre.curvature(base.centre.s)).max()
    )


def test_the_page_counts_those_that_come_round_and_compares_last_laps():
    every = list(cells())[:3]
    known = {
        every[0]: {"true": outcome(10.0), "calibrated": outcome(11.0), "dynssm": outcome(10.5)},
        every[1]: {"true": outcome(10.0), "calibrated": outcome(10.0), "dynssm": outcome(10.0, violation=True)},
        every[2]: {"true": outcome(10.0, completed=False), "calibrated": outcome(9.0), "dynssm": outcome(9.0)},
    }
    parts = summary(known).values()
    assert sum(part["cells"] for part in parts) == 3
    assert sum(part["possible"] for part in parts if part["cells"]) == 2
    models = [part["models"]["dynssm"] for part in parts if part["cells"]]
    assert sum(model["came_round"] for model in models) == 1
    assert [name for model in models for name in model["lost"]] == [every[1].name]
    words = closed_loop_page(known, ["part=all"], "laps.png", every)
    assert "(laps.png)" in words
    assert "dodo.py group=closed_loop part=all" in words
    assert every[1].name in words
    assert "Not driven" not in words
    same = [
        cell for cell in cells() if cell.car == every[0].car and cell.is_test == every[0].is_test and cell not in every
    ]
    assert f"Not driven: {len(same)} of" in closed_loop_page(known, [], "laps.png", [*every, *same])
    assert len(lap_times(known).axes) == 1


def test_the_page_tells_what_each_change_costs_each_model():
    cell = next(cell for cell in cells() if cell.change == "mass" and cell.objective == "progress")
    lost = next(c for c in cells() if c.change == "drag" and c.is_test == cell.is_test and c.car == cell.car)
    known = {
        cell: {
            "true": outcome(10.0),
            "calibrated": outcome(10.4),
            "dynssm": outcome(10.1),
            "dynssm as it is": outcome(11.0),
        },
        lost: {
            name: outcome(9.0, violation=name != "true") for name in ("true", "calibrated", "dynssm", "dynssm as it is")
        },
    }
    words = closed_loop_page(known, [], "laps.png", list(known))
    assert "| | cells | `calibrated` | `dynssm` |" in words
    assert "| mass | 1 | 1.040, 1.040 | 1.010, 1.010 |" in words
    assert "| drag | 1 | – | – |" in words
    assert "| all | 2 | 1.040, 1.040 | 1.010, 1.010 |" in words


def test_a_part_of_which_nothing_was_driven_is_told():
    test, development = (next(cell for cell in cells() if cell.is_test == part) for part in (True, False))
    known = {test: {name: outcome(10.0) for name in ("true", "calibrated", "dynssm")}}
    for words in (
        closed_loop_page(known, [], "laps.png", [test, development]),
        learning_page({test: {"true_best_s": 10.0, "learned": outcome(10.1)}}, [], "laps.png", [test, development]),
    ):
        assert "## Development cells" in words
        assert "Not driven: 1 of" in words


def test_the_page_of_learning_names_what_stays_behind():
    near, far, off, slow = [cell for cell in cells() if cell.is_test and cell.car == "orca"][:4]
    known = {
        near: {"true_best_s": 10.0, "learned": outcome(10.1)},
        far: {"true_best_s": 10.0, "learned": outcome(10.3)},
        off: {"true_best_s": 10.0, "learned": outcome(9.9, violation=True)},
        slow: {"true_best_s": None, "learned": outcome(12.0)},
    }
    words = learning_page(known, ["part=all"], "lap_learning.png", list(known))
    assert "dodo.py group=closed_loop part=all learning_page" in words
    assert "| all | 4 | 3 | 1.030 | 1.020, 1.030 | 1 of 2 |" in words
    assert f"More than 1.5 % behind: {far.name} (1.030)." in words
    (axes,) = learned_laps(known).axes
    drawn = sorted(float(line.get_ydata()[-1]) for line in axes.get_lines())
    assert drawn == pytest.approx([1.01, 1.02, 1.03])  # those that came round, and their median


def test_a_cell_is_driven_again_with_other_noise_alone():
    cell = Cell("orca", ("club", 11), "mass")
    again = replace(cell, again=1)
    assert again.sensing.seed != cell.sensing.seed
    assert replace(again.sensing, seed=cell.sensing.seed) == cell.sensing
    drawn = ("name", "plant", "objective", "noise", "late", "is_test", "effects")
    assert [getattr(again, each) for each in drawn] == [getattr(cell, each) for each in drawn]


def test_seeds_tell_mean_spread_and_what_was_lost(monkeypatch, capsys):
    laps = {"dynssm": [4.0, 4.2, 4.1], "true": [4.0, 4.0, 4.0], "calibrated": [4.0, 4.0, 4.1]}

    def drive(cell, name, trained):
        lost = name == "dynssm" and cell.again == 2
        driven = {"completed": not lost, "violation": False, "lap_times_s": [9.0, laps[name][cell.again]]}
        return SimpleNamespace(to_json=lambda: driven)

    monkeypatch.setattr(seeds, "drive", drive)
    seeds.main(["orca-club_11-mass", "--count", "3"])
    last = capsys.readouterr().out.splitlines()[-2:]
    assert last[0] == "orca-club_11-mass, over true: 1.0250 +- 0.0354 over 2 seeds, worst 1.0500, lost 1"
    assert last[1] == "orca-club_11-mass, over calibrated: 1.0250 +- 0.0354 over 2 seeds, worst 1.0500, lost 1"


def test_seeds_of_a_cell_that_there_is_not_are_refused(capsys):
    with pytest.raises(SystemExit):
        seeds.main(["orca-oval_1-mass"])
    assert "orca-oval_1-mass is no cell of the matrix; one is orca-club_11-none" in capsys.readouterr().err


def test_the_least_time_of_a_step_that_is_taken_again_leaves_the_machine_out(monkeypatch, capsys):
    quiet, disturbed = np.full(200, 2e-3), np.where(np.arange(200) % 20, 2e-3, 5e-3)
    drives = [SimpleNamespace(command=np.zeros((200, 2)), solve=each) for each in (disturbed, quiet)]
    monkeypatch.setattr(step_times, "drive", lambda cell, name, trained: drives.pop(0))
    step_times.main(["orca-club_11-mass", "--count", "2"])
    said = "orca-club_11-mass, true: p50 2.00, p99 5.00 ms; least of 2: p50 2.00, p99 2.00 ms"
    assert capsys.readouterr().out.splitlines() == [said]
    drives += [SimpleNamespace(command=np.full((200, 2), k), solve=quiet) for k in range(2)]
    step_times.main(["orca-club_11-mass", "--count", "2"])
    assert "times cannot be compared" in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_a_cell_is_driven_with_each_model(small_model, tmp_path):
    (cell,) = [each for each in cells() if each.name == "orca-club_11-none"]
    folder = model_folder(cell.training, "small", tmp_path / "trained")
    folder.parent.mkdir(parents=True)
    folder.symlink_to(small_model)
    trained = tmp_path / "trained"
    (folder.parent / "rls").symlink_to(small_model)
    for name in ("true", "calibrated"):
        race_model(cell, name, tmp_path, trained)
    assert read_cell(cell, ["small"], tmp_path) is None, "not driven with all models yet"
    race_model(cell, "small", tmp_path, trained)
    found = read_cell(cell, ["small"], tmp_path)
    assert list(found) == ["true", "calibrated", "small", "small" + AS_IS]
    assert found["true"]["completed"]
    assert len(found["calibrated"]["lap_times_s"]) == 2


@pytest.mark.slow
def test_a_car_that_came_fast_into_a_bend_finds_out_of_it_with_a_front_that_grips_less():
    """The true model on a development cell. At the front tyre's peak the program sees no use in steering less."""
    cell, car = Cell("av21", ("club_b", 22), "front_grip"), load_vehicle("av21")
    driven, road = car.with_effects(cell.effects.items()), cell.road
    settings = replace(Settings.of(car), deadline=np.inf)
    reference, model = load_reference("racing", car, road, PACE["tracking"]), true_model(driven, "double_track")
    horizon = HorizonModel(model.car, settings.N)
    start = Start(float(road.project(reference.line.position(380.0))[0]), speed=1.04 * float(reference.speed_at(380.0)))
    course = Course(driven, road, "double_track", reference, settings, start=start)
    B, C, _, E, *_ = car.nominal
    peak, most = _slip(1.0, B, C, E), {}
    for front in (settings.slip[0], peak):
        nmpc = Nmpc(horizon, car.inputs, reference, road, replace(settings, slip=(front, settings.slip[1])))
        plant, command, slips = make_plant(driven, course.plant, *course.starting()), Applied(0.0, 0.0), []
        for _ in range(100):
            command = nmpc.command(nmpc.plan(np.array([*plant.pose, *plant.state, *command]), model.calibrated))
            plant.advance(command)
            slips.append(abs(axle_direction(np, -car.constants.l_r, *plant.state)))
        most[front] = np.max(slips) / settings.slip[1]
    assert most[settings.slip[0]] < 1.0 < 1.5 < most[peak], "of the rear, in shares of its bound"
