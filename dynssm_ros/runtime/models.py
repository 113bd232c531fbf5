"""Models behind one interface: windows in, next states out. The trained ones run in ONNX Runtime."""

from __future__ import annotations

import copy
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np
import onnxruntime as ort

from dynssm_ros.arrays import Vector
from dynssm_ros.errors import ArtifactError, ConfigurationError
from dynssm_ros.runtime.artifact import ONLINE, Artifact, ModelCard, open_artifact
from dynssm_ros.runtime.online import Learned, OnlineLayer, Seen
from dynssm_ros.signals.inputs import WINDOW_COLUMNS, applied_inputs
from dynssm_ros.signals.signal_map import Commands
from dynssm_ros.vehicle import Applied, Coefficients, State, Vehicle
from dynssm_ros.vehicle.effects import initial_effect_states
from dynssm_ros.vehicle.effects.carried import CARRIED_S, carries, effect_states_along
from dynssm_ros.vehicle.single_track import Integrator, step_with_effect_states

_AT_ONCE = 32
"""Windows that a graph sees at once. Memory that it has used stays with it: two megabytes for each of them with the paper's
encoders. More at once are no faster."""


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

    def part(self, chosen: slice) -> WindowPrediction:
        """What it says of some of the windows."""
        theta, physics, variance = (None if array is None else array[chosen] for array in self[1:4])
        seen = None if self.seen is None else Seen(*(array[chosen] for array in self.seen))
        return WindowPrediction(self.state[chosen], theta, physics, variance, seen)


def corrected(
    prediction: WindowPrediction,
    windows: Vector,
    layer: OnlineLayer,
    learned: Learned,
    mean_error: Vector | None = None,
    step: int = 0,
) -> WindowPrediction:
    """A model's prediction with what its online layer had learned at each window.

    Args:
        prediction: of the model itself.
        windows: that it is from, ``(N, H, 7)``.
        layer: the model's.
        learned: at the last measured row of each window.
        mean_error: in a rollout, after its first step: the physics' mean error at the start, ``(N, 3)``.
        step: steps of the rollout so far.
    """
    seen, now = prediction.seen, windows[:, -1, :3]
    assert seen is not None
    if mean_error is None:
        increments = layer.increments(seen.features, learned.weights)
    else:
        increments = layer.in_rollout(seen, learned, mean_error, step)
    fast = (now[:, :1] >= layer.minimum_speed) | (layer.minimum_speed == 0.0)
    state = np.where(fast, now + increments, prediction.state)
    return prediction._replace(state=state, variance=learned.variance * layer.scale**2, theta=learned.theta)


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


class Persistence:
    """The next state is the present one: the mark that every model must pass."""

    name = "persistence"
    T_s = 0.0
    H = 1
    commands: Commands | None = None
    online: OnlineLayer | None = None
    vehicle = None
    card: ModelCard | None = None
    origin = "the next state is the present one"
    parameters = 0
    flops = 0

    def predict(self, windows: Vector) -> WindowPrediction:
        """Returns the last state of each window."""
        return WindowPrediction(windows[:, -1, :3].copy(), None, None)


class SingleTrack:
    """The nominal single-track model of a vehicle file, without learning.

    Where effects of the vehicle have states (a lagging steering, relaxing tyres), these are carried over a window of
    ``CARRIED_S``.
    """

    name = "single_track"
    commands: Commands | None = None
    online: OnlineLayer | None = None
    card: ModelCard | None = None
    parameters = 0

    def __init__(self, vehicle: Vehicle, integrator: Integrator | None = None, substeps: int = 1) -> None:
        self.vehicle = vehicle
        self.T_s = vehicle.sampling_time
        self._theta = vehicle.nominal
        self._effects = vehicle.active_effects
        self._carries = carries(self._effects)
        self._stepping: tuple[Integrator, int] = integrator or vehicle.model_integrator, substeps
        self.H = 1 + (round(CARRIED_S / self.T_s) if self._carries else 0)
        self.flops = count_operations(self.predict, np.ones((1, self.H, len(WINDOW_COLUMNS))))

    @property
    def origin(self) -> str:
        """The vehicle file."""
        return f"nominal single-track model of vehicle {self.vehicle.name}, no learning"

    def predict(self, windows: Vector) -> WindowPrediction:
        """Steps the physics from the last row of each window."""
        predicted = self._following(windows, 1)[:, 0]
        return WindowPrediction(predicted, np.tile(self._theta, (len(windows), 1)), predicted)

    def _following(self, windows: Vector, latest: int) -> Vector:
        """Next states ``(N, latest, 3)`` from the latest rows of windows ``(N, H, 7)``."""
        theta = Coefficients(*self._theta)
        now = np.moveaxis(windows[:, -latest:], -1, 0)
        if self._carries:
            rows = [windows[:, k].T for k in range(windows.shape[1])]
            carried = effect_states_along(
                np, [State(*row[:3]) for row in rows], [applied_inputs(row) for row in rows], Applied(*rows[0][3:5]), theta,
                self.vehicle.constants, self.T_s, self._effects, *self._stepping,
            )[-latest:]  # fmt: skip
            effect_states = {name: np.stack([each[name] for each in carried], axis=1) for name in carried[0]}
        else:
            effect_states = initial_effect_states(self._effects, now[3], now[4])
        state, _ = step_with_effect_states(
            np, State(*now[:3]), effect_states, applied_inputs(now), theta, self.vehicle.constants, self.T_s,
            self._effects, *self._stepping,
        )  # fmt: skip
        return np.stack(state, axis=-1)


