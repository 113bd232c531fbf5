"""What cannot be right is found with its size, one finding a fault; what is right has none."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from dynssm_ros.api import extract
from dynssm_ros.api.inputs import opened
from dynssm_ros.arrays import Vector
from dynssm_ros.errors import DataWarning, RecordingError
from dynssm_ros.signals.consistency import checked, contradictions
from dynssm_ros.signals.findings import Finding
from dynssm_ros.signals.recording import Recording, RecordingInfo, concatenate
from dynssm_ros.signals.standard import recording_to_bag

T_S, WHEELBASE, UNDERSTEER, REAR_SLIP = 0.05, 2.6, 0.004, 0.01
DEGREE = 180.0 / np.pi
Changed = Callable[[Recording], Recording]


def driven(
    seconds: float = 60.0, noise: float = 0.01, speed: float = 15.0, seed: int = 0, at_random: bool = False
) -> Recording:
    """A car that understeers, ``delta = L k + K v^2 k``, on bends of four periods or ``at_random``; it also brakes."""
    t = np.arange(round(seconds / T_S)) * T_S
    rng = np.random.default_rng(seed)
    periods, phases = np.array([4.1, 6.7, 11.3, 19.0]), rng.uniform(0, 2 * np.pi, 4)
    waves = np.sin(2 * np.pi * t[:, None] / periods + phases)
    if at_random:
        wide = np.stack([np.convolve(one, np.hanning(50), "same") for one in rng.standard_normal((4, len(t)))], axis=1)
        waves = wide / wide.std(axis=0) / np.sqrt(2.0)
    acceleration = 0.3 * speed * (waves[:, 1] + waves[:, 2]) / 2
    v_x = speed + np.cumsum(acceleration) * T_S
    if at_random:
        v_x = speed * (1.0 + 0.1 * waves[:, 1])
        acceleration = np.gradient(v_x, T_S)
    curvature = 3.0 / speed**2 * (waves[:, 0] + waves[:, 3]) / 2
    omega, v_y = v_x * curvature, (1.2 - REAR_SLIP * v_x**2) * v_x * curvature
    theta = np.cumsum(omega) * T_S
    path = np.cumsum((v_x + 1j * v_y) * np.exp(1j * theta)) * T_S
    r = np.roll((acceleration + 0.01 * speed) / (0.3 * speed), -2)
    delta = np.roll(WHEELBASE * curvature + UNDERSTEER * v_x**2 * curvature, -2)
    measured = np.stack([v_x, v_y, omega]) + noise * rng.standard_normal((3, len(t))) * np.array([[5.0], [1.0], [1.0]])
    columns = dict(zip(("v_x", "v_y", "omega"), measured, strict=True))
    columns |= {"r_fb": r, "delta_fb": delta, "r_cmd": 0 * r, "delta_cmd": 0 * r}
    columns |= {"x": path.real, "y": path.imag, "theta": theta}
    time = np.round(1.7e18 + t * 1e9).astype(np.int64)
    info = RecordingInfo(sampling_time=T_S, commands="none", source=("drive",))
    return Recording(info, time, np.zeros(len(t), np.int32), columns)


def times(**factors: float) -> Changed:
    """Multiplies columns."""
    return lambda drive: with_columns(drive, **{name: factor * drive[name] for name, factor in factors.items()})


def early(seconds: float, *names: str) -> Changed:
    """Columns that come some seconds early; of a drive that is twice as long where these are many."""

    def change(drive: Recording) -> Recording:
        drive, least = (drive, 120) if abs(seconds) < 6.0 else (driven(80.0 + 4 * abs(seconds), at_random=True), 800)
        moved = drive.select(slice(0, len(drive) - 2 * least))
        rows = least + round(seconds / T_S)
        columns = {
            name: values[rows:][: len(moved)] if name in names else values[least:][: len(moved)]
            for name, values in drive.columns.items()
        }
        return replace(moved, columns=columns)

    return change


def with_columns(drive: Recording, **columns: Vector) -> Recording:
    """With other columns."""
    return replace(drive, columns=drive.columns | columns)


def reversing(drive: Recording, share: float = 1.0) -> Recording:
    """A drive whose first ``share`` is driven backwards, along the same bends; it stops before it goes forwards."""
    at = np.arange(len(drive))
    back, stops = at < share * len(drive), np.clip(np.abs(at - share * len(drive)) * T_S, 0.01, 1.0)
    turned = {name: np.where(back, -drive[name], drive[name]) for name in ("v_x", "r_fb", "delta_fb")}
    sideways = np.where(back, -drive["v_y"] + 2.4 * drive["omega"], drive["v_y"])
    velocity = stops * (turned["v_x"] + 1j * sideways)
    omega = stops * drive["omega"]
    theta = np.cumsum(omega) * T_S
    path = np.cumsum(velocity * np.exp(1j * theta)) * T_S
    turned |= {"v_x": velocity.real, "v_y": velocity.imag, "omega": omega, "theta": theta}
    return with_columns(drive, **turned, x=path.real, y=path.imag)


def unsigned(drive: Recording) -> Recording:
    """A speed without its sign."""
    return with_columns(drive, v_x=np.abs(drive["v_x"]))


def constant(name: str, value: float = 0.0) -> Changed:
    """A column that does not live."""
    return lambda drive: with_columns(drive, **{name: np.full(len(drive), value)})


def in_the_map(drive: Recording) -> Recording:
    """The velocity in the map's frame."""
    velocity = (drive["v_x"] + 1j * drive["v_y"]) * np.exp(1j * drive["theta"])
    return with_columns(drive, v_x=velocity.real, v_y=velocity.imag)


