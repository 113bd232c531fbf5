"""The online layer live: two tracks in a row over DDS, equal to replay, better after a while; kept for the next stint."""

import dataclasses
import os
import signal
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest

import dynssm_ros
from benchmarks.endurance.live_run import (
    LiveRun,
    collecting,
    isolated_environment,
    node_process,
    predictor_process,
    run_live,
)
from dynssm_ros.runtime.artifact import open_artifact
from dynssm_ros.runtime.onnx_model import OnnxModel
from dynssm_ros.runtime.predictor import Prediction, Predictor
from dynssm_ros.runtime.replay import replay
from dynssm_ros.signals.bags import open_bag
from dynssm_ros.signals.recording import concatenate
from dynssm_ros.signals.signal_map import load_signal_map
from dynssm_ros.signals.standard import recording_to_bag

pytestmark = [pytest.mark.live, pytest.mark.timeout(240)]

SECONDS, GAP_NS = 35.0, 5_000_000_000
FIRST = 12.0  # s of the stint on the known track


def drive(track, seed, seconds, **effects):
    run = dynssm_ros.simulate(
        "orca", track, duration=seconds, seed=seed, plant="double_track", noise=(0.01, 0.01, 0.03), effects=effects
    )
    return dynssm_ros.recorded(run)


@pytest.fixture(scope="module")
def first():
    """Another driver on the track of the training."""
    return drive("club", 2, FIRST)


def another(first, seconds):
    """Another track with less grip, 5 s after ``first``."""
    second = drive("club_b", 3, seconds, front_grip={"factor": 0.85})
    return dataclasses.replace(second, time=second.time + first.time[-1] + GAP_NS - second.time[0])


def replayed(model, bag, online=True, state=None):
    predictor = Predictor(OnnxModel(open_artifact(model)), load_signal_map("default"), online=online)
    if state is not None:
        predictor.load_online(state)
    with open_bag(bag) as opened:
        return {
            o.outcome.stamp: o.outcome.state for o in replay(opened, predictor) if isinstance(o.outcome, Prediction)
        }


def rmse(found, recording, start, end):
    """One-step RMSE over a part of a recording (s since its start)."""
    seconds = (recording.time - recording.time[0]) / 1e9
    at = dict(zip(recording.time.tolist(), recording.matrix[:, :3], strict=True))
    inside = recording.time[(seconds >= start) & (seconds < end)].tolist()
    errors = np.array([found[t] - at[t] for t in inside if t in found])
    assert len(errors) > 100
    return np.sqrt(np.mean(errors**2, axis=0))


@pytest.mark.slow
def test_on_another_track_it_is_better_after_twenty_seconds_and_equal_to_replay(rls_model, first, tmp_path: Path):
    bag, second = tmp_path / "both", another(first, SECONDS)
    recording_to_bag(concatenate([first, second]), bag)
    run = run_live(rls_model, bag, 0.02, rate=3.0, in_step=True)
    assert len(run.missing()) < 40, run.diagnostics[-1]  # the window fills anew after the gap
    expected = replayed(rls_model, bag)
    stamps = sorted(set(run.predicted) & set(expected))
    live = np.array([run.predicted[stamp] for stamp in stamps])
    same = np.abs(live - np.array([expected[stamp] for stamp in stamps])).max(axis=1) < 1e-3
    assert same.mean() > 0.98  # odometry that overtakes its actuators is predicted from held samples
    found = {stamp: np.array(state) for stamp, state in run.predicted.items()}
    without = replayed(rls_model, bag, online=False)
    before, after = (rmse(found, second, *part) / rmse(without, second, *part) for part in ((1, 6), (20, 35)))
    print("error with the layer over that without: first seconds", before.round(3), "after 20 s", after.round(3))
    assert np.all(after < 1.0)
    assert np.prod(after) < np.prod(before)


def test_a_node_that_is_stopped_keeps_what_it_learned_for_the_next(rls_model, first, tmp_path: Path):
    bag, state = tmp_path / "first", tmp_path / "online.safetensors"
    recording_to_bag(first, bag)
    run_live(rls_model, bag, 0.02, rate=2.5, duration=5.0, in_step=True, parameters={"online_state": str(state)})
    assert state.is_file()
    second = tmp_path / "second"
    recording_to_bag(another(first, 8.0), second)
    fresh, goes_on = replayed(rls_model, second), replayed(rls_model, second, state=state)
    assert set(fresh) == set(goes_on)
    stamp = min(fresh)
    assert np.abs(fresh[stamp] - goes_on[stamp]).max() > 0.0


@pytest.mark.parametrize("stops", [2, pytest.param(15, marks=pytest.mark.slow)])
def test_a_busy_node_can_be_stopped_at_any_moment_and_keeps_what_it_learned(rls_model, first, stops, tmp_path: Path):
    bag, state = tmp_path / "first", tmp_path / "online.safetensors"
    recording_to_bag(first, bag)
    os.environ.update(isolated_environment())
    here = os.environ.copy()
    with ExitStack() as stack:
        stack.enter_context(node_process("player", {"bag": bag, "rate": 3.0, "loop": True}, here))
        for k in range(stops):
            stop = signal.SIGTERM if k % 5 == 1 else signal.SIGINT
            run = LiveRun(20_000_000)
            state.unlink(missing_ok=True)
            with predictor_process(rls_model, {"online_state": state}, here) as process, collecting(run) as collector:
                assert collector.wait_for(lambda run=run: len(run.predicted) > 20, 30.0)
                process.send_signal(stop)
                assert process.wait(10) == 0, process.communicate()[1]
            assert state.is_file()


def test_a_state_that_cannot_be_read_is_set_aside_and_the_node_begins_from_the_prior(rls_model, first, tmp_path: Path):
    bag, state = tmp_path / "first", tmp_path / "online.safetensors"
    recording_to_bag(first, bag)
    state.write_bytes(b"")
    run = run_live(rls_model, bag, 0.02, rate=2.5, duration=5.0, in_step=True, parameters={"online_state": str(state)})
    assert len(run.predicted) > 100
    level, words, _ = run.diagnostics[-1]
    assert level >= 1
    assert "not a readable online state" in words
    assert words.endswith("; learns from the prior; set aside as online.safetensors.bad")
    assert (tmp_path / "online.safetensors.bad").read_bytes() == b""
    assert state.stat().st_size > 0, "what is learned now"
