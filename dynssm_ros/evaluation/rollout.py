"""Many steps ahead: recursive rollouts and the displacement that they predict.

After the literature's protocol the predicted state is fed back into the window, while the measured actuator feedback
and the commands are supplied along the horizon.

Displacement compares paths integrated from velocities, the predicted ones and the measured ones by the same rule, both
from the same start pose. Logged positions are no reference at this scale: that of the AV-21 is corrected once a second
by up to 0.3 m, as much as the errors in question.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dynssm_ros.arrays import Indices, Vector
from dynssm_ros.evaluation.metrics import DriveThrough, Tick, batches, silent
from dynssm_ros.runtime.contract import WindowModel
from dynssm_ros.runtime.online import Learned
from dynssm_ros.runtime.onnx_model import OnnxModel
from dynssm_ros.runtime.rollout import LayerRollout, RolloutCorrection, path_errors, roll_out, step_of
from dynssm_ros.signals.recording import Recording
from dynssm_ros.vehicle.kinematics import path


@dataclass(frozen=True)
class Rollout:
    """Errors of recursive predictions, after each step of a horizon of ``n``, over a number of ``starts``.

    RMSE of the state, shape ``(n, 3)`` (m/s, m/s, rad/s), and mean distance between predicted and measured path, shape
    ``(n,)`` (m).
    """

    T_s: float
    starts: int
    rmse: Vector
    displacement: Vector

    @property
    def time(self) -> Vector:
        """Time ahead of each step (s), shape ``(n,)``."""
        return self.T_s * np.arange(1.0, len(self.displacement) + 1)

    @property
    def ade(self) -> float:
        """Average displacement error over all steps and starts (m)."""
        return float(self.displacement.mean())

    @property
    def fde(self) -> float:
        """Final displacement error, at the end of the horizon (m)."""
        return float(self.displacement[-1])

    @classmethod
    def joined(cls, parts: Sequence[Rollout]) -> Rollout:
        """Those of several stretches as one; not empty."""
        share = np.array([part.starts for part in parts]) / sum(part.starts for part in parts)
        square = np.tensordot(share, np.stack([part.rmse**2 for part in parts]), 1)
        displacement = np.tensordot(share, np.stack([part.displacement for part in parts]), 1)
        return cls(parts[0].T_s, sum(part.starts for part in parts), np.sqrt(square), displacement)


def predicted_states(
    model: WindowModel, recording: Recording, starts: Indices, steps: int, learned: Learned | None = None
) -> tuple[Vector, Vector]:
    """Predicted and measured states after ``starts``, each of shape ``(M, steps, 3)``.

    Args:
        model: to roll out.
        recording: measured rows.
        starts: last measured row of each rollout, shape ``(M,)``.
        steps: length of the horizon.
        learned: what the model's online layer had learned at the starts, and keeps over the horizon.
    """
    stretches, layer = recording.windows(starts, model.H, steps), model.online
    correction = None if layer is None or learned is None else RolloutCorrection(layer, learned)
    if correction is not None and isinstance(model, OnnxModel) and (features := model.layer_features) is not None:
        rows = np.array(stretches, order="C")
        if LayerRollout(features, correction.layer).roll_out(rows, model.H, correction.learned):
            return rows[:, model.H :, :3], stretches[:, model.H :, :3]
    return roll_out(step_of(model, correction), stretches, model.H), stretches[:, model.H :, :3]


def branches(
    model: WindowModel, recording: Recording, starts: Indices, steps: int, learned: Learned | None = None
) -> Vector:
    """Predicted paths that leave the measured one, each at its start; arguments as of :func:`predicted_states`.

    There is no gap in the recording between the first start and the last end.

    Returns:
        Positions ``x, y`` (m) from the start of each branch to its end, shape ``(M, steps + 1, 2)``, in the frame of
        :func:`path` for the measured velocities from ``starts[0]`` on.
    """
    predicted, _ = predicted_states(model, recording, starts, steps, learned)
    driven = (
        path(np.concatenate([recording.states(slice(starts[0], start + 1)), states]), recording.T_s)
        for start, states in zip(starts, predicted, strict=True)
    )
    return np.stack([np.concatenate([np.zeros((1, 2)), positions])[-steps - 1 :] for positions in driven])


def score_rollouts(
    model: WindowModel,
    recording: Recording,
    starts: Indices,
    steps: int,
    *,
    tick: Tick = silent,
    drive: DriveThrough | None = None,
) -> Rollout:
    """Rolls the model out from all ``starts`` (at least one), batch by batch, and compares with what was measured.

    ``drive`` is what the model's online layer knew along these rows.
    """
    squares, distances, T_s = np.zeros((steps, 3)), np.zeros(steps), recording.T_s
    for chunk in batches(starts):
        known = None if drive is None else drive.at(chunk)
        predicted, measured = predicted_states(model, recording, chunk, steps, known)
        squares += np.sum((predicted - measured) ** 2, axis=0)
        distances += path_errors(recording.states(chunk)[:, None], predicted, measured, T_s).sum(axis=0)
        tick(len(chunk) * steps)
    return Rollout(T_s, len(starts), np.sqrt(squares / len(starts)), distances / len(starts))
