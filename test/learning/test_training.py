"""Training: repeatable, resumable after any interruption, stopped in time, and it learns."""

from __future__ import annotations

import io
import os
import pickle
import struct
import subprocess
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from dynssm_ros.errors import ConfigurationError, RecordingError
from dynssm_ros.learning import optimisation as training_module
from dynssm_ros.learning.dataset import split_windows
from dynssm_ros.learning.models import base
from dynssm_ros.learning.models.base import ModelConfig
from dynssm_ros.learning.models.dynssm.network import DynSSM
from dynssm_ros.learning.models.ridge import RidgeConfig
from dynssm_ros.learning.stages import Trained, check_device, train
from dynssm_ros.runtime.artifact import Normalisation
from dynssm_ros.signals.inputs import WINDOW_COLUMNS
from dynssm_ros.signals.recording import Recording, RecordingInfo
from dynssm_ros.vehicle import Vehicle

MakeConfig = Callable[..., ModelConfig]
Fit = Callable[..., Trained]
UNIT = Normalisation(input_mean=(0.0,) * 7, input_std=(1.0,) * 7, state_scale=(1.0,) * 3, increment_scale=(1.0,) * 3)


FAR_OFF = {"nominal": "mid_range"}  # so that there is something to learn


@pytest.fixture(scope="module")
def short(drive: Callable[..., Recording], orca: Vehicle) -> Recording:
    """8 s of the small car."""
    return drive(orca, 400)


@pytest.fixture
def checkpoint(tmp_path: Path) -> Path:
    return tmp_path / "checkpoint.pt"


@pytest.fixture
def fit(short: Recording, make_config: MakeConfig, orca: Vehicle, checkpoint: Path) -> Fit:
    """Trains the small model, with changed blocks, on the short drive; ``at`` is its checkpoint."""

    def train_it(at: Path = checkpoint, progress: Any = None, **changes: Any) -> Trained:
        return train(short, make_config(**changes), orca, at, progress=progress)

    return train_it


def interrupt_at(epoch: int) -> Callable[[int, int, str], None]:
    def progress(done: int, total: int, words: str) -> None:
        if done == epoch:
            raise KeyboardInterrupt

    return progress


def same(a: Trained, b: Trained) -> bool:
    """Whether weights and history agree bit by bit."""
    ours, theirs = a.model.state_dict(), b.model.state_dict()
    return a.history == b.history and all(torch.equal(ours[name], theirs[name]) for name in ours)


# --- repeatable ---------------------------------------------------------------------------------


def test_the_seed_alone_decides(fit: Fit, tmp_path: Path) -> None:
    first = fit(tmp_path / "a.pt")
    torch.rand(17)  # what the caller does with the generator does not matter
    assert same(first, fit(tmp_path / "b.pt"))
    other = fit(tmp_path / "c.pt", training={"seed": 1})
    assert not same(first, other)
    assert other.history != first.history


def test_history_and_progress_tell_of_every_epoch(fit: Fit) -> None:
    told: list[tuple[int, int, str]] = []
    trained = fit(physics=FAR_OFF, progress=lambda *args: told.append(args))
    assert [args[:2] for args in told] == [(1, 3), (2, 3), (3, 3)]
    validation = trained.history["validation/prediction"]
    assert told[-1][2] == f"validation {validation[-1]:.4g}, best {min(validation):.4g}"
    assert {len(values) for values in trained.history.values()} == {3}
    assert trained.best_epoch == 1 + validation.index(min(validation))


def test_the_best_epoch_is_kept_and_measured(short: Recording, fit: Fit) -> None:
    trained = fit(physics=FAR_OFF, training={"epochs": 8, "patience": 2, "learning_rate": 0.03})
    validation = trained.history["validation/prediction"]
    assert validation[-1] > min(validation)
    window, target = split_windows(short, trained.H, trained.config.training, 0.0, 64)[1].batch(slice(None))
    with torch.no_grad():
        error = trained.model(window).increment - target
    scaled = (error / torch.tensor(trained.normalisation.increment_scale)).square().mean().item()
    assert scaled == pytest.approx(min(validation), rel=1e-5)
    np.testing.assert_allclose(trained.validation_rmse, error.square().mean(0).sqrt().numpy(), rtol=1e-6)


