"""On-track system identification: a network's virtual steady-state test gives the tyres of the single-track model.

After Dikici, Ghignone, Hu, Baumann, Xie, Carron, Magno and Corno (ForzaETH), "Learning-Based On-Track System Identification
for Scaled Autonomous Racing in Under a Minute", RA-L 2025. A lap excites the tyres unevenly. So a small network learns what
the present model mispredicts of v_y and omega; model and network together drive circles that nobody drove, at constant speed
with slowly growing steering, until they are steady; the tyres are fitted to the axles' forces there, which steady motion
gives; and all is repeated with the new tyres. What is left is a single-track model, and nothing else runs in the car.

Known are the idea and its steps. Sizes, rates and counts are ours, and so are three guards: tyres stay within the bounds of
the vehicle file; circles count where v_y and omega are within what was driven; and of all rounds, the file's tyres among
them, those are kept whose one-step errors are smallest.
"""

from __future__ import annotations

from typing import Any, Literal

import torch
from pydantic import Field
from torch import Tensor, nn

from benchmarks.rivals.fitting import driven, minimise
from dynssm_ros.learning.dataset import SplitConfig, TrainingWindows
from dynssm_ros.learning.losses import Output
from dynssm_ros.learning.models.base import ModelConfig, TrainableModel, scale_buffers
from dynssm_ros.learning.models.physics import PhysicsConfig, PhysicsLayer
from dynssm_ros.runtime.artifact import Normalisation
from dynssm_ros.vehicle import COEFFICIENTS, Applied, Coefficients, State, Vehicle

TYRES = ("B_f", "C_f", "D_f", "E_f", "S_hf", "B_r", "C_r", "D_r", "E_r", "S_hr")
"""Coefficients that are identified; the others are the vehicle file's, or those of its calibration."""
_LATERAL = slice(1, 3)  # v_y and omega among the states
_RATE, _EPOCHS = 0.01, 300  # of Adam, for the network
_FIT_RATE, _FIT_STEPS = 0.05, 300  # of Adam, for the tyres
_SPEEDS = 5  # of the circles: quantiles of those that were driven
_ANGLES = 41  # of the circles: steering between the 1st and 99th percentile of what was driven
_SETTLED_S = 3.0  # s that a circle is driven
_EDGE = 1e-4  # how close to a bound a tyre's value may start, as a share of its range


class OnTrackConfig(ModelConfig):
    """Model file of an on-track identification."""

    kind: Literal["on_track"] = "on_track"
    rounds: int = Field(default=6, ge=1, description="of network, circles and tyres")
    hidden: int = Field(default=8, ge=1, description="width of the network's layer")
    sample: int = Field(default=4000, ge=100, description="windows at most that the network learns from")
    physics: PhysicsConfig = Field(default_factory=lambda: PhysicsConfig(nominal="calibrated"))
    training: SplitConfig = Field(default_factory=SplitConfig)


