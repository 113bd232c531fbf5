"""How small an effect would still be named: what the driving, the noise and badly known nominal values leave of it."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from dynssm_ros.arrays import Vector
from dynssm_ros.identification.candidates import Candidate
from dynssm_ros.identification.car import Values
from dynssm_ros.identification.noise import weights
from dynssm_ros.identification.problem import Fit, IdentificationProblem, unit
from dynssm_ros.identification.selection import DECISIVE_DELTA_BIC
from dynssm_ros.vehicle.effects import EFFECTS, LOCATION

_PLACES = np.linspace(0.0, 1.0, 8, endpoint=False)  # of the lap
_NOTHING = 1e-9  # of a squared error in units of the noise


def minimum_detectable(problem: IdentificationProblem, fit: Fit, found: Iterable[Candidate]) -> dict[str, float]:
    """The least change of each effect's first parameter, beside a fit, that the data would call a cause.

    An effect on a stretch of the lap is taken at several places, and the middle of their answers given.

    Args:
        problem: the windows.
        fit: of the car with all causes.
        found: what can be tried; the first candidate of an effect speaks for it, those of the fit are left out.

    Returns:
        By effect, in the unit of the parameter; infinite where it changes nothing that was measured.
    """
    root = _root(problem, fit)[:, None]
    J = (fit.noise.whiten(fit.jacobian) * root[..., None]).reshape(-1, fit.jacobian.shape[2])
    H = J.T @ J + problem.prior_precision(fit.position)
    needed = np.log(problem.windows.target.size) + DECISIVE_DELTA_BIC
    taken = {effect for effect, _ in fit.free}
    out: dict[str, float] = {}
    for candidate in found:
        effect = candidate.effect
        if effect in taken or effect in out:
            continue
        about, parameter = EFFECTS[effect].PARAMETERS, candidate.amplitudes[0]
        form = {name: about[name].neutral for name in candidate.shapes}
        places = [{LOCATION[0]: float(place)} for place in _PLACES] if candidate.local else [{}]
        left = np.median([_left(root * _column(problem, fit, effect, parameter, form | at), J, H) for at in places])
        least = EFFECTS[effect].least(fit.car.vehicle.constants)
        size = float(np.sqrt(needed / left) * unit(effect, parameter)) if left > _NOTHING else float("inf")
        out[effect] = max(size, least)
    return out


def _column(problem: IdentificationProblem, fit: Fit, effect: str, parameter: str, form: Values) -> Vector:
    """What a unit of a parameter does to the whitened errors, shape ``(W, 3 K)``."""
    about = EFFECTS[effect].PARAMETERS[parameter]
    moved = about.neutral + about.direction * unit(effect, parameter)
    values = dict(fit.car.effects.get(effect, {})) | form | {parameter: moved}
    change = problem.errors(fit.car.with_effect(effect, values)) - fit.errors
    return fit.noise.whiten(change)


def _root(problem: IdentificationProblem, fit: Fit) -> Vector:
    """What each window counts, ``(W,)``."""
    told = weights(fit.noise.whiten(fit.errors)) / problem.counted_once(fit)
    return np.asarray(np.sqrt(told))


def _left(response: Vector, J: Vector, H: Vector) -> float:
    """Squared length of what fitted values cannot take up of a response."""
    column = response.ravel()
    across = J.T @ column
    return float(column @ column - across @ np.linalg.solve(H, across))
