"""The single-track car with load-dependent Pacejka tyres: Section II of the paper, written once.

Body frame after REP-103 (x forward, y left, yaw counter-clockwise), SI units. Every function takes the array
namespace ``xp`` (``numpy``, ``torch`` or ``casadi``; all offer ``sin``, ``cos``, ``arctan``, ``arctan2``), so that
training, simulation, calibration and NMPC evaluate the same lines.

The equations run in named stages over one :class:`Motion`:

    inputs -> slip -> drive -> loads -> tyres -> forces -> accelerations

After each stage the effects of the vehicle (:mod:`dynssm_ros.vehicle.effects`) may change what it computed. Physics
beyond the paper enters there, not here.

Some effects change what is measured and not what happens. :func:`motion` is about what happens; the steps take and give
what is measured, because that is what a model starts from and is compared with: measured -> true -> step -> measured.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal, NamedTuple, Protocol

GRAVITY = 9.81  # m/s^2
_INSTANT = 1e-3  # s; the time that a single evaluation stands for

Array = Any  # float, numpy array, torch tensor or casadi expression: whatever ``xp`` computes with
Integrator = Literal["euler", "rk4"]


class Coefficients(NamedTuple):
    """The 17 coefficients theta that calibration finds and the network adapts, by the paper's symbols.

    Each may be a number or an array that broadcasts against the state.
    """

    B_f: Array
    C_f: Array
    D_f: Array
    E_f: Array
    B_r: Array
    C_r: Array
    D_r: Array
    E_r: Array
    S_hf: Array
    S_vf: Array
    S_hr: Array
    S_vr: Array
    C_m1: Array
    C_m2: Array
    C_r0: Array
    C_r2: Array
    I_z: Array


class State(NamedTuple):
    """``s = [v_x, v_y, omega]`` in the body frame (m/s, m/s, rad/s)."""

    v_x: Array
    v_y: Array
    omega: Array


class Applied(NamedTuple):
    """Applied inputs: throttle ``r`` as a fraction (negative brakes), road-wheel steering ``delta`` in rad."""

    r: Array
    delta: Array


class Constants(Protocol):
    """What is known of the car and not adapted."""

    @property
    def m(self) -> float:
        """Mass (kg)."""

    @property
    def l_f(self) -> float:
        """Distance from the centre of gravity to the front axle (m)."""

    @property
    def l_r(self) -> float:
        """Distance from the centre of gravity to the rear axle (m)."""

    @property
    def h_cg(self) -> float:
        """Height of the centre of gravity (m)."""

    @property
    def F_z0(self) -> float:
        """Nominal axle load (N) at which D and S_v are given."""

    @property
    def load_transfer(self) -> bool:
        """Whether lateral forces scale with the axle loads; if not, F_z / F_z0 = 1."""


@dataclass
class Motion:
    """All quantities of one instant. A stage reads what earlier stages wrote and writes its own."""

    # state and applied inputs
    v_x: Array
    v_y: Array
    omega: Array
    r: Array
    delta: Array
    # the car
    theta: Coefficients
    m: Array
    l_f: Array
    l_r: Array
    h_cg: Array
    F_z0: Array
    load_transfer: bool
    # slip angles (rad), force of drive and brakes, what resistances leave of it, axle loads, lateral tyre forces (N)
    alpha_f: Array = 0.0
    alpha_r: Array = 0.0
    F_d: Array = 0.0
    F_rx: Array = 0.0
    F_zf: Array = 0.0
    F_zr: Array = 0.0
    F_fy: Array = 0.0
    F_ry: Array = 0.0
    # forces (N) and moment (N m) on the body
    F_x: Array = 0.0
    F_y: Array = 0.0
    M_z: Array = 0.0
    # time derivatives of the state
    a_x: Array = 0.0
    a_y: Array = 0.0
    omega_dot: Array = 0.0
    # states that effects carry along (a lag, a relaxing tyre) with their rates, what else was measured, and the time (s)
    # over which the integrator holds the rates
    effect_states: dict[str, Array] = field(default_factory=dict)
    effect_state_rates: dict[str, Array] = field(default_factory=dict)
    context: Mapping[str, Array] = field(default_factory=dict)
    h: float = _INSTANT


class StageEffect:
    """Physics beyond the nominal equations. A subclass overrides the stages at which it acts.

    Each method is called after the stage of its name and may change what that stage computed. An effect of the sensors
    overrides ``measured`` and its inverse ``true`` instead.

    Attributes:
        NAME: for messages.
        HOOKS: the methods of which it overrides at least one.
    """

    NAME: ClassVar[str] = ""
    HOOKS: ClassVar = ("inputs", "slip", "drive", "loads", "tyres", "forces", "accelerations", "measured")

    @property
    def is_neutral(self) -> bool:
        """Whether it is absent; then nothing of it is evaluated."""
        return False

    @property
    def needs(self) -> tuple[str, ...]:
        """Signals beside state and inputs that it reads, by the names of ``CONTEXT_UNITS``."""
        return ()

    @property
    def carries(self) -> tuple[str, ...]:
        """Names of its own states (a lag, a relaxing tyre), which the integrator advances with the car's."""
        return ()

    @property
    def measures(self) -> bool:
        """Whether it changes what is measured, and not what happens."""
        return False

    def inputs(self, xp: Any, q: Motion) -> None:
        """Changes state, applied inputs or parameters of the car before anything is computed from them."""

    def slip(self, xp: Any, q: Motion) -> None:
        """Changes the slip angles."""

    def drive(self, xp: Any, q: Motion) -> None:
        """Changes the longitudinal force."""

    def loads(self, xp: Any, q: Motion) -> None:
        """Changes the axle loads."""

    def tyres(self, xp: Any, q: Motion) -> None:
        """Changes the lateral tyre forces."""

    def forces(self, xp: Any, q: Motion) -> None:
        """Changes the forces and the moment on the body."""

    def accelerations(self, xp: Any, q: Motion) -> None:
        """Changes the derivatives of the state."""

    def measured(self, xp: Any, state: State, effect_states: Mapping[str, Array]) -> State:
        """What is measured of the true ``state``."""
        return state

    def true(self, xp: Any, state: State, effect_states: Mapping[str, Array]) -> State:
        """The true state of which ``state`` is measured: the inverse of :meth:`measured`."""
        return state


