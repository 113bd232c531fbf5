"""The compiled loops: found where they were built from this source, and never needed."""

from __future__ import annotations

import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dynssm_ros import compiled
from dynssm_ros.arrays import Vector
from dynssm_ros.errors import ArtifactError
from dynssm_ros.runtime.along import Along
from dynssm_ros.runtime.artifact import open_artifact
from dynssm_ros.runtime.features import FeatureLayout, LayerFeatures
from dynssm_ros.runtime.learner import OnlineLearner
from dynssm_ros.runtime.online import Learned, Seen
from dynssm_ros.runtime.onnx_model import OnnxModel
from dynssm_ros.runtime.path_judge import _FAR, _pair_steps
from dynssm_ros.runtime.rollout import LayerRollout, RolloutCorrection, roll_out, step_of
from dynssm_ros.signals.history import History, Refusal
from dynssm_ros.signals.signal_map import CONTEXT_SIGNALS, Commands, load_signal_map

NAMES = FeatureLayout(10, 2, 3, 30, False).names
SOURCE = Path(compiled.__file__).with_suffix(".c")


def test_a_library_of_another_source_is_not_used(tmp_path: Path, library: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compiled, "_SOURCE", tmp_path / "compiled.c")
    assert compiled._load() is None, "none was built"
    shutil.copy(SOURCE, tmp_path)
    shutil.copy(library._name, tmp_path / "_compiled.so")
    assert compiled._load() is not None
    monkeypatch.setenv("DYNSSM_COMPILED", "0")
    assert compiled._load() is None, "switched off"
    monkeypatch.delenv("DYNSSM_COMPILED")
    (tmp_path / "compiled.c").write_text(SOURCE.read_text() + "\n")
    assert compiled._load() is None, "the source has changed"
    (tmp_path / "_compiled.so").unlink()  # the one that is open stays whole
    (tmp_path / "_compiled.so").write_bytes(b"no library")
    assert compiled._load() is None


def test_arrays_with_gaps_are_refused() -> None:
    with pytest.raises(ValueError, match="code: an array with gaps"):
        compiled.TapeStructure().fill(code=np.zeros((4, 4))[:, ::2])


