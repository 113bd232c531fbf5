"""What the online layer sees of a window: its features, linear in what it may learn, and the physics' increments.

The features of a channel are the physics' increments, the network's, what was measured lately, how the inputs change, where
the car is. All are in units that make one the usual size. Training, evaluation and the live node compute them here.
"""

from __future__ import annotations

from itertools import accumulate
from typing import Any, NamedTuple

import numpy as np

from dynssm_ros import compiled
from dynssm_ros.arrays import Indices, Vector
from dynssm_ros.compiled import address
from dynssm_ros.errors import ArtifactError
from dynssm_ros.runtime.online import CHANNELS, MEAN_ERROR, OnlineLayer, Seen
from dynssm_ros.signals.inputs import applied_inputs
from dynssm_ros.signals.signal_map import STATE_SIGNALS
from dynssm_ros.vehicle import Applied, CarModel, Coefficients, State, Vehicle
from dynssm_ros.vehicle.compiled_car import car_structure
from dynssm_ros.vehicle.integrators import Integrator

INPUT_CHANGE = 0.1
"""What an input changes in a step, about, as a share of its standard deviation."""


THROTTLES: Vector = np.array([-0.4, -0.2, -0.1, -0.05, -0.02, 0.0, 0.02, 0.05, 0.1, 0.2, 0.4, 0.8])
"""Fractions of the throttle about which a force may bend: where a car's brakes take over from its engine."""
THROTTLE_WIDTHS: Vector = np.maximum(np.abs(THROTTLES) / 2, 0.01)


def throttle_steps(windows: Vector) -> Vector:
    """Smooth steps of the applied throttle of windows' last rows ``(N, H, 7)`` about :data:`THROTTLES`, ``(N, 12)``."""
    applied = windows[:, -1, 3] + windows[:, -1, 5]
    steps: Vector = np.tanh((applied[:, None] - THROTTLES) / THROTTLE_WIDTHS)
    return steps


class FeatureLayout(NamedTuple):
    """Which features a channel has."""

    lags: int  # measured increments of the channel itself, back from the last
    other_lags: int  # the same of the other channels
    input_lags: int  # changes of throttle and steering
    errors: int  # rows over which the physics' error is averaged
    network: bool  # whether the network's increment is one
    throttle: bool = False  # whether steps of the throttle are

    @classmethod
    def of(cls, names: tuple[str, ...], errors: int) -> FeatureLayout:
        """The layout whose features have these ``names``.

        Raises:
            ArtifactError: there is none.
        """

        def count(beginning: str) -> int:
            return sum(name.startswith(beginning) for name in names)

        layout = cls(
            count("increment, "), count("increment of the next, "), count("change of r, "), errors, "network" in names,
            count("throttle about ") > 0,
        )  # fmt: skip
        if layout.names != names:
            raise ArtifactError(f"online layer: features {', '.join(names)}; expected {', '.join(layout.names)}")
        return layout

    @property
    def recent(self) -> int:
        """Measured increments that are read, back from the last."""
        return max(self.lags, self.other_lags)

    @property
    def names(self) -> tuple[str, ...]:
        """Of the features, in their order."""
        lags, others = range(self.lags), range(self.other_lags)
        changes = [f"change of {name}, {k} steps ago" for k in range(self.input_lags) for name in ("r", "delta")]
        return (
            "physics", "physics, next channel", "physics, channel after",
            *(["network"] if self.network else []),
            *(f"increment, {k + 1} steps ago" for k in lags),
            *(f"increment of the {which}, {k + 1} steps ago" for k in others for which in ("next", "one after")),
            *changes, *STATE_SIGNALS, "r_fb", "delta_fb", MEAN_ERROR, "one",
            *(f"throttle about {value:g}" for value in THROTTLES if self.throttle),
        )  # fmt: skip

    @property
    def places(self) -> Indices:
        """Where the features of each channel stand among those of all, ``(3, n)``."""
        names = ("physics", "increments", "changes", "level", "error", "network", "one", "throttle")
        sizes = (CHANNELS, CHANNELS * self.recent, 2 * self.input_lags, 5, CHANNELS, CHANNELS * self.network, 1)
        at = dict(zip(names, accumulate(sizes, initial=0), strict=True))
        rows = []
        for c in range(CHANNELS):
            following = [(c + k) % CHANNELS for k in range(CHANNELS)]  # the channel itself, the next, the one after
            back = [at["increments"] + CHANNELS * (self.recent - 1 - k) for k in range(self.recent)]
            rows.append([
                *(at["physics"] + k for k in following),
                *([at["network"] + c] if self.network else []),
                *(back[k] + c for k in range(self.lags)),
                *(back[k] + which for k in range(self.other_lags) for which in following[1:]),
                *(at["changes"] + 2 * (self.input_lags - 1 - k) + u for k in range(self.input_lags) for u in range(2)),
                *(at["level"] + k for k in range(5)),
                at["error"] + c, at["one"],
                *(at["throttle"] + k for k in range(len(THROTTLES)) if self.throttle),
            ])  # fmt: skip
        return np.array(rows, dtype=np.intp)