def resting(rest: float) -> Changed:
    """A brake sensor that is never 0, so that the throttle is never used."""
    return lambda drive: with_columns(drive, r_fb=-(rest + (1 - rest) * np.maximum(-drive["r_fb"], 0)))


def without_pose(drive: Recording) -> Recording:
    """Without x, y and theta."""
    return replace(drive, columns={name: drive[name] for name in drive.columns if name not in ("x", "y", "theta")})


def turned(angle: float) -> Changed:
    """A heading that is off."""
    return lambda drive: with_columns(drive, theta=drive["theta"] + angle)


def side_on(angle: float) -> Changed:
    """A sensor of velocity that is mounted turned."""

    def change(drive: Recording) -> Recording:
        velocity = (drive["v_x"] + 1j * drive["v_y"]) * np.exp(1j * angle)
        return with_columns(drive, v_x=velocity.real, v_y=velocity.imag)

    return change


def ahead_of_rear_axle(distance: float) -> Changed:
    """A lateral velocity that is measured elsewhere than at the centre of gravity, 1.2 m ahead of the rear axle."""
    return lambda drive: with_columns(drive, v_y=drive["v_y"] + (distance - 1.2) * drive["omega"])


def never_released(rest: float, noise: float = 0.0) -> Changed:
    """A throttle whose sensor shows some ``rest`` at least; the car rolls out there."""

    def change(drive: Recording) -> Recording:
        seen = rest + (1 - rest) * np.maximum(drive["r_fb"], 0)
        return with_columns(drive, r_fb=seen + noise * np.random.default_rng(0).standard_normal(len(drive)))

    return change


def standing_at(rest: float) -> Changed:
    """A car that stands for 5 s with its throttle at ``rest``, and drives with more ever after."""

    def change(drive: Recording) -> Recording:
        still = np.arange(len(drive)) < 100
        parked = {name: np.where(still, 0.0, drive[name]) for name in ("v_x", "v_y", "omega")}
        parked |= {name: np.where(still, drive[name][100], drive[name]) for name in ("x", "y", "theta")}
        return with_columns(
            drive, **parked, r_fb=np.where(still, rest, np.maximum(0.4 + 0.3 * drive["r_fb"], rest + 0.1))
        )

    return change


def frozen(drive: Recording) -> Recording:
    """An odometry that says the same for a quarter of the drive."""
    at = np.where(np.arange(len(drive)) >= 0.75 * len(drive), round(0.75 * len(drive)), np.arange(len(drive)))
    return with_columns(drive, **{name: drive[name][at] for name in ("x", "y", "theta", "v_x", "v_y", "omega")})


