"""The single-track car with load-dependent Pacejka tyres: Section II of the paper, written once.

Body frame after REP-103 (x forward, y left, yaw counter-clockwise), SI units. Every function takes the array
namespace ``xp`` (``numpy``, ``torch`` or ``casadi``; all offer ``sin``, ``cos``, ``arctan``, ``arctan2``), so that
training, simulation, calibration and NMPC evaluate the same lines.

The equations run in named stages over one :class:`Motion`:

    inputs -> slip -> drive -> loads -> tyres -> forces -> accelerations

After each stage the effects of the vehicle (:mod:`dynssm_ros.vehicle.effects`) may change what it computed. Physics
beyond the paper enters there, not here.

:class:`~dynssm_ros.vehicle.car.CarModel` binds them to a car and steps it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal, NamedTuple

from pydantic import Field

from dynssm_ros.arrays import Vector
from dynssm_ros.configuration import StrictModel

GRAVITY = 9.81  # m/s^2
INSTANT = 1e-3  # time that a single evaluation stands for (s)

SetPoint = Literal["throttle", "speed"]
"""What the first input asks for: a share of the drive force, or a speed that the car's own controller holds."""

Array = Any  # float, numpy array, torch tensor or casadi expression: whatever ``xp`` computes with


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
    """Applied inputs: throttle ``r`` as a fraction (negative brakes), road-wheel steering ``delta`` in rad.

    Of a car with a speed set-point ``r`` is that speed (m/s).
    """

    r: Array
    delta: Array


class VehicleConstants(StrictModel):
    """Mass and geometry, known and not adapted."""

    m: float = Field(gt=0, description="mass (kg)")
    m_std: float | None = Field(
        default=None, ge=0, description="standard deviation with which it was weighed (kg); null: 1 % of it"
    )
    l_f: float = Field(gt=0, description="centre of gravity to front axle (m)")
    l_r: float = Field(gt=0, description="centre of gravity to rear axle (m)")
    h_cg: float = Field(ge=0, description="height of the centre of gravity (m)")
    F_z0: float = Field(gt=0, description="nominal axle load (N) at which D and S_v hold")
    load_transfer: bool = Field(description="scale lateral forces with the axle loads")
    reverse: bool = Field(
        default=False,
        description="a negative throttle drives the car backwards once it stands, as speed controllers of model cars do; "
        "false: it only brakes",
    )

    @property
    def wheelbase(self) -> float:
        """Distance of the axles (m)."""
        return self.l_f + self.l_r


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
    set_point: SetPoint = "throttle"
    reverse: bool = False
    # direction of travel, from -1 (backwards) through 0 (standing) to 1
    direction: Array = 1.0
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
    h: float = INSTANT


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

    def before(self, rows: Vector) -> dict[str, Vector]:
        """Own states at measured rows ``(7, N)`` that the drive until there tells, by name, each ``(N,)``.

        A simulation that begins there is given them in the context.
        """
        return {}

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


def standing_speed(wheelbase: Array) -> Array:
    """Speed (m/s) below which a car of that ``wheelbase`` (m) passes over to standing: 0.1 for 1:43, 0.7 for a race car.

    Its Froude number ``v^2 / (g L)`` is 1/64 there. At full lock it corners with less than a hundredth of g, so that its
    tyres hardly slip.
    """
    return (GRAVITY * wheelbase) ** 0.5 / 8


def slip(xp: Any, q: Motion) -> None:
    """Slip angles with their shifts, Eq. (4) and (5), by the direction of travel.

    A car that reverses is one that steers at its rear and drives forwards, seen from behind. So steering and shifts, which
    are angles of the wheels, change their sign; the part of the axle's own motion does not. Below the standing speed the
    direction passes over smoothly (cubic), and the speed that divides stays above 3/8 of the standing one.
    """
    standing = standing_speed(q.l_f + q.l_r)
    speed = abs(q.v_x)
    slow = speed < standing
    top = speed + slow * (standing - speed)
    share = q.v_x / top  # from -1 to 1
    square = share * share
    q.direction = share * (3 - square) / 2
    rolled = top + standing * (square * (6 - square) - 5) / 8
    q.alpha_f = q.direction * q.delta - xp.arctan2(q.l_f * q.omega + q.v_y, rolled) + q.direction * q.theta.S_hf
    q.alpha_r = xp.arctan2(q.l_r * q.omega - q.v_y, rolled) + q.direction * q.theta.S_hr


def drive(xp: Any, q: Motion) -> None:
    """Longitudinal force of the rear axle with rolling resistance and drag, Eq. (6), against the direction of travel.

    Brakes act against it too: the negative throttle of a car that has no ``reverse``. A car that stands is held by the
    resistance until the drive overcomes it.
    """
    C_r0, standing = q.theta.C_r0, 1 - q.direction * q.direction
    speed = q.direction * q.v_x  # as smooth as the direction
    gain = q.theta.C_m1 - q.theta.C_m2 * speed
    if q.set_point == "speed":
        q.F_d = drives = speed_controller_force(q.theta, q.r - q.v_x)
    elif q.reverse:
        q.F_d = drives = gain * q.r
    else:
        drives = gain * (q.r + abs(q.r)) / 2
        q.F_d = drives + q.direction * (gain * (q.r - abs(q.r)) / 2)
    reached = (abs(drives + C_r0) - abs(drives - C_r0)) / 2  # of the drive, as far as the resistance reaches
    held = drives + (abs(drives) > C_r0) * (reached - drives)  # exactly all of it where it does
    q.F_rx = q.F_d - (q.direction * C_r0 + standing * held) - q.theta.C_r2 * q.v_x * speed