@pytest.mark.parametrize(("schedule", "last"), [("cosine", 0.02 * 0.005), ("constant", 0.005)])
def test_the_learning_rate_takes_the_course_of_the_schedule(
    fit: Fit, checkpoint: Path, schedule: str, last: float
) -> None:
    fit(training={"schedule": schedule})
    assert torch.load(checkpoint, weights_only=True)["optimiser"]["param_groups"][0]["lr"] == pytest.approx(last)


def test_gradients_are_clipped_if_the_model_file_says_so(
    short: Recording, make_config: MakeConfig, orca: Vehicle, tmp_path: Path
) -> None:
    moved = {}
    for clip in (1e-12, 1.0, None):
        config = make_config(physics=FAR_OFF, training={"epochs": 1, "gradient_clip": clip})
        torch.manual_seed(config.training.seed)
        start = DynSSM(config, orca, UNIT).fusion.mix[0].weight
        end = train(short, config, orca, tmp_path / f"{clip}.pt").model.state_dict()["fusion.mix.0.weight"]
        moved[clip] = (end - start).abs().max().item()
    assert moved[1e-12] < 1e-4 < moved[1.0]
    assert moved[None] != moved[1.0]


# --- come to nothing ----------------------------------------------------------------------------


def plateaus(monkeypatch: pytest.MonkeyPatch, count: int) -> None:
    """So many plateaus whatever the data, then all is well."""
    shares = iter([1.0] * count)
    monkeypatch.setattr(training_module, "_FALLING", 0.0)
    monkeypatch.setattr(training_module, "unexplained", lambda *_: next(shares, 0.5))