def in_degrees(drive: Recording) -> Recording:
    """Heading and yaw rate in degrees, the heading within a turn."""
    theta = (drive["theta"] + np.pi) % (2 * np.pi) - np.pi
    return with_columns(drive, theta=DEGREE * theta, omega=DEGREE * drive["omega"])


def compass(drive: Recording) -> Recording:
    """A heading that counts clockwise from north."""
    return with_columns(drive, theta=np.pi / 2 - drive["theta"])


def percent_like_speed(drive: Recording) -> Recording:
    """A throttle in percent that rises with the speed, and brakes."""
    return with_columns(drive, r_fb=np.where(drive["r_fb"] < -0.3, -5.0, np.roll(drive["v_x"], -4) + 2.0))


def set_point(drive: Recording) -> Recording:
    """A speed set-point where the throttle is expected."""
    return with_columns(drive, r_fb=np.roll(drive["v_x"], -4) + 0.4)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("speed", [3.0, 15.0, 30.0])
def test_a_healthy_drive_has_no_finding(seed: int, speed: float) -> None:
    assert contradictions(driven(speed=speed, seed=seed), WHEELBASE) == ()


@pytest.mark.parametrize("share", [0.3, 0.6, 1.0])
@pytest.mark.parametrize("change", [lambda drive: drive, without_pose])
def test_a_drive_that_reverses_has_no_finding(share: float, change: Changed) -> None:
    assert contradictions(change(reversing(driven(), share)), WHEELBASE) == ()


@pytest.mark.parametrize("change", [lambda drive: drive, without_pose])
def test_a_speed_that_lost_its_sign_in_reverse_is_named(change: Changed) -> None:
    found = contradictions(change(unsigned(reversing(driven(at_random=True), 0.4))), WHEELBASE)
    assert [(each.what, round(each.size, 1)) for each in found] == [("v_x_unsigned", pytest.approx(0.4, abs=0.11))]
    (found,) = contradictions(unsigned(reversing(driven())), WHEELBASE)
    assert (found.what, found.remedy[:14]) == ("v_x_sign", "v_x: scale: -1")


def test_inputs_of_laps_that_were_swapped_are_those_of_other_bends() -> None:
    """Not of a car that reverses, which would have stopped."""
    drive = driven(at_random=True)
    order = np.r_[0:200, 700:1200, 200:700, 1200 : len(drive)]
    found = contradictions(
        with_columns(drive, **{name: drive[name][order] for name in ("delta_fb", "r_fb")}), WHEELBASE
    )
    assert {each.what for each in found} <= {"steering_unrelated", "steering_time", "inputs_time"}
    assert found


@pytest.mark.parametrize(
    "change",
    [lambda drive: drive, without_pose, times(delta_fb=1.4), early(0.2, "x", "y", "theta"), early(-0.2, "delta_fb")],
)
def test_what_healthy_logs_show_has_no_finding(change: Changed) -> None:
    assert contradictions(change(driven()), WHEELBASE) == ()