def speed_controller_force(th: Coefficients, error: Array) -> Array:
    """Force (N) of a first-order speed controller at a speed ``error``, set-point less speed (m/s).

    ``F / (1 + (F / C_m1)^4)^(1/4)`` with ``F = C_m2 error``: proportional, softly limited to ``C_m1`` on both sides.
    """
    force = th.C_m2 * error
    square = (force / th.C_m1) * (force / th.C_m1)  # Python's own power of large numbers raises
    return force / (1.0 + square * square) ** 0.25


def speed_error_for(th: Coefficients, force: float, most: float = 0.98) -> float:
    """The speed error (m/s) at which the controller gives ``force`` (N), or its share ``most`` of the limit."""
    share = min(max(force / th.C_m1, -most), most)
    return float(th.C_m1 * share / (th.C_m2 * (1.0 - share**4) ** 0.25))


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
    """Sums the tyre forces in the body frame, the numerators of Eq. (1) to (3). Rolling wheels do not hold the car back."""
    q.F_x = q.F_rx - q.direction * q.direction * q.F_fy * xp.sin(q.delta)
    across = q.F_fy * xp.cos(q.delta)
    q.F_y = q.F_ry + across
    q.M_z = q.l_f * across - q.l_r * q.F_ry


def accelerations(xp: Any, q: Motion) -> None:
    """Newton and Euler in the rotating body frame, Eq. (1) to (3); towards standstill the wheels roll without slip.

    There the tyres respond within any step: forward Euler would ring, and a car that stands would slide.
    """
    q.a_x = q.F_x / q.m + q.v_y * q.omega
    a_y = q.F_y / q.m - q.v_x * q.omega
    omega_dot = q.M_z / q.theta.I_z
    sliding = q.direction * q.direction
    rolling_a_y, rolling_omega_dot = rolling(xp, q, q.h)
    q.a_y = sliding * a_y + (1 - sliding) * rolling_a_y
    q.omega_dot = sliding * omega_dot + (1 - sliding) * rolling_omega_dot


def rolling(xp: Any, q: Motion, h: float) -> tuple[Array, Array]:
    """Rates of ``v_y`` and ``omega`` with which the wheels roll without slip after ``h`` seconds, forwards or backwards."""
    omega = q.v_x * xp.tan(q.delta) / (q.l_f + q.l_r)
    return (q.l_r * omega - q.v_y) / h, (omega - q.omega) / h


def lateral_force(xp: Any, alpha: Array, *, B: Array, C: Array, D: Array, E: Array, S_v: Array) -> Array:
    """Magic formula: lateral force (N) of an axle at its nominal load and slip angle ``alpha`` (rad), Eq. (10) to (13).

    ``S_v + D sin(C atan(B a - E (B a - atan(B a))))``; the slip angle contains its shift S_h.
    """
    slope = B * alpha
    return S_v + D * xp.sin(C * xp.arctan(slope - E * (slope - xp.arctan(slope))))


def front_force(xp: Any, th: Coefficients, alpha: Array) -> Array:
    """Lateral force (N) of the front axle at its nominal load."""
    return lateral_force(xp, alpha, B=th.B_f, C=th.C_f, D=th.D_f, E=th.E_f, S_v=th.S_vf)


def rear_force(xp: Any, th: Coefficients, alpha: Array) -> Array:
    """Lateral force (N) of the rear axle at its nominal load."""
    return lateral_force(xp, alpha, B=th.B_r, C=th.C_r, D=th.D_r, E=th.E_r, S_v=th.S_vr)


def cornering_stiffness(th: Coefficients) -> tuple[Array, Array]:
    """Slope of the lateral force (N/rad) of front and rear axle where the tyre does not slip: ``B C D``."""
    return th.B_f * th.C_f * th.D_f, th.B_r * th.C_r * th.D_r


def settling_rate(th: Coefficients, car: VehicleConstants) -> Array:
    """How fast sideslip and yaw of the linear car settle, times the speed (m/s^2).

    Their rates are about ``sum C / (m v_x)`` and ``sum C l^2 / (I_z v_x)``, ``C`` the cornering stiffness of an axle; this
    is the larger one times ``v_x``.
    """
    C_f, C_r = cornering_stiffness(th)
    return max((C_f + C_r) / car.m, (C_f * car.l_f**2 + C_r * car.l_r**2) / th.I_z)


def at_least(value: Array, floor: Array) -> Array:
    """The larger of the two, in any array namespace."""
    return (value + floor + abs(value - floor)) / 2


Stage = Callable[[Any, Motion], None]  # takes the array namespace and the motion, which it changes

STAGES: tuple[Stage, ...] = (inputs, slip, drive, loads, tyres, forces, accelerations)
"""The nominal equations, in the order in which they run."""


def staged(effects: Sequence[StageEffect]) -> tuple[Stage, ...]:
    """The equations, each followed by what ``effects`` change of it, in their order. Neutral effects are left out."""
    acting = [effect for effect in effects if not effect.is_neutral]
    return tuple(
        act
        for stage in STAGES
        for act in (
            stage,
            *(getattr(effect, stage.__name__) for effect in acting if _overrides(effect, stage.__name__)),
        )
    )


def _overrides(effect: StageEffect, hook: str) -> bool:
    return getattr(type(effect), hook) is not getattr(StageEffect, hook)