def inputs(xp: Any, q: Motion) -> None:
    """The measured state and the applied inputs, as they are."""


def slip(xp: Any, q: Motion) -> None:
    """Slip angles with their shifts, Eq. (4) and (5); arctan2 keeps them defined at standstill."""
    q.alpha_f = q.delta - xp.arctan2(q.l_f * q.omega + q.v_y, abs(q.v_x)) + q.theta.S_hf
    q.alpha_r = xp.arctan2(q.l_r * q.omega - q.v_y, abs(q.v_x)) + q.theta.S_hr


def drive(xp: Any, q: Motion) -> None:
    """Longitudinal force of the rear axle with rolling resistance and drag, Eq. (6)."""
    q.F_d = (q.theta.C_m1 - q.theta.C_m2 * q.v_x) * q.r
    q.F_rx = q.F_d - q.theta.C_r0 - q.theta.C_r2 * q.v_x * q.v_x


def loads(xp: Any, q: Motion) -> None:
    """Axle loads under longitudinal load transfer, Eq. (7) to (9)."""
    if not q.load_transfer:
        q.F_zf = q.F_zr = q.F_z0
        return
    wheelbase = q.l_f + q.l_r
    weight, transfer = q.m * GRAVITY, q.h_cg / wheelbase * q.F_rx
    q.F_zf = weight * q.l_r / wheelbase - transfer
    q.F_zr = weight * q.l_f / wheelbase + transfer


def tyres(xp: Any, q: Motion) -> None:
    """Lateral tyre forces: load-dependent Pacejka with curvature, Eq. (10) to (13)."""
    q.F_fy = front_force(xp, q.theta, q.alpha_f) * (q.F_zf / q.F_z0)
    q.F_ry = rear_force(xp, q.theta, q.alpha_r) * (q.F_zr / q.F_z0)