@pytest.mark.parametrize(
    ("what", "size", "change"),
    [
        ("pose_speed", 0.5, times(x=0.5, y=0.5)),
        ("pose_speed", 1 / 3.6, times(v_x=3.6, v_y=3.6)),
        ("pose_speed", 0.8, times(v_x=1.25, v_y=1.25)),
        ("pose_speed", 1000.0, times(x=1e3, y=1e3)),
        ("omega_scale", 1 / DEGREE, times(omega=DEGREE)),
        ("omega_scale", 0.5, times(omega=2.0)),
        ("omega_scale", 1.25, times(omega=0.8)),
        ("theta_scale", DEGREE, times(theta=DEGREE)),
        ("theta_scale", 0.7, times(theta=0.7)),
        ("theta_scale", 2.0, times(theta=2.0)),
        ("omega_sign", -1.0, times(omega=-1)),
        ("theta_sign", -1.0, times(theta=-1)),
        ("path_mirrored", -1.0, times(y=-1)),
        ("pose_mirrored", -1.0, times(y=-1, theta=-1)),
        ("v_y_sign", -1.0, times(v_y=-1)),
        ("v_x_sign", np.pi, times(v_x=-1)),
        ("theta_offset", 0.5, turned(-0.5)),
        ("theta_offset", np.pi / 2, turned(-np.pi / 2)),
        ("theta_offset", -1.2, turned(1.2)),
        ("steering_scale", 1 / DEGREE, times(delta_fb=DEGREE)),
        ("steering_scale", 1 / 14.5, times(delta_fb=14.5)),
        ("steering_scale", 4.0, times(delta_fb=0.25)),
        ("steering_time", 3.0, early(3.0, "delta_fb")),
        ("steering_time", -1.5, early(-1.5, "delta_fb")),
        ("steering_time", 1.0, early(1.0, "delta_fb")),
        ("throttle_time", 2.0, early(2.0, "r_fb")),
        ("throttle_time", -4.0, early(-4.0, "r_fb")),
        ("throttle_time", 5.0, early(5.0, "r_fb")),
        ("inputs_time", 3.0, early(3.0, "r_fb", "delta_fb")),
        ("pose_time", -2.0, early(2.0, "x", "y", "theta")),
        ("pose_time", 1.0, early(-1.0, "x", "y", "theta")),
        ("twist_time", 2.0, early(2.0, "v_x", "v_y", "omega")),
        ("twist_turned", np.pi / 2, side_on(-np.pi / 2)),
        ("twist_turned", -0.8, side_on(0.8)),
        ("odometry_frozen", 0.25, frozen),
        (
            "steering_frozen",
            24.0,
            lambda drive: with_columns(drive, delta_fb=drive["delta_fb"][np.minimum(np.arange(1200), 720)]),
        ),
        ("steering_offset", 0.1, lambda drive: with_columns(drive, delta_fb=drive["delta_fb"] + 0.1)),
        ("throttle_rest", 0.12, never_released(0.12)),
        ("throttle_rest", 0.05, never_released(0.05, noise=0.001)),
        ("throttle_rest", 0.25, never_released(0.25, noise=0.004)),
        ("throttle_rest", 0.12, standing_at(0.12)),
        ("v_y_lever", 0.05, ahead_of_rear_axle(0.05)),
        ("v_y_lever", 2.8, ahead_of_rear_axle(2.8)),
        ("v_y_lever", -0.5, lambda drive: without_pose(ahead_of_rear_axle(-0.5)(drive))),
        ("v_y_sign", -1.2, lambda drive: without_pose(times(v_y=-1)(drive))),
        ("steering_time", 18.0, early(18.0, "delta_fb")),
        ("inputs_time", -18.0, early(-18.0, "delta_fb", "r_fb")),
        ("inputs_time", 37.0, early(37.0, "delta_fb", "r_fb")),
        ("pose_speed", 1e-5, lambda drive: with_columns(drive, x=48.0 + 1e-5 * drive["y"], y=1e-5 * drive["x"])),
        ("twist_in_map_frame", 1.0, lambda drive: without_pose(in_the_map(drive))),
        ("twist_turned", np.pi / 2, lambda drive: without_pose(side_on(-np.pi / 2)(drive))),
        ("twist_turned", -0.8, lambda drive: without_pose(side_on(0.8)(drive))),
        ("throttle_never_used", 0.0075, resting(0.0075)),
        ("throttle_never_used", 0.02, resting(0.02)),
        ("throttle_never_used", 0.05, resting(0.05)),
    ],
)
def test_a_fault_is_found_with_its_size(what: str, size: float, change: Changed) -> None:
    (found,) = contradictions(change(driven()), WHEELBASE)
    assert found.what == what
    margin = 0.15 if what.endswith("_time") else 0.06 * WHEELBASE if found.unit == "m" else 0.1 * abs(size)
    assert min(abs(found.size - size), abs(abs(found.size) - abs(size)) if abs(size) == np.pi else np.inf) < margin
    assert found.low <= found.size <= found.high


