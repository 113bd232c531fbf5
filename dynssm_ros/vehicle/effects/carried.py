"""Effect states carried along measured rows: where a lagging steering is shows in the rows before, and in no sensor."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from dynssm_ros.vehicle.effects.base import initial_effect_states, inputs_alone
from dynssm_ros.vehicle.single_track import (
    Applied,
    Array,
    Coefficients,
    Constants,
    Integrator,
    StageEffect,
    State,
    increment,
    integrate,
    settled_effect_states,
)

CARRIED_S = 0.64
"""Length of the window over which effect states are carried (s); lags are far shorter."""


def carries(effects: Sequence[StageEffect]) -> bool:
    """Whether any of ``effects`` has states of its own."""
    return any(effect.carries for effect in effects)


def effect_states_along(
    xp: Any,
    states: Sequence[State],
    applied: Sequence[Applied],
    feedback: Applied,
    theta: Coefficients,
    constants: Constants,
    T_s: float,
    effects: Sequence[StageEffect] = (),
    integrator: Integrator = "euler",
    substeps: int = 1,
) -> list[dict[str, Array]]:
    """The effects' own states at each of several measured rows, carried from row to row.

    At every row the state is the measured one; only what no sensor shows is carried. States on the inputs alone, as those
    of lagging actuators, are carried without the car's equations.

    Args:
        xp: array namespace.
        states: measured, in order, ``T_s`` apart.
        applied: inputs that act from each of them on.
        feedback: measured inputs at the first row, under which the effect states are settled there.
        theta: the 17 coefficients.
        constants: mass and geometry.
        T_s: length of a step (s).
        effects: physics beyond the nominal model.
        integrator: of each step.
        substeps: integration steps per sampling time.
    """
    known = initial_effect_states(effects, *feedback)
    carried = settled_effect_states(xp, states[0], applied[0], theta, constants, effects, known)
    found, names = [carried], tuple(carried)
    for state, acting in zip(states[:-1], applied[:-1], strict=True):
        if carried.keys() == known.keys():

            def rates(y: Sequence[Array], state: State = state, acting: Applied = acting) -> tuple[Array, ...]:
                here = dict(zip(names, y, strict=True))
                q = inputs_alone(xp, state, acting, effects, here, T_s / substeps)
                return tuple(q.effect_state_rates[name] for name in names)

            changes = integrate(rates, tuple(carried.values()), T_s, integrator, substeps)
            changed = dict(zip(names, changes, strict=True))
        else:
            _, changed = increment(xp, state, carried, acting, theta, constants, T_s, effects, integrator, substeps)
        carried = {name: value + changed[name] for name, value in carried.items()}
        found.append(carried)
    return found