def forces(xp: Any, q: Motion) -> None:
    """Sums the tyre forces in the body frame, the numerators of Eq. (1) to (3)."""
    q.F_x = q.F_rx - q.F_fy * xp.sin(q.delta)
    across = q.F_fy * xp.cos(q.delta)
    q.F_y = q.F_ry + across
    q.M_z = q.l_f * across - q.l_r * q.F_ry


def accelerations(xp: Any, q: Motion) -> None:
    """Newton and Euler in the rotating body frame, Eq. (1) to (3)."""
    q.a_x = q.F_x / q.m + q.v_y * q.omega
    q.a_y = q.F_y / q.m - q.v_x * q.omega
    q.omega_dot = q.M_z / q.theta.I_z


def lateral_force(xp: Any, B: Array, C: Array, D: Array, E: Array, S_v: Array, alpha: Array) -> Array:
    """Magic formula: lateral force (N) of an axle at its nominal load and slip angle ``alpha`` (rad), Eq. (10) to (13).

    ``S_v + D sin(C atan(B a - E (B a - atan(B a))))``; the slip angle contains its shift S_h.
    """
    slope = B * alpha
    return S_v + D * xp.sin(C * xp.arctan(slope - E * (slope - xp.arctan(slope))))


def front_force(xp: Any, th: Coefficients, alpha: Array) -> Array:
    """Lateral force (N) of the front axle at its nominal load."""
    return lateral_force(xp, th.B_f, th.C_f, th.D_f, th.E_f, th.S_vf, alpha)


def rear_force(xp: Any, th: Coefficients, alpha: Array) -> Array:
    """Lateral force (N) of the rear axle at its nominal load."""
    return lateral_force(xp, th.B_r, th.C_r, th.D_r, th.E_r, th.S_vr, alpha)


def cornering_stiffness(th: Coefficients) -> tuple[Array, Array]:
    """Slope of the lateral force (N/rad) of front and rear axle where the tyre does not slip: ``B C D``."""
    return th.B_f * th.C_f * th.D_f, th.B_r * th.C_r * th.D_r


def settling_rate(th: Coefficients, car: Constants) -> Array:
    """How fast sideslip and yaw of the linear car settle, times the speed (m/s^2).

    Their rates are about ``sum C / (m v_x)`` and ``sum C l^2 / (I_z v_x)``, ``C`` the cornering stiffness of an axle; this
    is the larger one times ``v_x``.
    """
    C_f, C_r = cornering_stiffness(th)
    return max((C_f + C_r) / car.m, (C_f * car.l_f**2 + C_r * car.l_r**2) / th.I_z)


def at_least(value: Array, floor: Array) -> Array:
    """The larger of the two, in any array namespace."""
    return (value + floor + abs(value - floor)) / 2


def motion(
    xp: Any,
    state: State,
    applied: Applied,
    theta: Coefficients,
    constants: Constants,
    effects: Sequence[StageEffect] = (),
    effect_states: Mapping[str, Array] | None = None,
    context: Mapping[str, Array] | None = None,
    h: float = _INSTANT,
) -> Motion:
    """Evaluates all stages for one instant.

    Args:
        xp: array namespace of the values.
        state: true body-frame velocities, each of shape ``(...)``.
        applied: throttle and steering that act now, broadcastable to ``(...)``.
        theta: the 17 coefficients, broadcastable to ``(...)``.
        constants: mass and geometry.
        effects: physics beyond the nominal model, in the order in which it acts.
        effect_states: the effects' own states by name; those left out are settled and returned with the result.
        context: other signals by the names of ``CONTEXT_UNITS`` (time, heading, track position, ...) that effects read.
        h: time (s) over which an integrator holds the rates; lags that are quicker settle within it.

    Raises:
        ConfigurationError: an effect needs a signal that ``context`` does not have.
    """
    q = Motion(
        *state,
        *applied,
        theta=theta,
        m=constants.m,
        l_f=constants.l_f,
        l_r=constants.l_r,
        h_cg=constants.h_cg,
        F_z0=constants.F_z0,
        load_transfer=constants.load_transfer,
        effect_states=dict(effect_states or {}),
        context=context or {},
        h=h,
    )
    acting = [effect for effect in effects if not effect.is_neutral]
    inputs(xp, q)
    for effect in acting:
        effect.inputs(xp, q)
    slip(xp, q)
    for effect in acting:
        effect.slip(xp, q)
    drive(xp, q)
    for effect in acting:
        effect.drive(xp, q)
    loads(xp, q)
    for effect in acting:
        effect.loads(xp, q)
    tyres(xp, q)
    for effect in acting:
        effect.tyres(xp, q)
    forces(xp, q)
    for effect in acting:
        effect.forces(xp, q)
    accelerations(xp, q)
    for effect in acting:
        effect.accelerations(xp, q)
    return q


