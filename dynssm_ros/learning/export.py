"""A trained model to its artifact: weights, ONNX graph checked against torch, card, metrics."""

from __future__ import annotations

import copy
import io
import json
import logging
import os
import warnings
from collections.abc import Callable
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime as ort
import torch
from safetensors.torch import load_file
from torch import Tensor, nn
from torch.utils.flop_counter import FlopCounterMode

from dynssm_ros.errors import ArtifactError
from dynssm_ros.files import checksum, replacing
from dynssm_ros.learning.losses import Output
from dynssm_ros.learning.models.base import TrainableModel
from dynssm_ros.learning.models.registry import build_model, parse_model_config
from dynssm_ros.learning.stages import Trained
from dynssm_ros.runtime.artifact import (
    CARD,
    METRICS,
    ONLINE,
    ONNX,
    WEIGHTS,
    Artifact,
    ModelCard,
    open_artifact,
    write_card,
)
from dynssm_ros.runtime.online import save_layer
from dynssm_ros.runtime.tensors import as_tensors

LOSSES = "losses.png"
TOLERANCE = 1e-5  # largest difference between ONNX and torch, in units of each state's scale
_GRU_INITIAL_STATE = 5  # among the inputs of ONNX's GRU


class _Deployed(nn.Module):
    """The outputs that are deployed, as a flat tuple."""

    def __init__(self, model: TrainableModel) -> None:
        super().__init__()
        self.model = copy.deepcopy(model).eval().for_deployment()

    def named(self, window: Tensor) -> dict[str, Tensor]:
        """The outputs by name."""
        output: Output = self.model(window)
        named = {name: getattr(output, name) for name in ("increment", "theta", "physics")}
        return {name: value for name, value in named.items() if value is not None}

    def forward(self, window: Tensor) -> tuple[Tensor, ...]:
        return tuple(self.named(window).values())


def save_artifact(
    trained: Trained,
    out: Path,
    training: dict[str, object] | None = None,
    picture: Callable[[Trained, Path], None] | None = None,
) -> Artifact:
    """Writes the model folder, atomically; an older one of the same name is replaced.

    Args:
        trained: outcome of :func:`dynssm_ros.learning.stages.train`.
        out: the folder.
        training: what to note about how it was trained.
        picture: draws the training to the file that it is given; that is no part of the model.

    Raises:
        ArtifactError: ``out`` is something else, or the exported graph differs from the trained model.
    """
    check_replaceable(out)
    model = trained.model
    sample = _sample_windows(trained)
    with replacing(out, may_hold=(ONLINE, LOSSES)) as folder:
        folder.mkdir()
        weights = {name: value.numpy(force=True) for name, value in model.state_dict().items()}
        (folder / WEIGHTS).write_bytes(as_tensors(weights))
        metrics = _metrics(trained)
        if trained.deploys_network:
            export_onnx(model, sample, folder / ONNX)
            scale = np.array(trained.normalisation.state_scale)
            metrics["onnx_difference"] = check_export(model, sample, folder / ONNX, scale)
        if trained.online is not None:
            save_layer(trained.online, folder / ONLINE)
        if trained.start is not None:
            metrics["start"] = _metrics(trained.start)
        (folder / METRICS).write_text(json.dumps(metrics, indent=1), encoding="utf-8")
        write_card(_card(trained, folder, training or {}), folder)
        if picture is not None and trained.history:
            picture(trained, folder / LOSSES)
    return open_artifact(out)


def _card(trained: Trained, folder: Path, training: dict[str, object]) -> ModelCard:
    """The card of a model whose other files are in ``folder``."""
    model, config, info = trained.model, trained.config, trained.recording.info
    integrator, substeps = config.with_physics.stepping(trained.vehicle)
    return ModelCard(
        name=config.name,
        kind=config.kind,
        architecture=config.model_dump(mode="json"),
        vehicle=trained.vehicle,
        sampling_time=trained.vehicle.sampling_time,
        window=trained.H,
        commands=info.commands,
        held=info.held,
        integrator=integrator,
        substeps=substeps,
        normalisation=trained.normalisation,
        slowest=_slowest(trained),
        network=trained.deploys_network,
        covariance=_covariance(trained),
        online=None if trained.online is None else trained.online.card,
        parameters=sum(p.numel() for p in model.parameters()),
        flops=count_flops(model, trained.H) if trained.deploys_network else 0,
        training={"recordings": list(info.source), "seed": config.training.seed, **training},
        laps=trained.recording.fingerprints,
        checksums={each.name: checksum(each) for each in sorted(folder.iterdir())},
    )


def _covariance(trained: Trained) -> tuple[float, float, float]:
    """One-step error variances of what is deployed: on validation data, without a network the physics' on the laps."""
    if trained.deploys_network or trained.online is None:
        v_x, v_y, omega = (value**2 for value in trained.validation_rmse)
    else:
        v_x, v_y, omega = (trained.online.physics * trained.online.scale**2).tolist()
    return v_x, v_y, omega


