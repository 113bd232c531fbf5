"""FTHD: the physics loss against closed forms, what is frozen, and two stages that resume as one training."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from benchmarks.rivals.ddm import DDM
from benchmarks.rivals.fthd import consecutive, physics_loss
from dynssm_ros.learning.export import save_artifact
from dynssm_ros.learning.models.base import ModelConfig
from dynssm_ros.learning.models.registry import parse_model_config
from dynssm_ros.learning.stages import Trained, checkpoints, train
from dynssm_ros.runtime.artifact import Normalisation
from dynssm_ros.runtime.baselines import SingleTrack
from dynssm_ros.signals.recording import Recording
from dynssm_ros.vehicle import Vehicle

MakeConfig = Callable[..., ModelConfig]
UNIT = Normalisation(input_mean=(0.0,) * 7, input_std=(1.0,) * 7, state_scale=(1.0,) * 3, increment_scale=(1.0,) * 3)


@pytest.fixture(scope="module")
def short(drive: Callable[..., Recording], orca: Vehicle) -> Recording:
    """8 s of the small car."""
    return drive(orca, 400)


def with_coefficients(config: ModelConfig, vehicle: Vehicle, theta: np.ndarray) -> DDM:
    """A DDM that gives ``theta`` for every window."""
    model = DDM(config, vehicle, UNIT)
    share = (theta - vehicle.lower) / (vehicle.upper - vehicle.lower)
    with torch.no_grad():
        model.dense[-1].weight.zero_()  # type: ignore[operator]
        model.dense[-1].bias.copy_(torch.logit(torch.tensor(share)))  # type: ignore[operator]
    return model


# --- the physics loss ---------------------------------------------------------------------------


def loss_of(model: DDM, windows: np.ndarray, unit: tuple[float, float, float] = (1.0, 1.0, 1.0)) -> float:
    pairs = torch.tensor(windows, dtype=torch.float32)
    with torch.no_grad():
        return physics_loss(model, pairs, *consecutive(model, pairs), torch.tensor(unit)).item()


def test_the_car_that_drove_agrees_with_its_physics(make_ddm: MakeConfig, short: Recording, orca: Vehicle) -> None:
    windows = np.stack([short.matrix[k : k + 5] for k in range(50, 90)])
    assert loss_of(with_coefficients(make_ddm(), orca, orca.nominal), windows) < 1e-5


def test_neighbouring_windows_are_predicted_as_each_alone(
    make_ddm: MakeConfig, short: Recording, orca: Vehicle
) -> None:
    torch.manual_seed(0)
    model = DDM(make_ddm(), orca, UNIT)
    pairs = torch.tensor(np.stack([short.matrix[k : k + 5] for k in range(50, 90)]), dtype=torch.float32)
    with torch.no_grad():
        together = consecutive(model, pairs)
        for one, rows in zip(together, (pairs[:, :-1], pairs[:, 1:]), strict=True):
            alone = model(rows)
            assert one.increment.numpy() == pytest.approx(alone.increment.numpy(), rel=1e-5, abs=1e-7)
            assert one.theta.numpy() == pytest.approx(alone.theta.numpy(), rel=1e-5)
            assert one.deviation is alone.deviation is None


def test_the_loss_is_what_two_steps_of_another_car_disagree(
    make_ddm: MakeConfig, short: Recording, orca: Vehicle
) -> None:
    theta, unit = 0.4 * orca.lower + 0.6 * orca.upper, (0.5, 0.2, 4.0)
    other = SingleTrack(orca.with_nominal(theta))
    windows = np.stack([short.matrix[k : k + 5] for k in range(50, 60)])
    state, following = (other.predict(windows[:, : k + 1]).state for k in (3, 4))
    imagined = np.concatenate([state, windows[:, -1, 3:]], axis=1)
    advance = other.predict(imagined[:, None]).state - state
    expected = (((following - state - advance) / 0.02 / unit) ** 2).mean()
    assert expected > 0.1
    assert loss_of(with_coefficients(make_ddm(), orca, theta), windows, unit) == pytest.approx(expected, rel=1e-3)


@pytest.fixture
def fit(short: Recording, make_fthd: MakeConfig, orca: Vehicle, tmp_path: Path) -> Callable[..., Trained]:
    """Trains the small FTHD, with other fields of ``fine_tuning``; ``at`` is its checkpoint."""

    def train_it(at: str = "c.pt", progress: Any = None, **changes: Any) -> Trained:
        return train(short, make_fthd(**changes), orca, tmp_path / at, progress=progress)

    return train_it


# --- two stages ---------------------------------------------------------------------------------


def weights(trained: Trained | None) -> dict[str, torch.Tensor]:
    assert trained is not None
    return trained.model.state_dict()


def same(a: Trained, b: Trained) -> bool:
    ours, theirs = weights(a), weights(b)
    return a.history == b.history and all(torch.equal(ours[name], theirs[name]) for name in ours)


@pytest.fixture(scope="module")
def whole(short: Recording, make_fthd: MakeConfig, orca: Vehicle, tmp_path_factory: pytest.TempPathFactory) -> Trained:
    """The small FTHD, never interrupted."""
    return train(short, make_fthd(), orca, tmp_path_factory.mktemp("whole") / "c.pt")


def test_it_starts_from_the_ddm_that_training_alone_gives(
    whole: Trained, short: Recording, make_ddm: MakeConfig, orca: Vehicle, tmp_path: Path
) -> None:
    alone = train(short, make_ddm(), orca, tmp_path / "ddm.pt")
    assert whole.start is not None
    assert same(whole.start, alone)
    assert whole.normalisation == alone.normalisation


def test_frozen_layers_stay_and_the_others_learn(whole: Trained) -> None:
    before, after = weights(whole.start), weights(whole)
    changed = {name.rsplit(".", 1)[0] for name in after if not torch.equal(before[name], after[name])}
    assert changed == {"dense.1.0", "dense.2"}  # 0 is frozen, as is the GRU


def test_the_physics_loss_is_part_of_the_history_by_its_weight(whole: Trained, fit: Callable[..., Trained]) -> None:
    assert min(whole.history["validation/physics"]) > 0
    without = fit(physics=0.0)
    assert without.history["validation/physics"] == [0.0, 0.0]
    assert not torch.equal(weights(without)["dense.2.weight"], weights(whole)["dense.2.weight"])


def test_it_lowers_both_losses_of_a_car_that_its_ddm_does_not_know_well(
    short: Recording, make_fthd: MakeConfig, orca: Vehicle, tmp_path: Path
) -> None:
    config = make_fthd(frozen=0.4, physics=0.0004).with_training(epochs=8, learning_rate=0.01)
    trained = train(short, config, orca, tmp_path / "c.pt")
    assert trained.start is not None
    assert min(trained.history["validation/prediction"]) < min(trained.start.history["validation/prediction"])
    assert trained.history["validation/physics"][-1] < trained.history["validation/physics"][0]


def interrupt_at(epoch: int) -> Callable[[int, int, str], None]:
    def progress(done: int, total: int, words: str) -> None:
        if done == epoch:
            raise KeyboardInterrupt

    return progress


@pytest.mark.parametrize("epoch", [2, 3, 4, 5])
def test_an_interrupted_training_ends_bit_for_bit_like_an_uninterrupted_one(
    whole: Trained, fit: Callable[..., Trained], tmp_path: Path, epoch: int
) -> None:
    with pytest.raises(KeyboardInterrupt):
        fit(progress=interrupt_at(epoch))
    kept = checkpoints(whole.config, tmp_path / "c.pt")
    assert [path.is_file() for path in kept] == [True, epoch > 3]
    done: list[int] = []
    resumed = fit(progress=lambda *args: done.append(args[0]))
    assert done == list(range(epoch + 1, 6))  # nothing is trained twice
    assert resumed.resumed_from == epoch
    assert same(resumed, whole)
    assert resumed.start
    assert whole.start
    assert same(resumed.start, whole.start)


def test_progress_covers_both_stages(fit: Callable[..., Trained]) -> None:
    told: list[tuple[int, int, str]] = []
    fit(progress=lambda *args: told.append(args))
    assert [args[:2] for args in told] == [(k, 5) for k in range(1, 6)]
    assert [words.split(":")[0] for _, _, words in told] == ["small_ddm"] * 3 + ["small_fthd"] * 2


@pytest.mark.parametrize(
    "changes", [{"start": {"training": {"learning_rate": 0.001}}}, {"physics": 0.2}, {"frozen": 0.4}]
)
def test_the_checkpoint_of_another_fine_tuning_is_ignored(fit: Callable[..., Trained], changes: dict[str, Any]) -> None:
    fit()
    again = fit(**changes)
    assert again.resumed_from == (0 if "start" in changes else 3)  # the same DDM serves another fine-tuning
    assert same(again, fit("fresh.pt", **changes))


def test_the_metrics_tell_of_both_stages(whole: Trained, tmp_path: Path) -> None:
    artifact = save_artifact(whole, tmp_path / "model")
    assert whole.start is not None
    metrics = json.loads((artifact.path / "metrics.json").read_text())
    assert metrics["history"] == whole.history
    assert metrics["start"]["history"] == whole.start.history
    assert metrics["start"]["best_epoch"] == whole.start.best_epoch
    assert parse_model_config(artifact.card.architecture, "card") == whole.config