def measuring(effects: Sequence[StageEffect]) -> tuple[StageEffect, ...]:
    """Those of ``effects`` that change what is measured."""
    return tuple(effect for effect in effects if effect.measures)


def measured_state(xp: Any, state: State, effects: Sequence[StageEffect], effect_states: Mapping[str, Array]) -> State:
    """What sensors show of the true ``state``: the effects that measure, one after the other."""
    for effect in measuring(effects):
        state = effect.measured(xp, state, effect_states)
    return state


def true_state(xp: Any, state: State, effects: Sequence[StageEffect], effect_states: Mapping[str, Array]) -> State:
    """The true state behind a measured one: the inverse of :func:`measured_state`."""
    for effect in reversed(measuring(effects)):
        state = effect.true(xp, state, effect_states)
    return state


def settled_effect_states(
    xp: Any,
    state: State,
    applied: Applied,
    theta: Coefficients,
    constants: Constants,
    effects: Sequence[StageEffect],
    effect_states: Mapping[str, Array] | None = None,
    context: Mapping[str, Array] | None = None,
    measured: bool = True,
) -> dict[str, Array]:
    """``effect_states`` and the effects' own states that it lacks, settled.

    A sensor's state that hides part of the true motion hangs on that motion in turn; where ``state`` is a measured one,
    both are found by a secant step, exact as far as the motion is linear in what is hidden.

    Args:
        xp: array namespace of the values.
        state: body-frame velocities, each of shape ``(...)``.
        applied: the inputs under which the states settle: to start from measured rows, what acted until then, the
            actuators' feedback.
        theta: the 17 coefficients.
        constants: mass and geometry.
        effects: physics beyond the nominal model.
        effect_states: own states that are known, by name; they stay.
        context: other signals, as in :func:`motion`.
        measured: whether ``state`` is what is measured or the true one.
    """
    known = dict(effect_states or {})
    if all(name in known for effect in effects for name in effect.carries):
        return known
    sensors = measuring(effects) if measured else ()

    def settled(hidden: Mapping[str, Array]) -> dict[str, Array]:
        true = true_state(xp, state, sensors, {**known, **hidden})
        return motion(xp, true, applied, theta, constants, effects, known, context).effect_states

    first = settled({})
    names = [name for sensor in sensors for name in sensor.carries if name not in known]
    if not names:
        return first
    second = settled({name: first[name] for name in names})
    hidden = {name: _meeting(first[name], second[name]) for name in names}
    return settled(hidden) | hidden


def step(
    xp: Any,
    state: State,
    applied: Applied,
    theta: Coefficients,
    constants: Constants,
    T_s: float,
    effects: Sequence[StageEffect] = (),
    integrator: Integrator = "euler",
    substeps: int = 1,
    context: Mapping[str, Array] | None = None,
) -> State:
    """Advances the measured state by ``T_s`` seconds under constant inputs, Eq. (32).

    The paper's step is one forward Euler step; ``integrator="rk4"`` and ``substeps`` refine it. States of effects
    start settled; :func:`step_with_effect_states` carries it on.
    """
    return step_with_effect_states(
        xp, state, {}, applied, theta, constants, T_s, effects, integrator, substeps, context
    )[0]


