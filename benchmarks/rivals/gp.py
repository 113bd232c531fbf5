"""A Gaussian process on the errors of the calibrated physics, as the learning-based MPC of Formula Student cars has it.

After Hewing, Liniger and Zeilinger, "Cautious NMPC with Gaussian Process Dynamics for Autonomous Miniature Race Cars", 2018,
and Kabzan, Hewing, Liniger and Zeilinger, "Learning-Based Model Predictive Control for Autonomous Racing", RA-L 2019. For
each state the error of a step is the sum of two independent processes and noise:

- over the state and the inputs, with a squared-exponential kernel of a length scale for each (automatic relevance
  determination). It is learned offline, and reduced to inducing points (subset of regressors).
- over time, with an exponential kernel. It learns online, from the errors within the window: what bank, wind and tyres do to
  all of them. Rows are T_s apart, so its posterior mean is a filter with constant weights.

Scales and variances are those of the largest marginal likelihood, on a sample of the training windows. The papers exchange
inducing points while driving; here the process over time takes the online data, which an exported graph can hold.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import torch
from pydantic import Field
from torch import Tensor, nn

from benchmarks.rivals.fitting import driven, minimise
from dynssm_ros.learning.dataset import SplitConfig, TrainingWindows
from dynssm_ros.learning.losses import Output
from dynssm_ros.learning.models.base import ModelConfig, TrainableModel, scale_buffers
from dynssm_ros.learning.models.physics import PhysicsConfig, PhysicsLayer
from dynssm_ros.runtime.artifact import Normalisation
from dynssm_ros.vehicle import Vehicle

CHANNELS, INPUTS = 3, 5
_STEPS, _RATE = 150, 0.1  # of Adam, on logarithms
_LEAST_NOISE = 1e-3  # of the standard deviation of the errors: what keeps the systems of equations solvable
_LEAST_EIGENVALUE = 0.1  # of the inducing points' kernel: weights in single precision must not cancel each other
_SMALLEST = 1e-9  # errors, in units of s_delta


class GpConfig(ModelConfig):
    """Model file of a Gaussian process on the physics' errors."""

    kind: Literal["gp"] = "gp"
    inducing: int = Field(default=64, ge=1, description="inducing points of the process over states and inputs")
    sample: int = Field(default=300, ge=10, description="windows from which scales and variances are learned")
    physics: PhysicsConfig = Field(default_factory=lambda: PhysicsConfig(nominal="calibrated"))
    training: SplitConfig = Field(default_factory=SplitConfig)


class GaussianProcess(TrainableModel):
    """Physics with nominal coefficients, and what the processes expect of its errors."""

    KIND = "gp"
    CONFIG = GpConfig
    nominal: Tensor

    def __init__(self, config: GpConfig, vehicle: Vehicle, normalisation: Normalisation) -> None:
        super().__init__(config, vehicle, normalisation)
        self.config = config
        self.H = config.rows(vehicle.sampling_time)
        self.physics = PhysicsLayer(vehicle, config.physics)
        scale_buffers(self, normalisation)
        self.register_buffer("nominal", config.physics.theta_0(vehicle))
        self.points = nn.Parameter(torch.zeros(config.inducing, INPUTS))
        self.lengths = nn.Parameter(torch.ones(CHANNELS, INPUTS))
        self.weights = nn.Parameter(torch.zeros(config.inducing, CHANNELS))
        self.memory = nn.Parameter(torch.zeros(self.H - 1, CHANNELS))

    def forward(self, window: Tensor) -> Output:
        over = self.physics.over(window, self.nominal, self.H)
        expected = self._over_states(self._inputs(window))
        slow = (self._left(window, over, expected) * self.memory).sum(1)
        moved = over[:, -1] + self.increment_scale * (expected[:, -1] + slow)
        return Output(moved, over[:, -1], self.nominal.expand(window.shape[0], -1), None, None, over)

    def _left(self, window: Tensor, over: Tensor, expected: Tensor) -> Tensor:
        """Errors within windows that the process over states does not explain, ``(B, H - 1, 3)`` in units of s_delta."""
        increments = window[:, 1:, :CHANNELS] - window[:, :-1, :CHANNELS]
        left: Tensor = (increments - over[:, :-1]) / self.increment_scale - expected[:, :-1]
        return left

    def _inputs(self, window: Tensor) -> Tensor:
        return driven(window, self.mean, self.std)

    def _over_states(self, x: Tensor) -> Tensor:
        """Posterior mean of the process over states and inputs ``(..., 5)``, ``(..., 3)`` in units of s_delta."""
        return torch.stack(
            [(_kernel(x, self.points, self.lengths[c]) * self.weights[:, c]).sum(-1) for c in range(CHANNELS)], dim=-1
        )

    @torch.no_grad()
    def fit(self, training: TrainingWindows) -> bool:
        draw = torch.Generator().manual_seed(self.config.training.seed)
        chosen = torch.randperm(len(training), generator=draw)[: self.config.sample]
        window, increment = training.batch(chosen)
        self._fit_over_states(training, self._inputs(window[:, -1]).double(), self._errors(window, increment).double())
        over = self.physics.over(window, self.nominal, self.H)
        left = self._left(window, over, self._over_states(self._inputs(window)))
        for c in range(CHANNELS):
            self.memory[:, c] = _filter_fitted(left[..., c].double())
        return True

    def _fit_over_states(self, training: TrainingWindows, sample: Tensor, errors: Tensor) -> None:
        """Inducing points and scales from a sample ``(S, 5)`` with its errors ``(S, 3)``, weights from all windows."""
        self.points.copy_(_spread_out(sample, len(self.points)))
        found = [_over_states_fitted(sample, errors[:, c]) for c in range(CHANNELS)]
        self.lengths.copy_(torch.stack([lengths for lengths, _, _ in found]))
        Z, lengths = self.points.double(), self.lengths.double()
        gram, moment = torch.zeros(CHANNELS, len(Z), len(Z)).double(), torch.zeros(CHANNELS, len(Z)).double()
        for window, increment in training.batches():
            x, error = self._inputs(window[:, -1]).double(), self._errors(window, increment).double()
            for c in range(CHANNELS):
                k = _kernel(x, Z, lengths[c])
                gram[c] += k.T @ k
                moment[c] += k.T @ error[:, c]
        for c, (_, variance, noise) in enumerate(found):
            T = _whitening(_kernel(Z, Z, lengths[c]))
            ridge = noise / variance * torch.eye(T.shape[1]).double()
            self.weights[:, c] = T @ torch.linalg.solve(ridge + T.T @ gram[c] @ T, T.T @ moment[c])

    def _errors(self, window: Tensor, increment: Tensor) -> Tensor:
        """Of the physics from the last rows of windows, ``(B, 3)`` in units of s_delta."""
        errors: Tensor = (increment - self.physics(window[:, -1], self.nominal)) / self.increment_scale
        return errors


