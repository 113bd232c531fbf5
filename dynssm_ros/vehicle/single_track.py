"""The single-track car with load-dependent Pacejka tyres: Section II of the paper, written once.

Body frame after REP-103 (x forward, y left, yaw counter-clockwise), SI units. Every function takes the array
namespace ``xp`` (``numpy``, ``torch`` or ``casadi``; all offer ``sin``, ``cos``, ``arctan``, ``arctan2``), so that
training, simulation, calibration and NMPC evaluate the same lines.

The equations run in named stages over one :class:`Motion`:

    inputs -> slip -> drive -> loads -> tyres -> forces -> accelerations

After each stage the effects of the vehicle (:mod:`dynssm_ros.vehicle.effects`) may change what it computed. Physics
beyond the paper enters there, not here.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple, Protocol

GRAVITY = 9.81  # m/s^2

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
    # slip angles (rad), drive force (N), axle loads (N), lateral tyre forces (N)
    alpha_f: Array = 0.0
    alpha_r: Array = 0.0
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
    # states that effects carry along (a lag, a relaxing tyre) with their rates, and what else was measured
    memory: dict[str, Array] = field(default_factory=dict)
    memory_rate: dict[str, Array] = field(default_factory=dict)
    context: Mapping[str, Array] = field(default_factory=dict)


class StageEffect(Protocol):
    """What :func:`motion` asks of an effect: a method per stage, called after the stage's own equations."""

    def apply(self, stage: str, xp: Any, q: Motion) -> None:
        """Changes ``q`` after ``stage``."""


def inputs(xp: Any, q: Motion) -> None:
    """The measured state and the applied inputs, as they are."""


def slip(xp: Any, q: Motion) -> None:
    """Slip angles with their shifts, Eq. (4) and (5); arctan2 keeps them defined at standstill."""
    q.alpha_f = q.delta - xp.arctan2(q.l_f * q.omega + q.v_y, abs(q.v_x)) + q.theta.S_hf
    q.alpha_r = xp.arctan2(q.l_r * q.omega - q.v_y, abs(q.v_x)) + q.theta.S_hr


def drive(xp: Any, q: Motion) -> None:
    """Longitudinal force of the rear axle with rolling resistance and drag, Eq. (6)."""
    q.F_rx = (q.theta.C_m1 - q.theta.C_m2 * q.v_x) * q.r - q.theta.C_r0 - q.theta.C_r2 * q.v_x * q.v_x


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
    th = q.theta
    q.F_fy = (th.S_vf + th.D_f * xp.sin(th.C_f * shape(xp, th.B_f, th.E_f, q.alpha_f))) * (q.F_zf / q.F_z0)
    q.F_ry = (th.S_vr + th.D_r * xp.sin(th.C_r * shape(xp, th.B_r, th.E_r, q.alpha_r))) * (q.F_zr / q.F_z0)


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


STAGES: tuple[Callable[[Any, Motion], None], ...] = (inputs, slip, drive, loads, tyres, forces, accelerations)
STAGE_NAMES = tuple(stage.__name__ for stage in STAGES)


def shape(xp: Any, B: Array, E: Array, alpha: Array) -> Array:
    """Pacejka's argument psi = atan(B a - E (B a - atan(B a))), Eq. (12) and (13)."""
    slope = B * alpha
    return xp.arctan(slope - E * (slope - xp.arctan(slope)))


def motion(
    xp: Any,
    state: State,
    applied: Applied,
    theta: Coefficients,
    constants: Constants,
    effects: Sequence[StageEffect] = (),
    memory: Mapping[str, Array] | None = None,
    context: Mapping[str, Array] | None = None,
) -> Motion:
    """Evaluates all stages for one instant.

    Args:
        xp: array namespace of the values.
        state: body-frame velocities, each of shape ``(...)``.
        applied: throttle and steering that act now, broadcastable to ``(...)``.
        theta: the 17 coefficients, broadcastable to ``(...)``.
        constants: mass and geometry.
        effects: physics beyond the nominal model, in the order in which it acts.
        memory: the effects' own states by name.
        context: other measured signals by name (time, heading, track position, ...) that an effect may read.
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
        memory=dict(memory or {}),
        context=context or {},
    )
    for stage in STAGES:
        stage(xp, q)
        for effect in effects:
            effect.apply(stage.__name__, xp, q)
    return q


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
    """Advances the state by ``T_s`` seconds under constant inputs, Eq. (32).

    The paper's step is one forward Euler step; ``integrator="rk4"`` and ``substeps`` refine it. Effects with memory
    need :func:`step_with_memory`.
    """
    return step_with_memory(xp, state, {}, applied, theta, constants, T_s, effects, integrator, substeps, context)[0]


def step_with_memory(
    xp: Any,
    state: State,
    memory: Mapping[str, Array],
    applied: Applied,
    theta: Coefficients,
    constants: Constants,
    T_s: float,
    effects: Sequence[StageEffect] = (),
    integrator: Integrator = "euler",
    substeps: int = 1,
    context: Mapping[str, Array] | None = None,
) -> tuple[State, dict[str, Array]]:
    """Like :func:`step`, and integrates the effects' own states (``memory``, by name) with the car's."""
    moved, changed = increment(
        xp, state, memory, applied, theta, constants, T_s, effects, integrator, substeps, context
    )
    return State(*_add(state, moved)), {name: value + changed[name] for name, value in memory.items()}


def increment(
    xp: Any,
    state: State,
    memory: Mapping[str, Array],
    applied: Applied,
    theta: Coefficients,
    constants: Constants,
    T_s: float,
    effects: Sequence[StageEffect] = (),
    integrator: Integrator = "euler",
    substeps: int = 1,
    context: Mapping[str, Array] | None = None,
) -> tuple[State, dict[str, Array]]:
    """How much the state and the effects' own states change in ``T_s`` seconds.

    In single precision an increment is known far better than the difference of two states.
    """
    names = tuple(memory)

    def rates(y: Sequence[Array]) -> tuple[Array, ...]:
        carried = dict(zip(names, y[3:], strict=True))
        q = motion(xp, State(*y[:3]), applied, theta, constants, effects, carried, context)
        return (q.a_x, q.a_y, q.omega_dot, *(q.memory_rate[name] for name in names))

    advance, h = _INTEGRATORS[integrator], T_s / substeps
    start: tuple[Array, ...] = (*state, *memory.values())
    moved = advance(rates, start, h)
    for _ in range(substeps - 1):
        moved = _add(moved, advance(rates, _add(start, moved), h))
    return State(*moved[:3]), dict(zip(names, moved[3:], strict=True))


_Rates = Callable[[Sequence[Array]], tuple[Array, ...]]


def _euler(rates: _Rates, y: tuple[Array, ...], h: float) -> tuple[Array, ...]:
    return _times(h, rates(y))


def _rk4(rates: _Rates, y: tuple[Array, ...], h: float) -> tuple[Array, ...]:
    k1 = rates(y)
    k2 = rates(_add(y, _times(h / 2, k1)))
    k3 = rates(_add(y, _times(h / 2, k2)))
    k4 = rates(_add(y, _times(h, k3)))
    return tuple(h * (a + 2 * b + 2 * c + d) / 6 for a, b, c, d in zip(k1, k2, k3, k4, strict=True))


def _add(a: Sequence[Array], b: Sequence[Array]) -> tuple[Array, ...]:
    return tuple(x + y for x, y in zip(a, b, strict=True))


def _times(h: float, k: Sequence[Array]) -> tuple[Array, ...]:
    return tuple(h * x for x in k)


_INTEGRATORS = {"euler": _euler, "rk4": _rk4}
