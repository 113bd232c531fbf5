"""Every effect under numpy, torch and casadi: one physics, and derivatives that can be used."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import casadi
import numpy as np
import pytest
import torch

from dynssm_ros.vehicle import COEFFICIENTS, Applied, CarModel, Coefficients, State, load_vehicle
from dynssm_ros.vehicle.effects import CONTEXT_UNITS, EFFECTS, Effect, build_effect
from dynssm_ros.vehicle.integrators import Integrator

AV21 = load_vehicle("av21_paper")
SIZES = (3, 2, len(COEFFICIENTS), len(CONTEXT_UNITS))


def samples(n: int = 12) -> list[np.ndarray]:
    """Random states, inputs, coefficients inside their bounds and signals, each of shape ``(size, n)``."""
    random = np.random.default_rng(11)
    v_x = random.uniform(5.0, 60.0, n)
    state = np.stack([v_x, random.uniform(-0.1, 0.1, n) * v_x, random.uniform(-0.5, 0.5, n)])
    inputs = np.stack([random.uniform(-1, 1, n), random.uniform(-0.3, 0.3, n)])
    theta = AV21.lower[:, None] + random.uniform(size=(len(COEFFICIENTS), n)) * (AV21.upper - AV21.lower)[:, None]
    context = {
        "t": (0, 300),
        "clock": (6400, 6700),
        "s": (0, 4000),
        "lap_length": (900, 1100),
        "theta": (-4, 4),
        "roll": (-0.1, 0.1),
    }
    signals = np.stack([random.uniform(*context.get(name, (-1, 1)), n) for name in CONTEXT_UNITS])
    return [state, inputs, theta, signals]


def advance(xp: Any, effect: Effect, integrator: Integrator, state: Any, inputs: Any, theta: Any, signals: Any) -> Any:
    """The next state and effect states after the inputs have doubled, each entry of shape ``(n,)``."""
    start, coefficients = State(*state), Coefficients(*theta)
    context = dict(zip(CONTEXT_UNITS, signals, strict=True))
    feedback, applied = Applied(0.5 * inputs[0], 0.5 * inputs[1]), Applied(*inputs)
    effects = (effect,)
    effect_states = CarModel(AV21.constants, 0.04, effects, xp=xp).settled(
        start, feedback, coefficients, context=context
    )
    following, carried = CarModel(AV21.constants, 0.04, effects, integrator, 2, xp=xp).step(
        start, applied, coefficients, effect_states, context=context
    )
    return [*following, *carried.values()]


def symbols() -> tuple[list[Any], list[list[Any]]]:
    vectors = [casadi.SX.sym(f"x{k}", size) for k, size in enumerate(SIZES)]
    return vectors, [casadi.vertsplit(vector) for vector in vectors]


@pytest.mark.parametrize("integrator", ["euler", "rk4"])
@pytest.mark.parametrize("name", sorted(EFFECTS))
def test_numpy_torch_and_casadi_agree_to_1e_12(
    name: str, integrator: Integrator, acting: Callable[..., dict[str, float]]
) -> None:
    effect, data = build_effect(name, acting(name)), samples()
    by_numpy = np.stack(advance(np, effect, integrator, *data))
    by_torch = torch.stack(advance(torch, effect, integrator, *map(torch.from_numpy, data))).numpy()
    vectors, parts = symbols()
    f = casadi.Function("f", vectors, [casadi.vertcat(*advance(casadi, effect, integrator, *parts))])
    by_casadi = np.array(f.map(data[0].shape[1])(*data))
    assert len(by_numpy) == 3 + len(effect.EFFECT_STATES)
    for other in (by_torch, by_casadi):
        np.testing.assert_allclose(other, by_numpy, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("name", sorted(EFFECTS))
def test_a_neutral_effect_is_absent_from_torch_and_casadi_too(name: str) -> None:
    data, neutral = samples(), build_effect(name, {})
    none = build_effect("steering_offset", {})
    tensors = [torch.from_numpy(a) for a in data]
    found, plain = (torch.stack(advance(torch, effect, "euler", *tensors)) for effect in (neutral, none))
    assert torch.equal(found, plain)
    _, parts = symbols()
    found, plain = (casadi.vertcat(*advance(casadi, effect, "euler", *parts)) for effect in (neutral, none))
    assert casadi.is_equal(found, plain, 100)


@pytest.mark.parametrize("name", sorted(EFFECTS))
def test_derivatives_by_the_parameters_are_finite_and_those_of_differences(
    name: str, acting: Callable[..., dict[str, float]]
) -> None:
    data, at = samples(), acting(name)
    keys = [key for key, about in EFFECTS[name].PARAMETERS.items() if not about.shape]
    parameters = {key: casadi.SX.sym(key) for key in keys}
    shape = {key: value for key, value in at.items() if key not in keys}
    vectors, parts = symbols()
    following = casadi.vertcat(*advance(casadi, EFFECTS[name](**shape, **parameters), "rk4", *parts)[:3])
    p = casadi.vertcat(*parameters.values())
    jacobian = casadi.Function("J", [*vectors, p], [casadi.jacobian(following, p)])
    found = np.array(jacobian(*(array[:, 0] for array in data), [at[key] for key in keys]))
    neutral = [EFFECTS[name].PARAMETERS[key].neutral for key in keys]
    assert np.isfinite(np.array(jacobian(*(array[:, 0] for array in data), neutral))).all()
    for column, key in enumerate(keys):
        about = EFFECTS[name].PARAMETERS[key]
        h = 1e-4 * (about.upper - about.lower)
        up, down = (
            np.array(advance(np, EFFECTS[name](**at | {key: at[key] + d}), "rk4", *(a[:, 0] for a in data))[:3])
            for d in (h, -h)
        )
        np.testing.assert_allclose(found[:, column], (up - down) / (2 * h), rtol=1e-3, atol=1e-5)
