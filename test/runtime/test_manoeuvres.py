"""Forwards, standing, backwards: a car that parks is predicted all along and accused of nothing."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from dynssm_ros.evaluation.metrics import drive_through, predict_rows
from dynssm_ros.runtime.artifact import open_artifact
from dynssm_ros.runtime.health import Level
from dynssm_ros.runtime.onnx_model import OnnxModel
from dynssm_ros.runtime.plausibility import implausible_rows
from dynssm_ros.runtime.predictor import Prediction, Predictor
from dynssm_ros.runtime.wiring import Wiring
from dynssm_ros.signals.history import Refusal
from dynssm_ros.signals.recording import Recording, RecordingInfo
from dynssm_ros.signals.signal_map import load_signal_map
from dynssm_ros.simulation.plant import make_plant
from dynssm_ros.vehicle import Applied, State, load_vehicle
from dynssm_ros.vehicle.kinematics import Pose

ORCA = load_vehicle("orca")
SIGNALS = load_signal_map("default")
NOISE = 0.01, 0.01, 0.03  # m/s, m/s, rad/s
PARKING = (
    (0.45, 0.0, 1.5), (0.35, 0.15, 1.5), (-0.3, 0.1, 0.4), (0.0, 0.0, 1.0),  # forwards to a stop
    (0.0, 0.3, 0.7), (0.0, -0.3, 0.7), (0.0, 0.2, 0.6),  # the wheel is turned
    (-0.35, -0.3, 1.5), (0.0, 0.3, 1.0), (0.35, 0.3, 1.2), (0.0, -0.3, 1.0), (-0.4, -0.2, 1.5), (-0.4, 0.2, 1.5),
    (0.0, 0.0, 1.0), (0.4, 0.1, 1.5),
)  # fmt: skip
"""Throttle, steering and seconds: it stops, turns its wheel, turns in three moves and drives away."""


@pytest.fixture(scope="module")
def parking() -> Recording:
    """Rows of the four-wheeled car, with noise; the steering follows within its speed."""
    car, T_s = make_plant(ORCA, "double_track", Pose(0.0, 0.0, 0.0), State(0.0, 0.0, 0.0)), ORCA.sampling_time
    rows, delta = [], 0.0
    for r, wanted, seconds in PARKING:
        for _ in range(round(seconds / T_s)):
            delta += float(np.clip(wanted - delta, -2.0 * T_s, 2.0 * T_s))
            rows.append((*car.state, r, delta, *car.pose))
            car.advance(Applied(r, delta))
    table = np.array(rows)
    table[:, :3] += np.random.default_rng(2).normal(size=(len(table), 3)) * NOISE
    names = ("v_x", "v_y", "omega", "r_fb", "delta_fb", "x", "y", "theta")
    columns = dict(zip(names, table.T, strict=True)) | dict.fromkeys(("r_cmd", "delta_cmd"), np.zeros(len(table)))
    time = 1_700_000_000_000_000_000 + np.arange(len(table)) * round(T_s * 1e9)
    info = RecordingInfo(sampling_time=T_s, commands="topics", source=("parking",))
    return Recording(info, time, np.zeros(len(table), dtype=np.int32), columns)


@pytest.fixture
def model(rls_model: Path) -> OnnxModel:
    return OnnxModel(open_artifact(rls_model))


def observe(predictor: Predictor, stamp: int, r: float, delta: float) -> None:
    for kind in ("feedback", "command"):
        predictor.observe(stamp, {f"throttle_{kind}": r, f"steering_{kind}": delta})


def test_the_drive_has_every_state(parking: Recording) -> None:
    v_x = parking["v_x"]
    assert v_x.min() < -0.8 < 0.8 < v_x.max()
    assert (np.abs(v_x) < 0.05).mean() > 0.2


def test_it_is_predicted_all_along_and_no_verdict_is_wrong(parking: Recording, model: OnnxModel) -> None:
    predictor, wiring = Predictor(model, SIGNALS), Wiring(model.vehicle, model.T_s)
    states, said, verdicts, errors = parking.matrix[:, :3], [], set(), []
    for k, stamp in enumerate(parking.time.tolist()):
        observe(predictor, stamp, parking["r_fb"][k], parking["delta_fb"][k])
        seen = {name: float(parking[name][k]) for name in ("v_x", "v_y", "omega", "x", "y", "theta")}
        outcome = predictor.predict(stamp, seen)
        said.append(outcome if isinstance(outcome, Refusal) else None)
        if isinstance(outcome, Prediction):
            wiring.add(stamp, predictor.row)
            if k + 1 < len(states):
                errors.append((*(outcome.state - states[k + 1]), *np.sqrt(outcome.variance), *states[k]))
        if k % 50 == 49:
            verdicts |= {wiring.verdict(), predictor.hindsight()[1] * (predictor.hindsight()[0] is Level.ERROR)}
    assert set(said) == {None, Refusal.FILLING}
    assert verdicts == {""}
    error, stated, now = np.split(np.array(errors), 3, axis=1)
    for where in (now[:, 0] < -0.4, np.abs(now[:, 0]) < 0.05):
        assert (np.sqrt(np.mean(error[where] ** 2, axis=0)) < [0.02, 0.03, 0.3]).all()
        assert (np.abs(error[where]) < 3 * stated[where]).mean() > 0.95


def test_the_layer_is_driven_through_a_recording_as_live(parking: Recording, model: OnnxModel) -> None:
    predictor, live = Predictor(model, SIGNALS), []
    for k, stamp in enumerate(parking.time.tolist()):
        observe(predictor, stamp, parking["r_fb"][k], parking["delta_fb"][k])
        outcome = predictor.predict(stamp, {name: float(parking[name][k]) for name in ("v_x", "v_y", "omega")})
        if isinstance(outcome, Prediction):
            live.append((*outcome.state, *outcome.variance))
    rows = parking.window_ends(model.H, 0)
    batch = [
        np.concatenate([each.state, each.variance], axis=1)
        for drive, (asked,) in drive_through(model, parking, [rows])
        for each in predict_rows(model, parking, asked, drive=drive)
    ]
    acts = np.isin(rows, parking.window_ends(model.H, 0, 0.0, model.card.least))  # elsewhere it states what it last did
    assert 50 < acts.sum() < len(rows) - 50
    np.testing.assert_allclose(np.concatenate(batch)[:, :3], np.array(live)[:, :3], rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(np.concatenate(batch)[acts], np.array(live)[acts], rtol=1e-5, atol=1e-6)


def test_what_it_was_not_trained_on_is_left_to_the_physics(parking: Recording, model: OnnxModel) -> None:
    assert model.card.slowest is not None
    assert model.card.slowest > model.card.least > 0
    backwards = parking.window_ends(model.H)[parking["v_x"][parking.window_ends(model.H)] < 0]
    said = model.predict(parking.windows(backwards, model.H))
    assert said.variance is not None
    assert (said.variance >= np.array(model.card.normalisation.increment_scale) ** 2).all()
    alone = model._physics.predict(parking.windows(backwards, model.H)).state
    np.testing.assert_array_equal(said.state, alone)


def test_reversing_is_no_fault_of_a_recording_but_of_a_car_that_cannot(parking: Recording) -> None:
    assert list(implausible_rows(parking, ORCA)) == []
    constants = ORCA.constants.model_copy(update={"reverse": False})
    (words,) = implausible_rows(parking, ORCA.model_copy(update={"constants": constants}))
    assert "speeds up backwards under a negative throttle; expected a negative one, and reverse: true" in words