def test_a_training_on_a_plateau_begins_anew_with_a_smaller_learning_rate(
    fit: Fit, checkpoint: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plateaus(monkeypatch, 2)
    settings = {"epochs": 6, "schedule": "constant", "learning_rate": 0.008}
    told: list[int] = []
    trained = fit(training=settings, progress=lambda done, *_: told.append(done))
    assert trained.restarts == 2
    assert told == [*range(1, 6), *range(1, 6), *range(1, 7)]
    assert torch.load(checkpoint, weights_only=True)["optimiser"]["param_groups"][0]["lr"] == pytest.approx(0.0005)
    assert len(trained.history["train/prediction"]) == 6


def test_a_training_that_is_interrupted_after_a_restart_ends_bit_for_bit_like_another(
    fit: Fit, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plateaus(monkeypatch, 2)
    settings = {"epochs": 8, "restarts": 1}
    whole = fit(tmp_path / "whole.pt", training=settings)
    with pytest.raises(KeyboardInterrupt):
        fit(progress=interrupt_at(7), training=settings)
    resumed = fit(training=settings)
    assert same(whole, resumed)
    assert (resumed.restarts, resumed.resumed_from) == (1, 7)


def test_a_training_that_ends_worse_than_the_mean_change_has_failed(fit: Fit, tmp_path: Path) -> None:
    lost = fit(physics=FAR_OFF, training={"epochs": 1, "learning_rate": 1e-9})
    assert lost.unexplained > 1.0
    assert "the training failed" in lost.failure
    fitted = fit(tmp_path / "b.pt", kind="ridge")
    assert fitted.unexplained < 1.0
    assert fitted.failure == ""


# --- interrupted --------------------------------------------------------------------------------


@pytest.mark.parametrize("epoch", [1, 3, 5])
def test_an_interrupted_training_ends_bit_for_bit_like_an_uninterrupted_one(
    fit: Fit, tmp_path: Path, epoch: int
) -> None:
    whole = fit(tmp_path / "whole.pt", training={"epochs": 5})
    with pytest.raises(KeyboardInterrupt):
        fit(progress=interrupt_at(epoch), training={"epochs": 5})
    resumed = fit(training={"epochs": 5})
    assert resumed.resumed_from == epoch
    assert whole.resumed_from == 0
    assert same(whole, resumed)
    assert resumed.best_epoch == whole.best_epoch
    assert resumed.validation_rmse == whole.validation_rmse


def test_an_interruption_in_the_middle_of_an_epoch_costs_that_epoch_alone(
    fit: Fit, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = fit(tmp_path / "whole.pt", training={"epochs": 4})
    calls, objective = [0], base.objective

    def failing(*args: Any) -> Any:
        calls[0] += 1
        if calls[0] == 17:  # 6 batches and a validation per epoch: in the third
            raise KeyboardInterrupt
        return objective(*args)

    with monkeypatch.context() as patched:
        patched.setattr(base, "objective", failing)
        with pytest.raises(KeyboardInterrupt):
            fit(training={"epochs": 4})
    resumed = fit(training={"epochs": 4})
    assert resumed.resumed_from == 2
    assert same(whole, resumed)


def test_a_finished_training_is_not_trained_on(fit: Fit) -> None:
    first = fit()
    again = fit(progress=interrupt_at(4))
    assert again.resumed_from == 3
    assert same(first, again)


KILLED = """
import sys
from pathlib import Path
import json
from dynssm_ros.learning.models.registry import parse_model_config
from dynssm_ros.learning.export import save_artifact
from dynssm_ros.learning.stages import train
from dynssm_ros.signals.recording import Recording
from dynssm_ros.vehicle import load_vehicle

folder = Path(sys.argv[1])
config = parse_model_config(json.loads((folder / "config.json").read_text()), "config")
show = lambda done, total, words: print(done, flush=True)
trained = train(Recording.load(folder / "r.parquet"), config, load_vehicle("orca"), folder / "checkpoint.pt", progress=show)
save_artifact(trained, folder / "model")
"""


def test_a_killed_process_leaves_a_checkpoint_to_go_on_from_and_no_model(
    short: Recording, make_config: MakeConfig, orca: Vehicle, tmp_path: Path
) -> None:
    config = make_config(training={"epochs": 10**6, "patience": 10**6})
    short.save(tmp_path / "r.parquet")
    (tmp_path / "config.json").write_text(config.model_dump_json())
    command = [sys.executable, "-c", KILLED, str(tmp_path)]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, text=True, env=os.environ | {"OMP_NUM_THREADS": "1"}
    ) as child:
        assert child.stdout is not None
        epochs = [int(child.stdout.readline()) for _ in range(3)]
        child.kill()
    assert epochs == [1, 2, 3]
    assert child.returncode == -9
    assert not (tmp_path / "model").exists()

    killed_at = torch.load(tmp_path / "checkpoint.pt", weights_only=True)["epoch"]
    assert killed_at >= 3
    with pytest.raises(KeyboardInterrupt):  # the same, never killed
        train(short, config, orca, tmp_path / "whole.pt", progress=interrupt_at(killed_at + 1))
    with pytest.raises(KeyboardInterrupt):
        train(short, config, orca, tmp_path / "checkpoint.pt", progress=interrupt_at(killed_at + 1))
    resumed, whole = (torch.load(tmp_path / name, weights_only=True) for name in ("checkpoint.pt", "whole.pt"))
    assert resumed["epoch"] == killed_at + 1
    assert resumed["history"] == whole["history"]
    for name, value in whole["model"].items():
        assert torch.equal(resumed["model"][name], value), name


# --- checkpoints that are not ours --------------------------------------------------------------


def flipped(content: bytes, member: str) -> bytes:
    """``content`` with one bit of an archive member's data flipped."""
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        info = next(each for each in archive.infolist() if each.filename.endswith(member) and each.file_size > 100)
    name, extra = struct.unpack_from("<HH", content, info.header_offset + 26)
    at = info.header_offset + 30 + name + extra + info.file_size // 2
    return content[:at] + bytes([content[at] ^ 0x40]) + content[at + 1 :]


@pytest.mark.parametrize(
    "damage",
    [
        lambda content: content[: len(content) // 2],
        lambda content: b"",
        lambda content: b"not a checkpoint",
        lambda content: flipped(content, "data.pkl"),
        lambda content: flipped(content, "7"),
    ],
    ids=["truncated", "empty", "text", "bit flipped in a name", "bit flipped in a weight"],
)
def test_a_damaged_checkpoint_is_ignored(fit: Fit, checkpoint: Path, damage: Callable[[bytes], bytes]) -> None:
    first = fit()
    checkpoint.write_bytes(damage(checkpoint.read_bytes()))
    again = fit()
    assert again.resumed_from == 0
    assert same(first, again)


def test_the_checkpoint_of_another_training_is_ignored(
    short: Recording, make_config: MakeConfig, orca: Vehicle, checkpoint: Path, drive: Callable[..., Recording]
) -> None:
    base = make_config(training={"epochs": 1})
    cases = [
        (short, make_config(training={"epochs": 1, "seed": 5}), orca),
        (short, make_config(training={"epochs": 1}, history=0.06), orca),
        (short, base, orca.with_nominal((orca.nominal + orca.lower) / 2)),
        (drive(orca, 400, seed=9), base, orca),
    ]
    for recording, config, vehicle in cases:
        train(short, base, orca, checkpoint)
        assert train(recording, config, vehicle, checkpoint).resumed_from == 0
    assert train(*cases[-1], checkpoint).resumed_from == 1


class Harmful:
    """Makes a file when it is unpickled."""

    def __init__(self, marker: Path) -> None:
        self.marker = marker

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, (str(self.marker),)


@pytest.mark.parametrize("kind", ["pickle", "torch archive", "old torch file"])
def test_nothing_is_unpickled_from_a_checkpoint(fit: Fit, checkpoint: Path, tmp_path: Path, kind: str) -> None:
    harmful = Harmful(tmp_path / "executed")
    if kind == "pickle":
        checkpoint.write_bytes(pickle.dumps(harmful))
    else:
        torch.save({"model": harmful}, checkpoint, _use_new_zipfile_serialization=kind == "torch archive")
    assert zipfile.is_zipfile(checkpoint) == (kind == "torch archive")
    assert fit(training={"epochs": 1}).resumed_from == 0
    assert not (tmp_path / "executed").exists()
    execute, arguments = harmful.__reduce__()
    execute(*arguments)
    assert (tmp_path / "executed").exists(), "the bait is harmless"


# --- when it ends -------------------------------------------------------------------------------


def test_it_stops_after_as_many_epochs_without_progress_as_patience_says(fit: Fit) -> None:
    trained = fit(training={"epochs": 50, "patience": 3, "learning_rate": 0.5})
    epochs = len(trained.history["train/prediction"])
    assert epochs == trained.best_epoch + 3 < 50


def test_a_training_that_diverges_at_once_is_a_clear_error(fit: Fit) -> None:
    with pytest.raises(ConfigurationError, match=r"model small: diverged .* smaller learning_rate than 1e\+30"):
        fit(training={"learning_rate": 1e30})


def test_a_training_that_diverges_later_keeps_the_best_it_had(fit: Fit, monkeypatch: pytest.MonkeyPatch) -> None:
    validate = training_module.Optimisation._validate

    def diverging(self: Any) -> dict[str, float]:
        terms = validate(self)
        return terms if self.state.epoch < 2 else dict.fromkeys(terms, float("nan"))

    monkeypatch.setattr(training_module.Optimisation, "_validate", diverging)
    trained = fit(training={"epochs": 9})
    assert len(trained.history["validation/prediction"]) == 2
    assert np.isfinite(trained.validation_rmse).all()


def test_another_sampling_time_is_refused(
    short: Recording, make_config: MakeConfig, orca: Vehicle, checkpoint: Path
) -> None:
    slower = orca.model_copy(update={"sampling_time": 0.04})
    with pytest.raises(RecordingError, match=r"sampling time 0\.02 s, but vehicle orca has 0\.04 s; .*--rate 25"):
        train(short, make_config(), slower, checkpoint)


def test_a_device_that_is_not_there_is_refused() -> None:
    check_device("cpu")
    with pytest.raises(ConfigurationError, match=r"^device tpu: not available here; expected cpu"):
        check_device("tpu")


# --- what it learns -----------------------------------------------------------------------------


def persistence(recording: Recording, config: ModelConfig) -> np.ndarray:
    """RMSE of predicting no change, on the validation windows."""
    _, increment = split_windows(recording, config.rows(0.02), config.training, 0.0, config.training.batch_size)[
        1
    ].batch(slice(None))
    return increment.square().mean(0).sqrt().numpy()


@pytest.mark.parametrize("name", ["whole", pytest.param("neural_only", marks=pytest.mark.slow)])
def test_it_learns_a_car_whose_coefficients_are_wrong(
    laps: Recording, make_config: MakeConfig, orca: Vehicle, checkpoint: Path, name: str
) -> None:
    lacks: dict[str, Any] = {} if name == "whole" else {"physics": None, "adaptation": None, "residual": {"scale": 3.0}}
    changes = {"physics": {"nominal": "mid_range"}} | lacks
    config = make_config(**changes, training={"epochs": 25, "learning_rate": 0.02})
    trained = train(laps, config, orca, checkpoint)
    assert (np.array(trained.validation_rmse) < 0.7 * persistence(laps, config)).all()
    assert trained.history["train/prediction"][-1] < trained.history["train/prediction"][0]


def test_ridge_regression_recovers_a_linear_car(make_config: MakeConfig, orca: Vehicle, checkpoint: Path) -> None:
    rng = np.random.default_rng(4)
    N, H = 1200, 3
    W = 0.02 * rng.standard_normal((3, H, 7))
    W[:, -1, :3] -= 0.1 * np.eye(3)  # stable
    matrix = np.zeros((N, 7))
    matrix[:, 3:] = rng.standard_normal((N, 4))
    for k in range(H - 1, N - 1):
        matrix[k + 1, :3] = matrix[k, :3] + np.einsum("chj,hj->c", W, matrix[k - H + 1 : k + 1]) + [0.01, 0.0, -0.02]
    info = RecordingInfo(sampling_time=0.02, commands="topics", source=("linear",))
    columns = {name: matrix[:, k] for k, name in enumerate(WINDOW_COLUMNS)}
    time = np.arange(N, dtype=np.int64) * 20_000_000
    recording = Recording(info, time, np.zeros(N, np.int32), columns)
    config = RidgeConfig(name="linear", history=0.02 * H, penalty=1e-6)
    recording.columns["v_x"] += 5.0  # the car drives forwards
    trained = train(recording, config, orca, checkpoint)
    assert (np.array(trained.validation_rmse) < 1e-5 * np.array(trained.normalisation.state_scale)).all()
    std, s_delta = np.array(trained.normalisation.input_std), np.array(trained.normalisation.increment_scale)
    found = trained.model.linear.weight.detach().numpy().reshape(3, H, 7)  # type: ignore[union-attr, operator]
    np.testing.assert_allclose(found * s_delta[:, None, None] / std, W, atol=1e-5)
    assert trained.history == {}
    assert not checkpoint.exists()


def test_a_strong_penalty_leaves_the_mean_increment(
    laps: Recording, make_config: MakeConfig, orca: Vehicle, checkpoint: Path
) -> None:
    config = RidgeConfig(name="flat", history=0.08, penalty=1e12)
    trained = train(laps, config, orca, checkpoint)
    windows, _ = split_windows(laps, config.rows(0.02), config.training, 0.0, 1)
    window, target = windows.batch(slice(None))
    with torch.no_grad():
        predicted = trained.model(window).increment
    np.testing.assert_allclose(predicted.numpy(), np.tile(target.mean(0).numpy(), (len(windows), 1)), atol=1e-7)