class OnTrack(TrainableModel):
    """The physics with the tyres that were identified."""

    KIND = "on_track"
    CONFIG = OnTrackConfig

    def __init__(self, config: OnTrackConfig, vehicle: Vehicle, normalisation: Normalisation) -> None:
        super().__init__(config, vehicle, normalisation)
        self.config, self.vehicle = config, vehicle
        self.physics = PhysicsLayer(vehicle, config.physics)
        scale_buffers(self, normalisation)
        self.theta = nn.Parameter(config.physics.theta_0(vehicle), requires_grad=False)

    def forward(self, window: Tensor) -> Output:
        increment = self.physics.over(window, self.theta, 1)[:, 0]
        return Output(increment, increment, self.theta.expand(window.shape[0], -1), None, None)

    def fit(self, training: TrainingWindows) -> bool:
        draw = torch.Generator().manual_seed(self.config.training.seed)
        chosen = torch.randperm(len(training), generator=draw)[: self.config.sample]
        window, increment = training.batch(chosen)
        rows = window[:, -1]
        best, found = self._error(window, increment), self.theta.clone()
        for _ in range(self.config.rounds):
            with torch.no_grad():
                wrong = (increment - self(window).increment)[:, _LATERAL] / self.increment_scale[_LATERAL]
            network = self._network(rows, wrong, draw)
            circles = self._circles(rows, network)
            if len(circles) < len(TYRES):
                break
            self.theta.copy_(self._tyres(circles))
            error = self._error(window, increment)
            if error < best:
                best, found = error, self.theta.clone()
        self.theta.copy_(found)
        return True

    @torch.no_grad()
    def _error(self, window: Tensor, increment: Tensor) -> float:
        """Mean squared one-step error of v_y and omega in units of s_delta."""
        error = (increment - self(window).increment) / self.increment_scale
        return float(error[:, _LATERAL].square().mean())

    def _inputs(self, rows: Tensor) -> Tensor:
        return driven(rows, self.mean, self.std)

    def _network(self, rows: Tensor, wrong: Tensor, draw: torch.Generator) -> nn.Module:
        """What learns the errors ``(N, 2)`` of v_y and omega, in units of s_delta."""
        x, width = self._inputs(rows), self.config.hidden
        network = nn.Sequential(nn.Linear(x.shape[1], width), nn.Tanh(), nn.Linear(width, 2))
        with torch.no_grad():
            for parameter in network.parameters():
                parameter.copy_(0.3 * torch.randn(parameter.shape, generator=draw))
        minimise(network.parameters(), lambda: (network(x) - wrong).square().mean(), _EPOCHS, _RATE)
        return network

    @torch.no_grad()
    def _circles(self, rows: Tensor, network: nn.Module) -> Tensor:
        """Rows ``(M, 7)`` of steady motion of model and network together, within what was driven."""
        steering = rows[:, 4] + rows[:, 6]
        speeds = torch.quantile(rows[:, 0], torch.linspace(0.1, 0.9, _SPEEDS))
        low, high = torch.quantile(steering, torch.tensor([0.01, 0.99]))
        grid = torch.cartesian_prod(speeds, torch.linspace(float(low), float(high), _ANGLES))
        throttle = (rows[:, 3] + rows[:, 5]).mean().expand(len(grid))
        still = torch.zeros_like(throttle)
        now = torch.stack([grid[:, 0], still, still, throttle, grid[:, 1], still, still], dim=-1)
        for _ in range(round(_SETTLED_S / self.vehicle.sampling_time)):
            window = now[:, None].expand(-1, 2, -1)  # effects are settled on a circle
            moved = self.physics.over(window, self.theta, 1)[:, 0, _LATERAL]
            moved = moved + self.increment_scale[_LATERAL] * network(self._inputs(now))
            now = torch.cat([now[:, :1], now[:, _LATERAL] + moved, now[:, 3:]], dim=-1)
        seen = rows[:, _LATERAL].abs().quantile(0.99, dim=0)
        steady = (moved.abs() < 0.05 * self.increment_scale[_LATERAL]).all(-1)
        return now[steady & (now[:, _LATERAL].abs() <= seen).all(-1)]

    def _tyres(self, circles: Tensor) -> Tensor:
        """Coefficients ``(17,)`` with the tyres whose forces hold the car on the circles ``(M, 7)``."""
        which = torch.tensor([COEFFICIENTS.index(name) for name in TYRES])
        lower = torch.tensor(self.vehicle.lower, dtype=torch.float64)[which]
        wide = torch.tensor(self.vehicle.upper, dtype=torch.float64)[which] - lower
        share = ((self.theta.double()[which] - lower) / wide).clamp(_EDGE, 1 - _EDGE)
        p = torch.logit(share).requires_grad_()
        columns = [column.double() for column in circles.T]
        car = self.physics.car.under(torch)

        def theta() -> Tensor:
            return self.theta.double().index_copy(0, which, lower + torch.sigmoid(p) * wide)

        def unbalanced() -> Any:
            """Mean squared lateral and yaw acceleration over a step, in units of s_delta."""
            q = car.motion(State(*columns[:3]), Applied(*columns[3:5]), Coefficients(*theta()))
            units = self.increment_scale[_LATERAL] / self.vehicle.sampling_time
            return ((q.a_y / units[0]).square() + (q.omega_dot / units[1]).square()).mean()

        minimise([p], unbalanced, _FIT_STEPS, _FIT_RATE)
        return theta().detach().float()
