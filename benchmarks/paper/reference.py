"""The paper's own numbers (``benchmarks/paper/reference.yaml``), to be set beside what is measured."""

from __future__ import annotations

from pathlib import Path

from pydantic import Field

from dynssm_ros import configuration
from dynssm_ros.configuration import StrictModel


class Channels(StrictModel):
    """One number for each state (m/s, m/s, rad/s, or a share)."""

    v_x: float
    v_y: float
    omega: float

    @property
    def values(self) -> list[float]:
        """In the order of the states."""
        return [self.v_x, self.v_y, self.omega]


class Cost(StrictModel):
    """What a prediction costs."""

    parameters: int
    flops: int
    latency: float = Field(description="(s)")


class OpenLoop(Cost):
    """A row of the open-loop table."""

    rmse: Channels
    max_error: Channels
    ade: float = Field(description="(m)")
    fde: float = Field(description="(m)")


class Ablation(Cost):
    """A row of the ablation table."""

    rmse: Channels


class Coefficient(StrictModel):
    """A row of the coefficient table."""

    bounds: tuple[float, float]
    mean: float
    std: float


class Claims(StrictModel):
    """What the abstract says, as shares."""

    rmse: Channels
    lap_time: float


class ClosedLoop(StrictModel):
    """A row of the closed-loop tables."""

    violation: bool
    lap_time: float = Field(description="(s)")
    mean_v_x: float = Field(description="(m/s)")
    mean_abs_v_y: float | None = Field(default=None, description="(m/s)")
    mean_abs_omega: float | None = Field(default=None, description="(rad/s)")
    steering_total_variation: float | None = None


class Reference(StrictModel):
    """All of the paper's tables; data sets are ``real`` and ``sim``."""

    claims: Claims
    open_loop: dict[str, dict[str, OpenLoop]]
    ablation: dict[str, dict[str, Ablation]]
    coefficients: dict[str, dict[str, Coefficient]]
    closed_loop_ablation: dict[str, ClosedLoop]
    closed_loop: dict[str, dict[str, ClosedLoop]]


def load_reference(path: Path | None = None) -> Reference:
    """Reads the paper's numbers, the shipped file if not given.

    Raises:
        ConfigurationError: unreadable or malformed.
    """
    path = Path(__file__).parent / "reference.yaml" if path is None else path
    return configuration.validate(Reference, configuration.read_yaml(path), path)