def step_with_effect_states(
    xp: Any,
    state: State,
    effect_states: Mapping[str, Array],
    applied: Applied,
    theta: Coefficients,
    constants: Constants,
    T_s: float,
    effects: Sequence[StageEffect] = (),
    integrator: Integrator = "euler",
    substeps: int = 1,
    context: Mapping[str, Array] | None = None,
    measured: bool = True,
) -> tuple[State, dict[str, Array]]:
    """Like :func:`step`, and integrates the effects' own states (``effect_states``, by name) with the car's.

    States of effects that ``effect_states`` lacks start settled. ``measured`` says whether the states are measured ones, as
    models step them, or true ones, as a plant does.
    """
    effect_states = settled_effect_states(
        xp, state, applied, theta, constants, effects, effect_states, context, measured
    )
    moved, changed = increment(
        xp, state, effect_states, applied, theta, constants, T_s, effects, integrator, substeps, context, measured
    )
    return State(*_add(state, moved)), {name: value + changed[name] for name, value in effect_states.items()}


def increment(
    xp: Any,
    state: State,
    effect_states: Mapping[str, Array],
    applied: Applied,
    theta: Coefficients,
    constants: Constants,
    T_s: float,
    effects: Sequence[StageEffect] = (),
    integrator: Integrator = "euler",
    substeps: int = 1,
    context: Mapping[str, Array] | None = None,
    measured: bool = True,
) -> tuple[State, dict[str, Array]]:
    """How much the state and the effects' own states change in ``T_s`` seconds; see :func:`step_with_effect_states`.

    In single precision an increment is known far better than the difference of two states.
    """
    effect_states = settled_effect_states(
        xp, state, applied, theta, constants, effects, effect_states, context, measured
    )
    sensors = measuring(effects) if measured else ()
    true = true_state(xp, state, sensors, effect_states)
    names, h = tuple(effect_states), T_s / substeps

    def rates(y: Sequence[Array]) -> tuple[Array, ...]:
        carried = dict(zip(names, y[3:], strict=True))
        q = motion(xp, State(*y[:3]), applied, theta, constants, effects, carried, context, h)
        return (q.a_x, q.a_y, q.omega_dot, *(q.effect_state_rates[name] for name in names))

    moved = integrate(rates, (*true, *effect_states.values()), T_s, integrator, substeps)
    change, changed = State(*moved[:3]), dict(zip(names, moved[3:], strict=True))
    if sensors:
        end = {name: value + changed[name] for name, value in effect_states.items()}
        change = State(*_subtract(measured_state(xp, State(*_add(true, change)), sensors, end), state))
    return change, changed


def _meeting(first: Array, second: Array) -> Array:
    """Where the line through ``(0, first)`` and ``(first, second)`` meets the diagonal, if it falls or hardly rises."""
    square = first * first
    return first * square / at_least(2 * square - first * second, square / 4 + 1e-30)


Rates = Callable[[Sequence[Array]], tuple[Array, ...]]
"""From quantities to their time derivatives."""


def integrate(
    rates: Rates, start: tuple[Array, ...], T_s: float, integrator: Integrator, substeps: int
) -> tuple[Array, ...]:
    """How much the quantities ``start`` change in ``T_s`` seconds."""
    advance, h = _INTEGRATORS[integrator], T_s / substeps
    moved = advance(rates, start, h)
    for _ in range(substeps - 1):
        moved = _add(moved, advance(rates, _add(start, moved), h))
    return moved


def _euler(rates: Rates, y: tuple[Array, ...], h: float) -> tuple[Array, ...]:
    return _times(h, rates(y))


def _rk4(rates: Rates, y: tuple[Array, ...], h: float) -> tuple[Array, ...]:
    k1 = rates(y)
    k2 = rates(_add(y, _times(h / 2, k1)))
    k3 = rates(_add(y, _times(h / 2, k2)))
    k4 = rates(_add(y, _times(h, k3)))
    return tuple(h * (a + 2 * b + 2 * c + d) / 6 for a, b, c, d in zip(k1, k2, k3, k4, strict=True))


def _add(a: Sequence[Array], b: Sequence[Array]) -> tuple[Array, ...]:
    return tuple(x + y for x, y in zip(a, b, strict=True))


def _subtract(a: Sequence[Array], b: Sequence[Array]) -> tuple[Array, ...]:
    return tuple(x - y for x, y in zip(a, b, strict=True))


def _times(h: float, k: Sequence[Array]) -> tuple[Array, ...]:
    return tuple(h * x for x in k)


_INTEGRATORS = {"euler": _euler, "rk4": _rk4}