def _metrics(trained: Trained) -> dict[str, Any]:
    return {
        "validation_rmse": dict(zip(("v_x", "v_y", "omega"), trained.validation_rmse, strict=True)),
        "windows": dict(zip(("training", "validation"), trained.windows, strict=True)),
        "unexplained": trained.unexplained,
        "best_epoch": trained.best_epoch,
        "restarts": trained.restarts,
        "network_gain": trained.network_gain,
        "throttle_gain": trained.throttle_gain,
        "history": trained.history,
    }


def check_replaceable(out: Path) -> None:
    """Checks that a model folder may be written to ``out``, before a training is spent on it.

    Raises:
        ArtifactError: something else is there.
    """
    if os.path.exists(out) and not os.path.isfile(out / CARD):
        raise ArtifactError(f"{out}: exists and is not a model folder; not replaced")


def export_onnx(model: TrainableModel, sample: Tensor, file: Path) -> None:
    """Writes the deployed graph: input ``window`` (N, H, 7), outputs ``increment``, and what else it has."""
    deployed = _Deployed(model)
    with torch.no_grad():
        names = list(deployed.named(sample[:1]))
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)
    with warnings.catch_warnings(), redirect_stdout(io.StringIO()):
        warnings.simplefilter("ignore")  # the exporter's own deprecations are not the user's concern
        torch.onnx.export(
            deployed,
            (sample[:2],),
            file,
            input_names=["window"],
            output_names=names,
            dynamic_axes={name: {0: "N"} for name in ("window", *names)},
            opset_version=17,
            dynamo=False,
        )
    _start_recurrences_from_rest(file)
    _simplify(file)


def _start_recurrences_from_rest(file: Path) -> None:
    """Drops the zeros that the exporter computes, window by window, as the first hidden state: absent means zero."""
    graph = onnx.load(file)
    for node in graph.graph.node:
        if node.op_type == "GRU" and len(node.input) > _GRU_INITIAL_STATE:
            del node.input[_GRU_INITIAL_STATE:]
    onnx.save(graph, file)


def _simplify(file: Path) -> None:
    """Folds constants and drops what does nothing, once and for all: a node that swaps models has no time for it."""
    options = ort.SessionOptions()
    options.graph_optimization_level = ort.GraphOptimizationLevel.ORT_ENABLE_BASIC  # leaves standard operators alone
    options.optimized_model_filepath = str(file)
    ort.InferenceSession(file.read_bytes(), options, providers=["CPUExecutionProvider"])
    graph = onnx.load(file)
    used = [each for each in graph.opset_import if each.domain in {node.domain for node in graph.graph.node}]
    del graph.opset_import[:]
    graph.opset_import.extend(used)
    onnx.save(graph, file)


def check_export(model: TrainableModel, sample: Tensor, file: Path, scale: np.ndarray) -> float:
    """Compares ONNX Runtime with torch on ``sample``.

    Returns:
        The largest difference of the predicted state in units of ``scale``.

    Raises:
        ArtifactError: it exceeds ``TOLERANCE``.
    """
    session = ort.InferenceSession(file, providers=["CPUExecutionProvider"])
    with torch.no_grad():
        expected = model(sample).increment.numpy()
    found = session.run(["increment"], {"window": sample.numpy()})[0]
    difference = float((np.abs(found - expected) / scale).max())
    if not difference <= TOLERANCE:
        raise ArtifactError(
            f"{file.name}: differs from torch by {difference:.1e} of a state's scale (at most {TOLERANCE:g})"
        )
    return difference


def count_flops(model: TrainableModel, H: int) -> int:
    """Floating-point operations of one prediction's matrix products, counted by torch."""
    with FlopCounterMode(display=False) as counter, torch.no_grad():
        model(torch.zeros(1, H, 7))
    return int(counter.get_total_flops())


def load_torch(artifact: Artifact) -> TrainableModel:
    """The trained model back in torch, for comparison and further training."""
    card = artifact.card
    config = parse_model_config(card.architecture, f"{artifact.path / CARD}: architecture")
    model = build_model(config, card.vehicle, card.normalisation)
    try:
        model.load_state_dict(load_file(artifact.weights))
    except RuntimeError as error:
        reason = " ".join(str(error).split())
        raise ArtifactError(f"{artifact.weights}: not the weights of the model of {CARD} ({reason})") from error
    return model.eval()


def _slowest(trained: Trained) -> float:
    """Least ``v_x`` (m/s) of the windows that it was trained and validated on."""
    ends = trained.recording.window_ends(trained.H, min_speed=trained.vehicle.minimum_speed)
    return float(trained.recording["v_x"][ends].min())


def _sample_windows(trained: Trained, count: int = 256) -> Tensor:
    """Windows spread over the training data."""
    ends = trained.recording.window_ends(trained.H, min_speed=trained.vehicle.minimum_speed)
    chosen = ends[np.linspace(0, len(ends) - 1, count).astype(int)]
    return torch.tensor(trained.recording.windows(chosen, trained.H), dtype=torch.float32)
