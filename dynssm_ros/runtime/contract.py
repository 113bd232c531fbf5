"""What every model of the next state offers: windows in, next states out."""

from __future__ import annotations

import copy
from typing import NamedTuple, Protocol

from dynssm_ros.arrays import Vector
from dynssm_ros.runtime.artifact import ModelCard
from dynssm_ros.runtime.online import OnlineLayer, Seen
from dynssm_ros.signals.signal_map import Commands
from dynssm_ros.vehicle import Vehicle


class WindowPrediction(NamedTuple):
    """What a model says of each of ``N`` windows."""

    state: Vector
    """Predicted next state ``s_{t+1}``, shape ``(N, 3)`` (m/s, m/s, rad/s)."""
    theta: Vector | None
    """Adapted coefficients in the order of ``COEFFICIENTS``, shape ``(N, 17)``; ``None`` if the model has none."""
    physics: Vector | None
    """The physics' part of the prediction, shape ``(N, 3)``; ``None`` if the model has no physics."""
    variance: Vector | None = None
    """Error variances that the model states with its predictions, shape ``(N, 3)``; ``None`` if it states none."""
    seen: Seen | None = None
    """What the online layer sees; ``None`` if the model has no such layer."""

    def numbers(self) -> tuple[list[float], list[float], list[float]]:
        """State, coefficients and variances of the first window; empty where there are none.

        A few floats are judged faster than a small array.
        """
        state, theta, variance = ([] if part is None else part[0].tolist() for part in (self[0], self[1], self[3]))
        return state, theta, variance


class WindowModel(Protocol):
    """Any model that predicts one step ahead from a history window."""

    name: str
    T_s: float
    """Sampling time it is for (s); 0 if any."""
    H: int
    """Rows of the window that it reads."""
    commands: Commands | None
    """Command protocol that it was trained with; ``None`` if any."""
    parameters: int
    flops: int
    """Floating-point operations per prediction."""
    online: OnlineLayer | None
    """What learns on top of it while the car drives; ``None`` if nothing does."""

    @property
    def card(self) -> ModelCard | None:
        """What a trained model's folder says of it; ``None`` without training."""

    @property
    def origin(self) -> str:
        """Where its predictions come from, in words."""

    @property
    def vehicle(self) -> Vehicle | None:
        """Car that it is for; ``None`` if any."""

    def predict(self, windows: Vector) -> WindowPrediction:
        """Predicts from ``windows`` of shape ``(N, H, 7)``, columns ``WINDOW_COLUMNS``."""


class Untrained:
    """What models without training have in common; see :class:`WindowModel`."""

    commands: Commands | None = None
    online: OnlineLayer | None = None
    card: ModelCard | None = None
    parameters = 0


def without_online(model: WindowModel) -> WindowModel:
    """The same model without its online layer, under a name of its own."""
    plain = copy.copy(model)
    plain.name, plain.online = f"{model.name} (offline)", None
    return plain


def seen_by(model: WindowModel, windows: Vector) -> Seen:
    """What the online layer of a model that has one sees of ``windows`` ``(N, H, 7)``."""
    seen = model.predict(windows).seen
    assert seen is not None
    return seen
