"""The car as code: C that casadi generates, and a model of the solver acados.

States are the pose, the velocities and the effects' own states, inputs the applied throttle and steering. Both hold the
equations of the package with the effects of the vehicle file, from standstill on. Of a car whose sensors have effects the
states are the true ones.
"""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from dynssm_ros.control.exports.names import identifier
from dynssm_ros.errors import ConfigurationError
from dynssm_ros.vehicle import COEFFICIENTS, Applied, CarModel, Coefficients, State, Vehicle
from dynssm_ros.vehicle.kinematics import Pose, advance_pose, world_velocity

STATES = ("x", "y", "theta", "v_x", "v_y", "omega")
INPUTS = ("r", "delta")
_UNITS = ("m", "m", "rad", "m/s", "m/s", "rad/s")
_HEADER = """\
/* Car {name}: one step of {T_s:g} s, written by dynssm_ros. {note}

   States: {states}.
   Inputs, as applied: {inputs}. Parameters: the coefficients, in the order of enum {Name}_PARAMETER. */
#ifndef {Name}_CAR_H
#define {Name}_CAR_H

#include "{name}.h"

enum {Name}_STATE {{ {state_names}, {Name}_STATES }};
enum {Name}_INPUT {{ {input_names}, {Name}_INPUTS }};
enum {Name}_PARAMETER {{ {parameter_names}, {Name}_PARAMETERS }};

static const double {name}_T_s = {T_s!r}; /* s */

/* The calibrated coefficients. */
static const double {name}_nominal[{Name}_PARAMETERS] = {{ {values} }};

/* The states one step on. Without parameters the calibrated ones hold. Returns 0. */
static inline int {name}_next(const double x[{Name}_STATES], const double u[{Name}_INPUTS], const double *p,
                              double next[{Name}_STATES]) {{
    const double *arguments[{arguments}] = {{x, u, p ? p : {name}_nominal}};
    double *results[{results}] = {{next}}, work[{work}];
    casadi_int whole[{whole}];
    return {name}_step(arguments, results, whole, work, 0);
}}

#endif
"""
_EXAMPLE = """\
// Reads rows of states and inputs, writes the states one step on: c++ -O2 {name}_example.cpp {name}.c -o {name}_example
#include "{name}_car.h"

#include <cstdio>

int main() {{
    double row[{Name}_STATES + {Name}_INPUTS], next[{Name}_STATES];
    for (;;) {{
        for (double &value : row)
            if (std::scanf("%lf", &value) != 1) return 0;
        {name}_next(row, row + {Name}_STATES, nullptr, next);
        for (int k = 0; k < {Name}_STATES; k++) std::printf("%.17g%c", next[k], k + 1 < {Name}_STATES ? ' ' : '\\n');
    }}
}}
"""
_ACADOS = '''\
"""Car {name} for acados, written by dynssm_ros: ``from {name}_acados import NOMINAL, model``.

``ocp.model = model()``, ``ocp.parameter_values = NOMINAL``. ``f_expl_expr`` are the rates, for an integrator of acados
(``ERK``); ``disc_dyn_expr`` is the package's own step of {T_s:g} s (``DISCRETE``).
"""

from pathlib import Path

import casadi as ca
from acados_template import AcadosModel

STATES = {states!r}
INPUTS = {inputs!r}  # as applied
PARAMETERS = {parameters!r}
NOMINAL = {values!r}
"""The calibrated coefficients."""


def model() -> AcadosModel:
    """The model with symbols of its own."""
    x, u, p = (ca.SX.sym(name, len(names)) for name, names in (("x", STATES), ("u", INPUTS), ("p", PARAMETERS)))
    xdot = ca.SX.sym("xdot", len(STATES))
    rates, step = (_function(which)(x, u, p) for which in ("rates", "step"))
    made = AcadosModel()
    made.name, made.x, made.xdot, made.u, made.p = "{name}", x, xdot, u, p
    made.f_expl_expr, made.f_impl_expr, made.disc_dyn_expr = rates, xdot - rates, step
    made.x_labels, made.u_labels = list(STATES), list(INPUTS)
    return made


def _function(which: str) -> ca.Function:
    return ca.Function.deserialize(Path(__file__).with_name(f"{name}_{{which}}.casadi").read_text(encoding="utf-8"))
'''


class Functions(NamedTuple):
    """The car as casadi functions of states, inputs and coefficients."""

    states: tuple[str, ...]
    step: Any
    """The states T_s later."""
    rates: Any
    """Their time derivatives."""