class LayerFeatures:
    """Maps windows to what the online layer sees.

    Args:
        layout: of the features.
        vehicle: the calibrated car.
        mean: of the window's columns, ``(7,)``.
        std: likewise.
        increment_scale: s_delta (m/s, m/s, rad/s), ``(3,)``.
        integrator: of the physics.
        substeps: integration steps per sampling time.
    """

    def __init__(
        self,
        layout: FeatureLayout,
        vehicle: Vehicle,
        *,
        mean: Vector,
        std: Vector,
        increment_scale: Vector,
        integrator: Integrator,
        substeps: int,
    ) -> None:
        self.layout, self.vehicle = layout, vehicle
        self.stepping: tuple[Integrator, int] = integrator, substeps
        self.names = layout.names
        self._mean, self._std, self._scale = mean[:5], std[:5], increment_scale
        self._input_scale = INPUT_CHANGE * std[3:5]
        self._places = layout.places
        self._car = CarModel.of(vehicle, integrator, substeps)
        self._theta = Coefficients(*vehicle.nominal)
        self._compiled: dict[int, compiled.FeaturesStructure | None] = {}  # by rows of a window

    def __getstate__(self) -> dict[str, Any]:
        """All but what lies in this process."""
        return vars(self) | {"_compiled": {}}

    @classmethod
    def of(cls, layer: OnlineLayer, mean: Vector, std: Vector) -> LayerFeatures | None:
        """The features of a trained layer, for windows whose columns have ``mean`` and ``std`` ``(7,)``.

        ``None`` for a layer of version 0.4 or before, whose features are outputs of the graph.
        """
        if layer.card.error_rows is None:
            return None
        return cls(
            FeatureLayout.of(layer.card.features, layer.card.error_rows), layer.vehicle, mean=mean, std=std,
            increment_scale=layer.scale, integrator=layer.integrator, substeps=layer.substeps,
        )  # fmt: skip

    def seen(self, windows: Vector, network: Vector | None = None) -> Seen:
        """What the layer sees of ``windows`` ``(N, H, 7)``; ``network`` are its increments ``(N, 3)`` (m/s, m/s, rad/s)."""
        if compiled.LIBRARY is not None:
            structure = self.structure(windows.shape[1])
            if structure is not None:
                return self._seen_compiled(compiled.LIBRARY, structure, windows, network)
        layout, count = self.layout, len(windows)
        increments = np.diff(windows[:, :, :CHANNELS], axis=1) / self._scale
        columns = np.moveaxis(windows, -1, 0)
        with np.errstate(all="ignore"):  # a rollout that diverges is a result
            moved = self._car.over(
                State(*columns[:3]), applied_inputs(columns), Applied(*columns[3:5]), self._theta, layout.errors + 1
            )
        over = np.stack(moved, axis=-1)
        mean_error = increments[:, -layout.errors :].mean(axis=1) - over[:, :-1].mean(axis=1) / self._scale
        inputs = windows[:, -layout.input_lags - 1 :, 3:7]
        applied = inputs[..., :2] + inputs[..., 2:]
        changes = np.diff(applied, axis=1) / self._input_scale
        physics = over[:, -1]
        parts = [
            physics / self._scale,
            increments[:, -layout.recent :].reshape(count, -1),
            changes.reshape(count, -1),
            (windows[:, -1, :5] - self._mean) / self._std,
            mean_error,
        ]
        if layout.network:
            assert network is not None
            parts.append(network / self._scale)
        parts.append(np.ones((count, 1)))
        if layout.throttle:
            parts.append(throttle_steps(windows))
        found = np.concatenate(parts, axis=1)
        return Seen(found[:, self._places], physics)

    def structure(self, rows: int) -> compiled.FeaturesStructure | None:
        """What the compiled loop needs to know for windows of so many rows; ``None`` if it cannot do it."""
        if rows not in self._compiled:
            layout, car = self.layout, car_structure(self._car, np.array(self._theta), rows)
            structure = None
            if car is not None:
                structure = compiled.FeaturesStructure()
                structure.fill(
                    car=car, rows=rows, recent=layout.recent, input_lags=layout.input_lags, errors=layout.errors,
                    network=layout.network, n=len(self.names), places=self._places.astype(np.int64), mean=self._mean,
                    std=self._std, scale=self._scale, input_scale=self._input_scale,
                    throttles=len(THROTTLES) * layout.throttle, throttle=THROTTLES, throttle_width=THROTTLE_WIDTHS,
                    moved=np.zeros((compiled.LANES, layout.errors + 1, CHANNELS)),
                    found=np.zeros(CHANNELS * len(self.names)),
                )  # fmt: skip
            self._compiled[rows] = structure
        return self._compiled[rows]

    def _seen_compiled(
        self, library: Any, structure: compiled.FeaturesStructure, windows: Vector, network: Vector | None
    ) -> Seen:
        """:meth:`seen` by the compiled loop."""
        count = len(windows)
        windows = np.ascontiguousarray(windows, dtype=np.float64)
        if self.layout.network:
            assert network is not None
            network = np.ascontiguousarray(network, dtype=np.float64)
        else:
            network = None
        features, physics = np.empty((count, CHANNELS, len(self.names))), np.empty((count, CHANNELS))
        library.dynssm_seen(
            structure.address, address(windows), count, address(network), address(features), address(physics)
        )
        return Seen(features, physics)
