"""From a trained model to its folder: what was trained is what is deployed, and what is noted about it is true."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime as ort
import pytest
import torch
import yaml

from dynssm_ros.errors import ArtifactError, ConfigurationError
from dynssm_ros.files import checksum
from dynssm_ros.learning import export as export_module
from dynssm_ros.learning.dataset import TrainingWindows
from dynssm_ros.learning.export import TOLERANCE, check_export, check_replaceable, load_torch, save_artifact
from dynssm_ros.learning.models.base import ModelConfig
from dynssm_ros.learning.models.registry import parse_model_config
from dynssm_ros.learning.stages import Trained, train
from dynssm_ros.runtime.artifact import Artifact, open_artifact
from dynssm_ros.runtime.onnx_model import OnnxModel
from dynssm_ros.signals.recording import Recording
from dynssm_ros.vehicle import Vehicle

MakeConfig = Callable[..., ModelConfig]
KINDS: dict[str, dict[str, Any]] = {
    "whole": {"residual": {"inputs": "raw"}},
    "deep": {"ssm": {"layers": 3}, "gru": {"layers": 2}, "physics": {"integrator": "rk4", "substeps": 2}},
    "no_ssm": {"ssm": None},
    "no_gru": {"gru": None},
    "no_adaptation": {"adaptation": None},
    "no_residual": {"residual": None},
    "neural_only": {"physics": None, "adaptation": None},
    "ridge": {"kind": "ridge"},
}


@pytest.fixture(scope="module")
def trained(
    laps: Recording,
    make_config: MakeConfig,
    orca: Vehicle,
    tmp_path_factory: pytest.TempPathFactory,
) -> Callable[[str], Trained]:
    """Trained models of each kind, two epochs old."""
    made: dict[str, Trained] = {}

    def get(kind: str) -> Trained:
        if kind not in made:
            config = make_config(**KINDS[kind]).with_training(epochs=2, learning_rate=0.03)
            made[kind] = train(laps, config, orca, tmp_path_factory.mktemp(kind) / "checkpoint.pt")
        return made[kind]

    return get


@pytest.fixture(scope="module")
def artifact(trained: Callable[[str], Trained], tmp_path_factory: pytest.TempPathFactory) -> Artifact:
    return save_artifact(trained("whole"), tmp_path_factory.mktemp("artifact") / "model", {"holdout": 0.2})


def some_windows(recording: Recording, count: int, H: int = 4) -> torch.Tensor:
    ends = np.linspace(H, len(recording) - 2, count).astype(int)
    return TrainingWindows(torch.tensor(recording.matrix, dtype=torch.float32), torch.tensor(ends), H).batch(
        slice(None)
    )[0]


@pytest.mark.parametrize("kind", [pytest.param(kind, marks=[pytest.mark.slow] * (kind == "deep")) for kind in KINDS])
def test_the_deployed_graph_is_the_trained_model(
    trained: Callable[[str], Trained], laps: Recording, tmp_path: Path, kind: str
) -> None:
    model = trained(kind)
    session = ort.InferenceSession(save_artifact(model, tmp_path / "model").onnx)
    names = [output.name for output in session.get_outputs()]
    width = model.vehicle.upper - model.vehicle.lower
    scale = {"increment": model.normalisation.state_scale, "physics": model.normalisation.state_scale, "theta": width}
    for batch in (1, 2, 7):
        window = some_windows(laps, batch)
        with torch.no_grad():
            output = model.model(window)
        found = dict(zip(names, session.run(None, {"window": window.numpy()}), strict=True))
        for name, unit in scale.items():
            expected = getattr(output, name)
            assert (expected is None) == (name not in found)
            if expected is not None:
                assert np.abs((found[name] - expected.numpy()) / unit).max() < TOLERANCE, name


def test_the_graph_is_simplified_once_and_for_all(artifact: Artifact, tmp_path: Path) -> None:
    options = ort.SessionOptions()
    options.graph_optimization_level = ort.GraphOptimizationLevel.ORT_ENABLE_BASIC
    options.optimized_model_filepath = str(tmp_path / "again.onnx")
    ort.InferenceSession(artifact.onnx, options)
    deployed, again = onnx.load(artifact.onnx), onnx.load(tmp_path / "again.onnx")
    assert [each.domain for each in deployed.opset_import] == [""], "standard operators alone"
    assert len(deployed.graph.node) == len(again.graph.node)


def test_the_recurrence_is_deployed(artifact: Artifact) -> None:
    graph = onnx.load(artifact.onnx).graph
    kinds = [node.op_type for node in graph.node]
    assert not {"Einsum", "Exp", "Expm1", "ScatterND", "Loop", "Scan"} & set(kinds)
    assert kinds.count("GRU") == 1
    # x <- A x + u in the shape of the states (2 states, 4 channels), for each row of the window
    decay = {t.name for t in graph.initializer if list(t.dims) == [2, 4]}
    constants = {n.output[0] for n in graph.node if n.op_type == "Constant" and list(n.attribute[0].t.dims) == [2, 4]}
    steps = [n for n in graph.node if n.op_type == "Mul" and set(n.input) & (decay | constants)]
    assert len(steps) >= 3


def test_a_standing_car_is_predicted(artifact: Artifact) -> None:
    model = OnnxModel(artifact)
    found = model.predict(np.zeros((1, 4, 7)))
    with torch.no_grad():
        expected = load_torch(artifact)(torch.zeros(1, 4, 7))
    assert np.isfinite(found.state).all()
    np.testing.assert_allclose(found.state, expected.increment.numpy(), atol=1e-6)


def test_the_trained_model_is_left_as_it_was(trained: Callable[[str], Trained], tmp_path: Path) -> None:
    model = trained("whole").model
    before = {name: value.clone() for name, value in model.state_dict().items()}
    save_artifact(trained("whole"), tmp_path / "model")
    assert not model.fusion.ssm.recurrent  # type: ignore[union-attr]
    assert all(torch.equal(value, before[name]) for name, value in model.state_dict().items())


@pytest.mark.parametrize("kind", ["whole", "neural_only", "ridge"])
def test_the_weights_come_back(trained: Callable[[str], Trained], laps: Recording, tmp_path: Path, kind: str) -> None:
    original = trained(kind)
    loaded = load_torch(save_artifact(original, tmp_path / "model"))
    for name, value in original.model.state_dict().items():
        assert torch.equal(loaded.state_dict()[name], value), name
    window = some_windows(laps, 9)
    for ours, its in zip(loaded.parameters(), original.model.parameters(), strict=True):
        ours.requires_grad_(its.requires_grad)  # of frozen layers torch adds up in another order
    with torch.no_grad():
        assert torch.equal(loaded(window).increment, original.model(window).increment)


def test_the_card_says_what_the_model_is(artifact: Artifact, trained: Callable[[str], Trained]) -> None:
    card, model = artifact.card, trained("whole")
    assert (card.name, card.kind, card.window, card.sampling_time) == ("small", "dynssm", 4, 0.02)
    assert card.commands == "topics"
    assert card.vehicle == model.vehicle
    assert card.normalisation == model.normalisation
    np.testing.assert_allclose(card.covariance, np.square(model.validation_rmse))
    assert card.parameters == sum(parameter.numel() for parameter in model.model.parameters())
    assert parse_model_config(card.architecture, "card") == model.config
    assert card.training == {"recordings": ["drive 0"], "seed": 0, "holdout": 0.2}
    assert {name: checksum(artifact.path / name) for name in card.checksums} == card.checksums


def test_the_metrics_tell_of_the_training(artifact: Artifact, trained: Callable[[str], Trained]) -> None:
    metrics, model = json.loads((artifact.path / "metrics.json").read_text()), trained("whole")
    assert list(metrics["validation_rmse"].values()) == pytest.approx(model.validation_rmse)
    assert metrics["windows"] == {"training": model.windows[0], "validation": model.windows[1]}
    assert metrics["history"] == model.history
    assert metrics["onnx_difference"] < TOLERANCE


def test_operations_of_a_ridge_are_two_per_weight(trained: Callable[[str], Trained], tmp_path: Path) -> None:
    card = save_artifact(trained("ridge"), tmp_path / "model").card
    assert card.flops == 2 * 4 * 7 * 3
    assert card.parameters == 4 * 7 * 3 + 3


def test_operations_of_a_dynssm_are_those_of_its_matrix_products(artifact: Artifact) -> None:
    H, channels, hidden = 4, 4, 4
    project, gru = H * 7 * channels, H * (7 + hidden) * 3 * hidden
    fusion = (7 + channels + hidden) * 8 + 8 * 6
    head = (6 + 7) * 6 + 6 * 17
    q = 6 + 7 + 17 + 6
    residual = q * 8 + 8 * 3 + q * 3
    kernel = H * channels * 2  # the impulse response from its states
    assert artifact.card.flops == 2 * (project + gru + fusion + head + residual + kernel)


# --- when something is in the way ---------------------------------------------------------------


def test_an_interrupted_save_leaves_the_old_model(
    trained: Callable[[str], Trained], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "model"
    save_artifact(trained("ridge"), out)
    before = {path.name: path.read_bytes() for path in out.iterdir()}

    def interrupted(*_: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(export_module, "write_card", interrupted)
    with pytest.raises(KeyboardInterrupt):
        save_artifact(trained("whole"), out)
    assert {path.name: path.read_bytes() for path in out.iterdir()} == before
    assert [path.name for path in tmp_path.iterdir()] == ["model"]


def test_an_older_model_is_replaced_as_a_whole(trained: Callable[[str], Trained], tmp_path: Path) -> None:
    out = tmp_path / "model"
    save_artifact(trained("ridge"), out)
    (out / "losses.png").write_bytes(b"old")
    assert save_artifact(trained("whole"), out).card.kind == "dynssm"
    assert not (out / "losses.png").exists()


@pytest.mark.parametrize("make", [Path.mkdir, Path.touch])
def test_what_is_no_model_folder_is_not_replaced(
    trained: Callable[[str], Trained], tmp_path: Path, make: Callable[[Path], None]
) -> None:
    out = tmp_path / "measurements"
    make(out)
    with pytest.raises(ArtifactError, match="measurements: exists and is not a model folder; not replaced"):
        save_artifact(trained("ridge"), out)
    with pytest.raises(ArtifactError, match="not replaced"):
        check_replaceable(out)
    check_replaceable(tmp_path / "new")


def test_an_architecture_that_this_version_does_not_know_is_one_clear_line(artifact: Artifact, tmp_path: Path) -> None:
    folder = shutil.copytree(artifact.path, tmp_path / "model")
    card = yaml.safe_load((folder / "model.yaml").read_text())
    card["architecture"]["attention"] = {"heads": 4}
    (folder / "model.yaml").write_text(yaml.safe_dump(card))
    with pytest.raises(ConfigurationError, match=r"model\.yaml: architecture: attention: Extra inputs") as refused:
        load_torch(open_artifact(folder))
    assert "\n" not in str(refused.value)


def test_a_graph_that_differs_from_the_model_is_refused(
    trained: Callable[[str], Trained], artifact: Artifact, laps: Recording
) -> None:
    other = load_torch(artifact)
    with torch.no_grad():
        other.residual.network[-1].bias += 1e-2  # type: ignore[union-attr, operator, index]
    scale = np.array(trained("whole").normalisation.state_scale)
    with pytest.raises(
        ArtifactError, match=r"model\.onnx: differs from torch by .* of a state's scale \(at most 1e-05"
    ):
        check_export(other, some_windows(laps, 20), artifact.onnx, scale)


def test_a_graph_that_yields_nan_is_refused(
    trained: Callable[[str], Trained], artifact: Artifact, laps: Recording
) -> None:
    window = some_windows(laps, 3)
    window[1, 2, 0] = torch.nan
    with pytest.raises(ArtifactError, match="differs from torch by nan"):
        check_export(load_torch(artifact), window, artifact.onnx, np.ones(3))