@pytest.mark.parametrize(
    ("what", "change"),
    [
        ("twist_in_map_frame", in_the_map),
        ("steering_sign", times(delta_fb=-1)),
        ("steering_sign", times(y=-1, theta=-1, v_y=-1, omega=-1)),
        ("steering_sign", lambda drive: without_pose(times(omega=-1)(drive))),
        ("throttle_sign", times(r_fb=-1)),
        ("throttle_range", times(r_fb=100)),
        ("throttle_scale", times(r_fb=0.01)),
        ("throttle_setpoint", set_point),
        ("throttle_range", percent_like_speed),
        ("omega_constant", constant("omega")),
        ("v_y_unrelated", lambda drive: with_columns(drive, v_y=0.05 * np.sin(1e3 * np.arange(len(drive)) ** 2))),
        ("omega_unrelated", lambda drive: with_columns(drive, omega=0.1 * np.sin(np.arange(len(drive))))),
        ("theta_constant", constant("theta")),
        ("v_y_constant", constant("v_y")),
        ("steering_constant", constant("delta_fb", 0.1)),
        ("throttle_constant", constant("r_fb")),
        ("v_x_sign", lambda drive: without_pose(times(v_x=-1)(drive))),
        ("omega_range", lambda drive: without_pose(times(omega=DEGREE)(drive))),
        ("v_x_range", lambda drive: without_pose(times(v_x=1e3, v_y=1e3)(drive))),
        ("steering_unrelated", lambda drive: with_columns(drive, delta_fb=driven(seed=7, at_random=True)["delta_fb"])),
    ],
)
def test_a_fault_without_a_size_is_named(what: str, change: Changed) -> None:
    found = contradictions(change(driven()), WHEELBASE)
    assert [each.what for each in found] == [what]


def test_a_compass_heading_is_a_sign_and_an_offset() -> None:
    found = {each.what: each.size for each in contradictions(compass(driven()))}
    assert list(found) == ["theta_sign", "theta_offset"]
    assert found["theta_offset"] == pytest.approx(np.pi / 2, abs=0.02)


def test_a_heading_and_a_yaw_rate_in_degrees_are_both_told() -> None:
    found = {each.what: each.size for each in contradictions(in_degrees(driven()), WHEELBASE)}
    assert found == {"omega_scale": pytest.approx(1 / DEGREE, rel=0.05), "theta_scale": pytest.approx(DEGREE, rel=0.05)}


def test_clocks_that_are_known_to_be_apart_are_no_lag_as_well() -> None:
    drive = early(3.0, "r_fb", "delta_fb")(driven())
    apart = Finding(
        what="inputs_clock", told="", size=3.0, low=2.8, high=3.2, unit="s", expected="0", remedy="synchronise"
    )  # fmt: skip
    known = replace(drive, info=drive.info.model_copy(update={"findings": (apart,)}))
    assert checked(checked(known, WHEELBASE), WHEELBASE).info.findings == (apart,)


def test_without_positions_a_speed_in_km_h_is_told_beside_the_scale_of_the_steering() -> None:
    (found,) = contradictions(without_pose(times(v_x=3.6, v_y=3.6)(driven())), WHEELBASE)
    assert (found.what, found.remedy.partition("; ")[2]) == ("steering_scale", "or v_x, v_y: unit: km/h")


def test_half_the_path_speed_and_a_heading_that_turns_against_omega_are_two_findings() -> None:
    found = {each.what: each.size for each in contradictions(times(x=0.5, y=0.5, theta=-1)(driven()), WHEELBASE)}
    assert set(found) <= {"pose_speed", "omega_sign", "theta_sign"}
    assert found["pose_speed"] == pytest.approx(0.5, abs=0.005)


def test_the_scale_of_steering_is_right_where_the_car_understeers_much() -> None:
    """At 30 m/s the car needs two and a half times the steering of one that does not understeer."""
    t = np.arange(1200) * T_S
    v_x, curvature = 30 + 8 * np.sin(2 * np.pi * t / 40), 0.006 * np.sin(2 * np.pi * t / 12)
    delta = 2.4 * curvature + 0.004 * v_x**2 * curvature
    bends = without_pose(
        with_columns(
            driven(60.0), v_x=v_x, v_y=(1.2 - 0.002 * v_x**2) * v_x * curvature, omega=v_x * curvature, delta_fb=delta
        )
    )
    bends = with_columns(bends, r_fb=0.3 + 0.2 * np.cos(2 * np.pi * t / 40))
    assert contradictions(bends, 2.4) == ()
    (found,) = contradictions(times(delta_fb=DEGREE)(bends), 2.4)
    assert found.size == pytest.approx(1 / DEGREE, rel=0.1)