def test_the_package_is_built_without_a_compiler(tmp_path: Path) -> None:
    root = Path(__file__).resolve().parent.parent
    (tmp_path / "dynssm_ros").mkdir()
    shutil.copy(root / "setup.py", tmp_path)
    shutil.copy(SOURCE, tmp_path / "dynssm_ros")
    done = subprocess.run(
        [sys.executable, "setup.py", "build_ext", "--inplace"],
        cwd=tmp_path, env={"PATH": str(tmp_path), "CC": "none"}, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert not list((tmp_path / "dynssm_ros").glob("*.so"))


def wandering(model: OnnxModel, seed: int) -> Vector:
    """400 rows of a drive that wanders about the training's mean."""
    scales, steps = model.card.normalisation, np.random.default_rng(seed).normal(size=(400, 7)) / 20
    return np.array(scales.input_mean) + np.array(scales.input_std) * np.cumsum(steps, axis=0)


def test_the_layer_sees_the_same_with_and_without(
    rls_model: Path, library: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = OnnxModel(open_artifact(rls_model))
    scales = model.card.normalisation
    rng = np.random.default_rng(0)
    windows = np.array(scales.input_mean) + np.array(scales.input_std) * rng.normal(size=(70, model.H, 7))
    windows[::5, :, :3] = 0.0
    windows[1::5, :, 0] *= -1.0
    monkeypatch.setattr(compiled, "LIBRARY", None)
    expected = [model.predict(each) for each in (windows, windows[:1])]
    monkeypatch.setattr(compiled, "LIBRARY", library)
    for each, plain in zip((windows, windows[:1], np.asfortranarray(windows)), [*expected, expected[0]], strict=True):
        said = model.predict(each)
        np.testing.assert_allclose(said.seen.features, plain.seen.features, rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(said.state, plain.state, rtol=1e-12, atol=1e-12)


def test_the_layer_learns_the_same_with_and_without(
    rls_model: Path, library: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = OnnxModel(open_artifact(rls_model))
    layer, rows = model.online, wandering(model, seed=1)
    assert layer is not None
    windows = np.lib.stride_tricks.sliding_window_view(rows, model.H, axis=0).swapaxes(1, 2)[:-1]
    increments = np.diff(rows[model.H - 1 :, :3], axis=0)
    increments[50] *= 30.0  # an outlier
    increments[80] = np.nan
    ends = np.arange(len(windows)) + (np.arange(len(windows)) >= 120)  # with a gap
    seen, last = model._features.seen(windows), windows[:, -1]  # type: ignore[union-attr]
    found = {}
    for which in (None, library):
        monkeypatch.setattr(compiled, "LIBRARY", which)
        along, blocks = Along(layer), (slice(0, 90), slice(90, 91), slice(91, None))
        parts = [along.over(seen.at(block), last[block], increments[block], ends[block]) for block in blocks]
        state = layer.start()
        for k in range(1, 60):
            state.update(Seen(seen.features[k - 1], seen.physics[k - 1]), last[k - 1], increments[k - 1])
        found[which] = (*Learned.joined(parts), *state.learned(seen.features[60]), along._state.steps, state.covariance)
    for own, plain in zip(found[library], found[None], strict=True):
        np.testing.assert_allclose(own, plain, rtol=1e-9, atol=1e-11)  # hundreds of steps on from the last digit


def test_a_drive_is_followed_the_same_with_and_without(
    rls_model: Path, library: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In one call or in several: standing, slow, reversing, rows that do not follow, inputs that came late."""
    model = OnnxModel(open_artifact(rls_model))
    drive = wandering(model, seed=4)
    drive[100:150, :3] = 0.0
    drive[200:250, 0] *= -1.0
    windows = np.lib.stride_tricks.sliding_window_view(drive, model.H, axis=0).swapaxes(1, 2)
    windows = np.ascontiguousarray(windows)
    late = windows - [0.0, 0.0, 0.0, 0.01, 0.0, 0.0, 0.0]
    found = {}
    for which in (None, library):
        monkeypatch.setattr(compiled, "LIBRARY", which)
        learner, said = OnlineLearner(model, model.online), []
        for k, window in enumerate(windows):
            if k == 40:
                learner.interrupt()
            given = late[k] if k % 5 == 0 else window
            predicted, fast = learner.predict(given, lambda k=k: windows[k - 1], learns=k % 7 != 3)
            said.append(np.concatenate([*(np.ravel(part) for part in predicted[:4]), [fast, learner.state.steps]]))
            if k % 10 == 0:
                step = step_of(model, learner.rollout())
                said[-1] = np.append(said[-1], roll_out(step, np.concatenate([window, window])[None], model.H))
            learner.finish()
        found[which] = said
    assert 100 < learner.state.steps < 300
    for k, (own, plain) in enumerate(zip(found[library], found[None], strict=True)):
        np.testing.assert_allclose(own, plain, rtol=1e-12 if k < 3 else 1e-8, atol=1e-12 if k < 3 else 1e-9)


@pytest.mark.parametrize("effect", ["", "steering_lag", "tire_relaxation"])
def test_rollouts_are_the_same_with_and_without(
    rls_model: Path, orca: Any, acting: Any, library: Any, monkeypatch: pytest.MonkeyPatch, effect: str
) -> None:
    """Paths of a controller and paths that are judged: driving, standing, reversing, diverging."""
    model = OnnxModel(open_artifact(rls_model))
    scales, plain = model.card.normalisation, model.layer_features
    assert plain is not None
    vehicle = orca.with_effect(effect, acting(effect)) if effect else model.vehicle
    mean, std = np.array(scales.input_mean), np.array(scales.input_std)
    layout = plain.layout._replace(throttle=effect == "tire_relaxation")
    features = LayerFeatures(
        layout, vehicle, mean=mean, std=std, increment_scale=np.array(scales.increment_scale),
        integrator="rk4", substeps=1,
    )  # fmt: skip
    prior = np.pad(model.online.mean, [(0, 0), (0, len(layout.names) - len(plain.names))], constant_values=0.1)
    layer = replace(model.online, mean=prior, vehicle=vehicle, least=0.05)
    rng, N, steps = np.random.default_rng(2), 70, 20
    rows = mean + std * np.cumsum(rng.normal(size=(N, model.H + steps, 7)) / 10, axis=1)
    rows[::9, :, :3] = 0.0
    rows[1::9, :, 0] *= -1.0
    weights = layer.mean + 0.3 * rng.normal(size=(N, *layer.mean.shape))
    weights[2::9] *= 50.0
    limit, trusted = np.abs(rng.normal(size=(N, 3))), np.tile([1.0, 0.0], N // 2)
    learned = Learned(weights, np.ones((N, 3)), limit, np.zeros((N, 17)), trusted)
    correction = RolloutCorrection(layer, learned)

    def driven(windows: Vector) -> Vector:
        seen, now = features.seen(windows), windows[:, -1, :3]
        states: Vector = now + np.where(layer.acts(now[:, :1]), correction.increments(seen), seen.physics)
        return states

    monkeypatch.setattr(compiled, "LIBRARY", None)
    assert not LayerRollout(features, layer).roll_out(rows, model.H, learned)
    first = features.seen(rows[:, : model.H])
    judged = _pair_steps(layer, features.seen, first, learned)
    with np.errstate(all="ignore"):
        expected = [roll_out(step, rows, model.H) for step in (driven, judged)]
    monkeypatch.setattr(compiled, "LIBRARY", library)
    for farthest, states in zip((None, _FAR), expected, strict=True):
        found = rows.copy()
        assert LayerRollout(features, layer, farthest).roll_out(found, model.H, learned)
        np.testing.assert_array_equal(found[:, : model.H], rows[:, : model.H])
        np.testing.assert_array_equal(found[..., 3:], rows[..., 3:])
        tame = np.abs(states).max(axis=(1, 2)) < 50.0
        assert tame.sum() > N // 2
        np.testing.assert_allclose(found[tame, model.H :, :3], states[tame], rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(found[tame, model.H, :3], states[tame, 0], rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize(
    ("signals", "commands"), [("default", "topics"), ("default", "none"), ("av21", "none"), ("default_speed", "topics")]
)
def test_windows_are_the_same_with_and_without(
    library: Any, monkeypatch: pytest.MonkeyPatch, signals: str, commands: Commands
) -> None:
    """At odd rates, before the oldest and after the newest sample, of signals that are held, from buffers that turn over."""
    signal_map = load_signal_map(signals).without(CONTEXT_SIGNALS).with_commands(commands)
    history = History(signal_map, 0.02, 30, max_age=1.0, held=("throttle_command", "brake_feedback"))
    rng, compared = np.random.default_rng(3), 0
    for k in range(600):
        stamp = 10**18 + k * 7_000_000 + int(rng.integers(0, 3_000_000))
        names = history.names if k % 3 else history.names[:3]
        history.add(stamp, dict(zip(names, rng.normal(size=len(names)).tolist(), strict=True)))
        windows = []
        for which in (None, library):
            monkeypatch.setattr(compiled, "LIBRARY", which)
            windows.append(history.window(stamp))
        if not isinstance(windows[0], Refusal):
            np.testing.assert_array_equal(windows[1], windows[0])
            compared += 1
        else:
            assert windows[1] is windows[0]
    assert compared > 400


def test_what_was_known_stays_when_more_is_learned(rls_model: Path) -> None:
    layer = OnnxModel(open_artifact(rls_model)).online
    assert layer is not None
    state, features = layer.start(), np.ones((3, layer.mean.shape[1]))
    known = state.learned(features)
    before = [part.copy() for part in known]
    state.update(Seen(features, np.zeros(3)), np.zeros(7), np.ones(3))
    assert not np.array_equal(state.mean, before[0][0])
    for part, kept in zip(known, before, strict=True):
        np.testing.assert_array_equal(part, kept)


def test_a_layout_is_known_by_its_names() -> None:
    for layout in (
        FeatureLayout(10, 2, 3, 30, False),
        FeatureLayout(2, 0, 1, 4, True),
        FeatureLayout(1, 3, 2, 7, False),
        FeatureLayout(10, 2, 3, 30, False, True),
        FeatureLayout(1, 0, 1, 2, True, True),
    ):
        assert FeatureLayout.of(layout.names, layout.errors) == layout
    with pytest.raises(ArtifactError, match=r"online layer: features .*; expected "):
        FeatureLayout.of((*NAMES, "tyre temperature"), 30)