def functions(vehicle: Vehicle) -> Functions:
    """The equations of a car.

    Raises:
        ConfigurationError: an effect depends on place or time, which these functions do not know.
    """
    import casadi as ca

    needs = sorted({need for effect in vehicle.active_effects if not effect.measures for need in effect.needs})
    if needs:
        raise ConfigurationError(
            f"vehicle {vehicle.name}: an effect reads {', '.join(needs)}, which exported functions do not have; expected "
            f"effects of velocities and inputs alone"
        )
    car = CarModel.at_any_speed(vehicle).under(ca)
    car = replace(car, effects=tuple(effect for effect in car.effects if not effect.measures))
    states = (*STATES, *car.effect_states)
    x, u, p = (ca.SX.sym(what, count) for what, count in (("x", len(states)), ("u", 2), ("p", len(COEFFICIENTS))))
    values = ca.vertsplit(x)
    pose, now = Pose(*values[:3]), State(*values[3:6])
    own = dict(zip(car.effect_states, values[6:], strict=True))
    applied, theta = Applied(*ca.vertsplit(u)), Coefficients(*ca.vertsplit(p))
    following, owned = car.step(now, applied, theta, own)
    after = advance_pose(ca, pose, now, following, car.T_s)
    q = car.motion(now, applied, theta, own, h=car.T_s / car.substeps)
    x_dot, y_dot = world_velocity(ca, pose.theta, q.v_x, q.v_y)
    rates = [x_dot, y_dot, q.omega, q.a_x, q.a_y, q.omega_dot, *(q.effect_state_rates[name] for name in own)]
    name, options = identifier(vehicle.name), {"cse": True}
    return Functions(
        states,
        ca.Function(
            f"{name}_step",
            [x, u, p],
            [ca.densify(ca.vertcat(*after, *following, *(owned[each] for each in own)))],
            options,
        ),
        ca.Function(f"{name}_rates", [x, u, p], [ca.densify(ca.vertcat(*rates))], options),
    )


def c_files(vehicle: Vehicle) -> dict[str, str]:
    """C source of a step, its header with names and calibrated coefficients, and a C++ program that calls it."""
    import casadi as ca

    made, name = functions(vehicle), identifier(vehicle.name)
    words = _words(vehicle, made, name)
    with tempfile.TemporaryDirectory() as folder:
        generator = ca.CodeGenerator(f"{name}.c", {"with_header": True})
        generator.add(made.step)
        generator.generate(f"{folder}/")
        files = {each: (Path(folder) / each).read_text(encoding="utf-8") for each in (f"{name}.c", f"{name}.h")}
    return files | {f"{name}_car.h": _HEADER.format(**words), f"{name}_example.cpp": _EXAMPLE.format(**words)}


def _words(vehicle: Vehicle, made: Functions, name: str) -> dict[str, Any]:
    """What the templates of the C files say."""
    step, upper = made.step, name.upper()
    first = "speed set-point (m/s)" if vehicle.inputs.set_point == "speed" else "signed throttle (fraction)"

    def named(names: tuple[str, ...]) -> str:
        return ", ".join(f"{upper}_{identifier(each).upper()}" for each in names)

    return {
        "name": name, "Name": upper, "T_s": vehicle.sampling_time, "note": f"Integrator: {vehicle.model_integrator}.",
        "states": ", ".join(f"{state} ({unit})" for state, unit in zip(STATES, _UNITS, strict=True))
        + "".join(f", {state}" for state in made.states[len(STATES) :]),
        "inputs": f"{first}, road-wheel angle (rad)", "state_names": named(made.states), "input_names": named(INPUTS),
        "parameter_names": named(COEFFICIENTS), "values": ", ".join(map(repr, vehicle.nominal.tolist())),
        "arguments": step.sz_arg(), "results": step.sz_res(), "work": max(step.sz_w(), 1), "whole": max(step.sz_iw(), 1),
    }  # fmt: skip


def acados_files(vehicle: Vehicle) -> dict[str, str]:
    """A Python module that makes the model, and the functions that it loads."""
    made, name = functions(vehicle), identifier(vehicle.name)
    module = _ACADOS.format(
        name=name, T_s=vehicle.sampling_time, states=made.states, inputs=INPUTS, parameters=COEFFICIENTS,
        values=vehicle.nominal.tolist(),
    )  # fmt: skip
    return {
        f"{name}_acados.py": module,
        f"{name}_step.casadi": made.step.serialize(),
        f"{name}_rates.casadi": made.rates.serialize(),
    }