def _kernel(x: Tensor, z: Tensor, lengths: Tensor) -> Tensor:
    """Squared-exponential kernel of unit variance between ``(..., 5)`` and ``(M, 5)``, ``(..., M)``."""
    apart = (x[..., None, :] - z) / lengths
    similar: Tensor = torch.exp(-0.5 * (apart * apart).sum(-1))
    return similar


def _whitening(K: Tensor) -> Tensor:
    """``T`` with ``T' K T = 1`` over the eigenvectors of ``K`` ``(M, M)`` that are not nearly nothing, ``(M, m)``."""
    values, vectors = torch.linalg.eigh(K)
    kept = values > _LEAST_EIGENVALUE
    whitening: Tensor = vectors[:, kept] / values[kept].sqrt()
    return whitening


def _spread_out(x: Tensor, count: int) -> Tensor:
    """So many rows of ``x``, each as far from those before as there is one; repeated if there are fewer."""
    chosen, distance = [0], torch.cdist(x, x[:1])[:, 0]
    while len(chosen) < count:
        chosen.append(int(distance.argmax()))
        distance = torch.minimum(distance, torch.cdist(x, x[chosen[-1:]])[:, 0])
    return x[chosen]


def _over_states_fitted(x: Tensor, error: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Length scales ``(5,)``, variance and noise variance of the process over states, by marginal likelihood."""
    size = error.std() + _SMALLEST
    y, eye = error / size, torch.eye(len(x)).double()

    def loss(p: Tensor) -> Tensor:
        noise = p[-1].exp() + _LEAST_NOISE**2
        return _negative_log_likelihood(p[-2].exp() * _kernel(x, x, p[:INPUTS].exp()) + noise * eye, y[None])

    start = torch.tensor([*[0.7] * INPUTS, 0.0, -1.0]).double()
    p = _minimised(loss, start)
    return p[:INPUTS].exp(), p[-2].exp() * size**2, (p[-1].exp() + _LEAST_NOISE**2) * size**2


def _filter_fitted(errors: Tensor) -> Tensor:
    """Weights ``(L,)`` of the errors within a window, ``(B, L)``, for the one after them: process over time, and noise."""
    L = errors.shape[1]
    size = errors.std() + _SMALLEST
    y, eye = errors / size, torch.eye(L).double()
    lags = (torch.arange(L)[:, None] - torch.arange(L)).abs().double()

    def covariance(p: Tensor, lag: Tensor) -> Tensor:
        return p[0].exp() * torch.exp(-lag / p[1].exp())

    def loss(p: Tensor) -> Tensor:
        return _negative_log_likelihood(covariance(p, lags) + (p[2].exp() + _LEAST_NOISE**2) * eye, y)

    p = _minimised(loss, torch.tensor([-1.0, 2.0, -1.0]).double())
    K = covariance(p, lags) + (p[2].exp() + _LEAST_NOISE**2) * eye
    weights: Tensor = torch.linalg.solve(K, covariance(p, torch.arange(L, 0, -1).double()))
    return weights


def _negative_log_likelihood(K: Tensor, y: Tensor) -> Tensor:
    """Of draws ``(B, N)`` with covariance ``K``, a mean over them, without its constant."""
    root = torch.linalg.cholesky(K)
    white = torch.linalg.solve_triangular(root, y.T, upper=False)
    value: Tensor = 0.5 * (white**2).sum(0).mean() + root.diagonal().log().sum()
    return value


def _minimised(loss: Callable[[Tensor], Tensor], start: Tensor) -> Tensor:
    """The least that Adam finds."""
    p = start.clone().requires_grad_()
    minimise([p], lambda: loss(p), _STEPS, _RATE)
    return p.detach()