class SingleTrackEwma(SingleTrack):
    """The single-track model less an exponential average of its own recent one-step errors.

    Banking, offsets and another set-up make the physics err the same way step after step; these errors are known at run
    time, so the honest baseline takes them off.
    """

    name = "single_track_ewma"
    rows = 31
    decay = 0.9

    def __init__(self, vehicle: Vehicle, integrator: Integrator | None = None, substeps: int = 1) -> None:
        super().__init__(vehicle, integrator, substeps)
        self.H += self.rows - 1
        self.flops = count_operations(self.predict, np.ones((1, self.H, len(WINDOW_COLUMNS))))

    def predict(self, windows: Vector) -> WindowPrediction:
        """Steps the physics from the last row and corrects it by the mean of its errors over the window."""
        following = self._following(windows, min(self.rows, windows.shape[1]))
        count, rows, _ = following.shape
        errors = following[:, :-1] - windows[:, windows.shape[1] - rows + 1 :, :3]
        weights = self.decay ** np.arange(rows - 2, -1, -1.0)
        physics = following[:, -1]
        corrected = physics - ((weights / weights.sum())[:, None] * errors).sum(axis=1)
        return WindowPrediction(corrected, np.tile(self._theta, (count, 1)), physics)


UNTRAINED = (Persistence.name, SingleTrack.name, SingleTrackEwma.name, "single_track_ekf")
"""Names of the models that need no training."""


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
        options = ort.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        # the export has optimised the graph; doing it again would hold up a swap
        options.graph_optimization_level = ort.GraphOptimizationLevel.ORT_DISABLE_ALL
        options.enable_mem_reuse = False  # small tensors: planning their reuse costs more than their effect states
        options.log_severity_level = 3
        try:
            self._session = ort.InferenceSession(self.artifact.onnx, options, providers=["CPUExecutionProvider"])
        except Exception as error:  # onnxruntime raises its own unrelated classes
            raise ArtifactError(
                f"{self.artifact.onnx}: ONNX Runtime refuses it ({' '.join(str(error).split())})"
            ) from error
        self._outputs = [output.name for output in self._session.get_outputs()]
        inputs = [(each.name, each.shape[1:]) for each in self._session.get_inputs()]
        if inputs != [("window", [self.H, len(WINDOW_COLUMNS)])] or "increment" not in self._outputs:
            raise ArtifactError(
                f"{self.artifact.onnx}: maps {inputs} to {self._outputs}; expected a window of {self.H} rows and "
                f"{len(WINDOW_COLUMNS)} columns to increment, and theta, physics, variance if it has them"
            )

        # a single window, as in the node, always has its place in memory
        self._window = np.empty((1, self.H, len(WINDOW_COLUMNS)), dtype=np.float32)
        self._binding = self._session.io_binding()
        self._binding.bind_cpu_input("window", self._window)
        for name in self._outputs:
            self._binding.bind_output(name)

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


def count_operations(call: Callable[[Vector], object], argument: Vector) -> int:
    """Floating-point operations of ``call(argument)``, as numpy reports them while it executes them.

    Every sum, product, quotient or elementary function of one element that depends on ``argument`` counts once.
    """
    count = 0

    class Counted(np.ndarray[Any, np.dtype[np.float64]]):
        def __array_ufunc__(self, ufunc: np.ufunc, method: Any, *inputs: Any, **options: Any) -> Any:
            nonlocal count
            plain = [each.view(np.ndarray) if isinstance(each, Counted) else each for each in inputs]
            result = np.asarray(getattr(ufunc, method)(*plain, **options))
            count += result.size if method == "__call__" else plain[0].size  # a reduction visits what it reduces
            return result.view(Counted)

    call(argument.view(Counted))
    return count


def load_model(name_or_dir: str | Path, vehicle: Vehicle | None = None) -> WindowModel:
    """Opens a model folder, or one of the models that need no training.

    Args:
        name_or_dir: a model folder, or one of :data:`UNTRAINED`.
        vehicle: needed for the single-track models.

    Raises:
        ArtifactError: the folder is not a usable model.
        ConfigurationError: no such model, or the vehicle is missing.
    """
    if Path(name_or_dir).is_dir():
        return OnnxModel(open_artifact(name_or_dir))
    if name_or_dir == "persistence":
        return Persistence()
    from dynssm_ros.runtime.kalman import SingleTrackEkf

    physics: tuple[type[SingleTrack] | type[SingleTrackEkf], ...] = (SingleTrack, SingleTrackEwma, SingleTrackEkf)
    for physical in physics:
        if name_or_dir == physical.name:
            if vehicle is None:
                raise ConfigurationError(f"model {name_or_dir}: needs --vehicle")
            return physical(vehicle)
    raise ConfigurationError(f"model '{name_or_dir}': neither a model folder nor one of {', '.join(UNTRAINED)}")
