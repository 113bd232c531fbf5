"""Trained models: the network run by ONNX Runtime, what the online layer sees of a window, the physics where it is alone."""

from __future__ import annotations

from typing import Any

import numpy as np

from dynssm_ros.arrays import Mask, Vector
from dynssm_ros.runtime.artifact import ONLINE, Artifact, ModelCard
from dynssm_ros.runtime.baselines import SingleTrack
from dynssm_ros.runtime.contract import WindowPrediction
from dynssm_ros.runtime.features import LayerFeatures
from dynssm_ros.runtime.graph import Graph
from dynssm_ros.runtime.online import Seen
from dynssm_ros.signals.inputs import WINDOW_COLUMNS
from dynssm_ros.signals.signal_map import Commands


class OnnxModel:
    """A trained model.

    Its graph computes the increment ``s_{t+1} - s_t`` in single precision; it is added to the state in double. A model
    without a network has no graph and predicts the calibrated physics, for its online layer to correct.

    Raises:
        ArtifactError: ONNX Runtime refuses the graph, or it is not one of such a model.
    """

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
        self._validated, self._nominal = np.array([card.covariance]), card.vehicle.nominal[None]
        self.online = artifact.online_layer()
        self.prior = card.checksums.get(ONLINE, "")
        """Names the prior of its online layer, for what was learned from it; empty without one."""
        self._physics = SingleTrack(card.vehicle, card.integrator, card.substeps)
        scales = card.normalisation
        self._scale = np.array(scales.increment_scale)
        self._least = card.least
        self._features: LayerFeatures | None = None
        if self.online is not None:
            self._features = LayerFeatures.of(self.online, np.array(scales.input_mean), np.array(scales.input_std))
        self._open()

    def __getstate__(self) -> dict[str, Any]:
        """All but what runs the graph, which each process opens for itself."""
        return {name: value for name, value in vars(self).items() if name != "_graph"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._open()

    def _open(self) -> None:
        self._graph: Graph | None = None
        if self.card.network:
            self._graph = Graph(self.artifact.onnx, self.artifact.graph, self.H, len(WINDOW_COLUMNS))

    @property
    def layer_features(self) -> LayerFeatures | None:
        """What the online layer sees, if nothing else predicts beside it: there is no network."""
        return self._features if self.online is not None and self._graph is None else None

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
        """Runs the graph on ``windows``; without variances of its own it has those of the validation data.

        A car that stands or reverses, unless that was trained on, is the physics' alone. That is not validated: the
        variance is at least that of an increment.
        """
        said = self._of_physics(windows) if self._graph is None else self._of_graph(self._graph, windows)
        alone = windows[:, -1, 0] < self._least
        return self._with_physics(said, windows, alone) if alone.any() else said

    def _of_graph(self, graph: Graph, windows: Vector) -> WindowPrediction:
        """What the network says, and what the online layer sees."""
        by_name = graph.run(windows)
        now, theta, physics = windows[:, -1, :3], by_name.get("theta"), by_name.get("physics")
        variance, increment = by_name.get("variance"), by_name["increment"]
        seen: Seen | None = None
        if self._features is not None:
            seen = self._features.seen(windows, increment)
        elif self.online is not None:
            seen = Seen(by_name["features"].astype(np.float64), by_name["nominal_physics"].astype(np.float64))
        return WindowPrediction(
            now + increment,
            None if theta is None else theta.astype(np.float64),
            None if physics is None else now + physics,
            self._validated.repeat(len(windows), axis=0) if variance is None else variance.astype(np.float64),
            seen,
        )

    def _of_physics(self, windows: Vector) -> WindowPrediction:
        """What the calibrated physics says, and what the online layer sees."""
        assert self._features is not None
        seen, count = self._features.seen(windows), len(windows)
        following = windows[:, -1, :3] + seen.physics
        variance, theta = self._validated.repeat(count, axis=0), self._nominal.repeat(count, axis=0)
        return WindowPrediction(following, theta, following.copy(), variance, seen)

    def _with_physics(self, said: WindowPrediction, windows: Vector, alone: Mask) -> WindowPrediction:
        """What was said, and what the nominal physics says of the windows ``alone``."""
        nominal = self._physics.predict(windows[alone])
        for part, own in zip(said[:3], nominal[:3], strict=True):
            if part is not None:
                part[alone] = own
        assert said.variance is not None
        said.variance[alone] = np.maximum(said.variance[alone], self._scale**2)
        return said