def test_signals_clip_and_come_in_steps() -> None:
    drive = driven()
    limit = float(np.percentile(drive["omega"], 85))
    assert "omega_clipped" in [
        each.what for each in contradictions(with_columns(drive, omega=np.minimum(drive["omega"], limit)))
    ]
    coarse = with_columns(drive, v_x=np.round(drive["v_x"] / 2) * 2)
    assert [each.size for each in contradictions(coarse) if each.what == "v_x_coarse"] == [2.0]


@pytest.mark.parametrize(("name", "size", "rows"), [("omega", 0.4, 1), ("v_y", -1.0, 2), ("v_x", 6.0, 1)])
def test_spikes_are_told_with_their_rate_and_size(name: str, size: float, rows: int) -> None:
    drive = driven()
    values = drive[name].copy()
    for at in (100, 333, 500, 777, 1000, 1111):
        values[at : at + rows] += size
    found = contradictions(with_columns(drive, **{name: values}))
    assert [each.what for each in found] == [f"{name}_spikes"]
    assert found[0].size == pytest.approx(6.0)
    assert found[0].low < 6.0 < found[0].high
    once = drive[name].copy()
    once[600:] += size / 100.0  # a step that stays is none, nor is a single spike
    once[300] += size
    assert contradictions(with_columns(drive, **{name: once})) == ()


def test_the_sign_of_a_small_lateral_velocity_that_follows_the_yaw_rate_is_not_judged() -> None:
    drive = driven(noise=0.0)
    found = contradictions(with_columns(drive, v_y=0.002 * drive["omega"] * drive["v_x"]), WHEELBASE)
    assert [each.what for each in found] == ["v_y_lever"]


def test_short_recordings_and_standing_cars_have_no_finding() -> None:
    drive = driven()
    assert contradictions(drive.select(slice(0, 100))) == ()
    standing = times(v_x=0, v_y=0, omega=0)(drive)
    assert contradictions(without_pose(standing)) == ()
    still = {name: np.full(len(drive), 3.0) for name in ("x", "y", "theta")}
    for noise in (0.0, 0.02):
        seen = noise * np.random.default_rng(0).standard_normal((3, len(drive)))
        columns = still | dict(zip(("v_x", "v_y", "omega"), seen, strict=True)) | {"r_fb": np.zeros(len(drive))}
        assert contradictions(with_columns(drive, **columns), WHEELBASE) == ()


def test_a_car_that_never_drives_is_told_and_an_error_if_asked() -> None:
    still = times(v_x=0, v_y=0, omega=0)(driven())
    with pytest.warns(DataWarning, match="drive: the car stands throughout: .*expected a drive"):
        opened([still], None)
    with pytest.raises(RecordingError, match="the car stands throughout"):
        opened([still], None, strict=True)
    assert len(opened([still.select(slice(0, 10))], None)) == 1  # nothing is said of half a second


def test_findings_are_kept_shown_and_errors_if_asked() -> None:
    wrong = checked(times(delta_fb=-1)(driven()))
    assert [each.what for each in concatenate([wrong, wrong]).info.findings] == ["steering_sign"]
    with pytest.warns(DataWarning, match=r"drive: steering_sign: delta_fb falls .*expected above 0.*scale: -1"):
        opened([wrong], None)
    with pytest.raises(RecordingError, match="steering_sign"):
        opened([wrong], None, strict=True)


def test_a_bag_is_checked_when_it_is_extracted(tmp_path) -> None:  # type: ignore[no-untyped-def]
    recording_to_bag(early(3.0, "delta_fb")(driven()), tmp_path / "bag")
    with pytest.warns(DataWarning, match="steering_time"):
        found = extract(tmp_path / "bag", "default", rate=1 / T_S, commands="none")
    found.save(tmp_path / "r.parquet")
    assert [each.what for each in Recording.load(tmp_path / "r.parquet").info.findings] == ["steering_time"]
    with pytest.raises(RecordingError, match=r"steering_time.*3\.0"):
        extract(tmp_path / "bag", "default", rate=1 / T_S, commands="none", strict=True)
