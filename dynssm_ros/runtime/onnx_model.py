"""Trained models, run by ONNX Runtime."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import onnxruntime as ort

from dynssm_ros.arrays import Vector
from dynssm_ros.errors import ArtifactError
from dynssm_ros.runtime.artifact import ONLINE, Artifact, ModelCard
from dynssm_ros.runtime.contract import WindowPrediction
from dynssm_ros.runtime.online import Seen
from dynssm_ros.signals.inputs import WINDOW_COLUMNS
from dynssm_ros.signals.signal_map import Commands

_AT_ONCE = 32
"""Windows that a graph sees at once. Memory that it has used stays with it: two megabytes for each of them with the paper's
encoders. More at once are no faster."""
_REPEATING = re.compile(rb"(?:\"|\xa2\x80*\x00)(?:[\x04\x0b]|[\x84\x8b]\x80*\x00)(Loop|Scan|SequenceMap)")
"""Operators that run for as long as their input says, as the format has them: field 4 of a node, length, name. Those that the
export writes take the same time whatever comes in, so that a trial tells how long a prediction takes."""
_WEIGHTS_ELSEWHERE = "session.model_external_initializers_file_folder_path"


class OnnxModel:
    """A trained model, run by ONNX Runtime on one core.

    The graph computes the increment ``s_{t+1} - s_t`` in single precision; it is added to the state in double.

    Raises:
        ArtifactError: ONNX Runtime refuses the graph, or it is not one of such a model.
    """

    _RUNS = ("_session", "_binding", "_window")

    def __init__(self, artifact: Artifact) -> None:
        card = artifact.card
        self.artifact = artifact
        self.card: ModelCard = card
        self.name = card.name
        self.T_s = card.sampling_time
        self.H = card.window
        self.commands: Commands | None = card.commands
        self.vehicle = card.vehicle
        self.parameters = card.parameters
        self.flops = card.flops
        self._validated = np.array([card.covariance])
        self.online = artifact.online_layer()
        self.prior = card.checksums.get(ONLINE, "")
        """Names the prior of its online layer, for what was learned from it; empty without one."""
        self._open()

    def __getstate__(self) -> dict[str, Any]:
        """All but what runs the graph, which each process opens for itself."""
        return {name: value for name, value in vars(self).items() if name not in self._RUNS}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._open()

    def _open(self) -> None:
        """Opens the graph."""
        if repeating := _REPEATING.search(self.artifact.graph):
            raise ArtifactError(
                f"{self.artifact.onnx}: has the operator {repeating[1].decode()}, which may never end; expected none"
            )
        options = ort.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        # the export has optimised the graph; doing it again would hold up a swap
        options.graph_optimization_level = ort.GraphOptimizationLevel.ORT_DISABLE_ALL
        options.enable_mem_reuse = False  # small tensors: planning their reuse costs more than their effect states
        options.log_severity_level = 4  # its errors are raised too
        # a single window, as in the node, always has its place in memory
        self._window = np.zeros((1, self.H, len(WINDOW_COLUMNS)), dtype=np.float32)
        try:
            # of the bytes that were checked; a graph whose weights are in other files finds none here
            options.add_session_config_entry(_WEIGHTS_ELSEWHERE, str(self.artifact.onnx / "none"))
            self._session = ort.InferenceSession(
                self.artifact.graph, options, providers=["CPUExecutionProvider"], enable_fallback=0
            )  # which would print, and try the same again
            self._outputs = [output.name for output in self._session.get_outputs()]
            inputs = [(each.name, each.shape[1:]) for each in self._session.get_inputs()]
            if inputs != [("window", [self.H, len(WINDOW_COLUMNS)])] or "increment" not in self._outputs:
                raise ArtifactError(
                    f"{self.artifact.onnx}: maps {inputs} to {self._outputs}; expected a window of {self.H} rows and "
                    f"{len(WINDOW_COLUMNS)} columns to increment, and theta, physics, variance if it has them"
                )
            self._binding = self._session.io_binding()
            self._binding.bind_cpu_input("window", self._window)
            for name in self._outputs:
                self._binding.bind_output(name)
            self._session.run_with_iobinding(self._binding)
        except ArtifactError:
            raise
        except Exception as error:  # onnxruntime raises its own unrelated classes
            raise ArtifactError(
                f"{self.artifact.onnx}: ONNX Runtime refuses it ({' '.join(str(error).split())})"
            ) from error

    @property
    def origin(self) -> str:
        """Kind, window, command protocol, vehicle and physics."""
        card = self.card
        steps = f"{card.substeps} step{'s' if card.substeps > 1 else ''}"
        physics = f", integrator {card.integrator} with {steps}" if card.architecture.get("physics") else ""
        return (
            f"{card.kind}, window {card.window} rows, trained with commands '{card.commands}', vehicle "
            f"{card.vehicle.name}{physics}"
        )

    def predict(self, windows: Vector) -> WindowPrediction:
        """Runs the graph on ``windows``; without variances of its own it has those of the validation data."""
        if len(windows) == 1:
            self._window[...] = windows
            self._session.run_with_iobinding(self._binding)
            results = self._binding.copy_outputs_to_cpu()
        else:
            blocks = np.split(windows.astype(np.float32), range(_AT_ONCE, len(windows), _AT_ONCE))
            found = [self._session.run(self._outputs, {"window": block}) for block in blocks]
            results = [np.concatenate(each) for each in zip(*found, strict=True)]
        by_name = dict(zip(self._outputs, results, strict=True))
        now, theta, physics = windows[:, -1, :3], by_name.get("theta"), by_name.get("physics")
        variance = by_name.get("variance")
        return WindowPrediction(
            now + by_name["increment"],
            None if theta is None else theta.astype(np.float64),
            None if physics is None else now + physics,
            self._validated.repeat(len(windows), axis=0) if variance is None else variance.astype(np.float64),
            None
            if self.online is None
            else Seen(by_name["features"].astype(np.float64), by_name["nominal_physics"].astype(np.float64)),
        )
