"""The objective, term by term against closed forms, and its switches."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from dynssm_ros.learning.losses import COMPONENTS, LossConfig, objective, scales
from dynssm_ros.learning.models.dynssm.network import Output
from dynssm_ros.runtime.artifact import Normalisation

NORMALISATION = Normalisation(
    input_mean=(0.0,) * 7, input_std=(1.0,) * 7, state_scale=(4.0, 5.0, 8.0), increment_scale=(0.5, 0.2, 0.1)
)
TARGET = torch.tensor([[1.0, 0.0, -1.0], [0.0, 0.5, 0.0]])
ERROR = torch.tensor([[2.0, -1.0, 0.5], [0.0, 0.1, 4.0]])
CORRECTION = torch.tensor([[1.0, 2.0, 3.0], [0.0, 0.0, -2.0]])
ANCHOR = torch.tensor([[0.5, -0.2, 0.1], [1.0, 0.0, 0.0]])
DEVIATION = torch.linspace(-1.0, 1.0, 34).reshape(2, 17)


def terms(lacking: tuple[str, ...] = (), **config: Any) -> dict[str, float]:
    """The terms for predictions with ``ERROR`` whose physics' part is ``ANCHOR`` below them."""
    fields = {
        "increment": TARGET + ERROR,
        "physics": TARGET + ERROR - ANCHOR,
        "theta": None,
        "deviation": DEVIATION,
        "correction": CORRECTION,
    }
    loss = LossConfig.model_validate({"parameters": 0.0, **config})
    output = Output(**(fields | dict.fromkeys(lacking)))  # type: ignore[arg-type]
    found = objective(output, TARGET, loss, scales(loss, NORMALISATION))
    assert tuple(found) == COMPONENTS
    return {name: value.item() for name, value in found.items()}


@pytest.mark.parametrize(
    ("scale", "unit"), [("target", (4.0, 5.0, 8.0)), ("increment", (0.5, 0.2, 0.1)), ("none", (1.0, 1.0, 1.0))]
)
def test_the_prediction_term_is_the_mean_squared_error_in_units_of_the_scale(
    scale: str, unit: tuple[float, ...]
) -> None:
    assert terms(scale=scale)["prediction"] == pytest.approx(float(((ERROR / torch.tensor(unit)) ** 2).mean()))


def test_the_robust_prediction_term_is_twice_hubers_so_that_small_errors_count_the_same() -> None:
    e = np.array([2 / 4, 1 / 5, 0.5 / 8, 0.0, 0.1 / 5, 4 / 8])
    delta = 0.3
    expected = np.where(e <= delta, e**2, 2 * delta * e - delta**2).mean()
    assert terms(scale="target", robust=delta)["prediction"] == pytest.approx(expected)
    assert terms(scale="target", robust=10.0) == pytest.approx(terms(scale="target"))


def test_the_regularisers_are_mean_squares_of_the_deviation_and_of_the_networks_output() -> None:
    assert terms(parameters=0.01)["parameters"] == pytest.approx(0.01 * float((DEVIATION**2).sum()) / (2 * 17))
    assert terms(correction=0.1)["correction"] == pytest.approx(0.1 * (1 + 4 + 9 + 4) / 6)


def test_the_physics_anchor_is_the_gap_in_units_of_the_increment_whatever_the_scale_of_the_prediction() -> None:
    expected = 0.2 * (1 + 1 + 1 + 4) / 6
    for scale in ("target", "increment"):
        assert terms(physics=0.2, scale=scale)["physics"] == pytest.approx(expected)


@pytest.mark.parametrize(
    ("lacking", "zero"),
    [
        (("deviation",), ["parameters"]),
        (("correction",), ["correction"]),
        (("physics",), ["physics"]),
        (("deviation", "correction", "physics"), ["parameters", "correction", "physics"]),
    ],
)
def test_a_model_without_a_component_has_no_term_for_it(lacking: tuple[str, ...], zero: list[str]) -> None:
    weights = {"parameters": 0.1, "correction": 0.1, "physics": 0.1}
    full, found = terms(**weights), terms(lacking, **weights)
    assert [name for name in COMPONENTS if found[name] == 0.0] == zero
    for name in set(COMPONENTS) - set(zero):
        assert found[name] == full[name]


def test_each_weight_scales_its_term_alone_and_zero_switches_it_off() -> None:
    off = terms()
    assert off["prediction"] > 0
    assert [off[name] for name in COMPONENTS[1:]] == [0.0, 0.0, 0.0]
    for name in COMPONENTS[1:]:
        once, twice = terms(**{name: 0.1}), terms(**{name: 0.2})
        assert twice.pop(name) == pytest.approx(2 * once.pop(name))
        assert twice == once
