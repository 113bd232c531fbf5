"""Estimated velocities: right where they are planted, as wrong as they say, the same live as forwards over a log."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from dynssm_ros.configuration import validate
from dynssm_ros.errors import ConfigurationError, RecordingError
from dynssm_ros.signals import messages
from dynssm_ros.signals.decoding import live_decoders
from dynssm_ros.signals.estimation import LiveEstimation, Plane, estimated, noise_notes, require_degrees
from dynssm_ros.signals.extraction import extract, read_streams
from dynssm_ros.signals.logs import open_log
from dynssm_ros.signals.motion_filter import THETA, V_X, V_Y, Estimation, MotionFilter
from dynssm_ros.signals.recording import Recording
from dynssm_ros.signals.resampling import Stream
from dynssm_ros.signals.signal_map import SignalMap, load_signal_map
from dynssm_ros.simulation.plant import SingleTrackPlant
from dynssm_ros.vehicle import Applied, State, load_vehicle
from dynssm_ros.vehicle.kinematics import Pose

START = 1_700_000_000_000_000_000
GAP = 250_000_000
ORIGIN = (48.2, 11.6)
SETTINGS = Estimation(rear_axle=1.7, origin=ORIGIN)


class Drive(NamedTuple):
    """A simulated drive and what its sensors said of it."""

    stamps: np.ndarray
    state: np.ndarray  # (N, 3)
    pose: np.ndarray  # (N, 3)
    streams: dict[str, tuple[np.ndarray, np.ndarray]]


@pytest.fixture(scope="module")
def drive() -> Drive:
    """32 s of the AV-21 with an IMU that has noise and biases, wheel speeds every other row, and fixes at 5 Hz."""
    random, vehicle, dt = np.random.default_rng(7), load_vehicle("av21"), 0.04
    car = SingleTrackPlant(vehicle, "rk4", Pose(0.0, 0.0, 0.4), State(20.0, 0.0, 0.0))
    kernel = np.hanning(60)
    steering = np.convolve(random.normal(size=800 + 59), kernel / np.sqrt((kernel**2).sum()), "valid") * 0.03
    poses, states = [], []
    for k in range(800):
        poses.append(car.pose)
        states.append(car.state)
        goal = 22.0 + 6.0 * math.sin(k * dt / 4)
        car.advance(Applied(0.15 * (goal - car.state.v_x), float(steering[k])))
    state, pose = np.array(states), np.array(poses)
    stamps, normal = START + np.arange(800) * round(dt * 1e9), lambda scale: scale * random.normal(size=800)
    v_x, v_y, omega = state.T
    white = 0.1 / math.sqrt(dt)
    a_x = np.gradient(v_x, dt) - v_y * omega + 0.25 + normal(white)
    a_y = np.gradient(v_y, dt) + v_x * omega - 0.35 + normal(white)
    plane = Plane(ORIGIN)
    degree = plane.at(ORIGIN[0] + 1, ORIGIN[1] + 1)
    fixes = pose[::5, :2] + random.normal(size=(len(pose[::5]), 2))
    streams = {
        "omega": (stamps, omega + 0.015 + normal(0.005 / math.sqrt(dt))),
        "a_x": (stamps, a_x),
        "a_y": (stamps, a_y),
        "v_x": (stamps[::2] + 3_000_000, (v_x * (1 + normal(0.02)))[::2]),
        "latitude": (stamps[::5], ORIGIN[0] + fixes[:, 1] / degree[1]),
        "longitude": (stamps[::5], ORIGIN[1] + fixes[:, 0] / degree[0]),
    }
    return Drive(stamps, state, pose, streams)


def without(drive: Drive, *names: str) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    return {name: one for name, one in drive.streams.items() if name not in names}


def rms(values: np.ndarray) -> np.ndarray:
    return np.sqrt((values**2).mean(axis=0))


def live_map(*names: str, **estimation: Any) -> SignalMap:
    """Sensors in messages of their own kind; the wheel speed has no stamp."""
    imu = {"topic": "/imu", "type": "sensor_msgs/msg/Imu"}
    fix = {"topic": "/fix", "type": "sensor_msgs/msg/NavSatFix"}
    sources = {
        "v_x": {"topic": "/wheel_speed", "type": "std_msgs/msg/Float64", "field": "data"},
        "omega": imu | {"field": "angular_velocity.z"},
        "a_x": imu | {"field": "linear_acceleration.x"},
        "a_y": imu | {"field": "linear_acceleration.y"},
        "latitude": fix | {"field": "latitude"},
        "longitude": fix | {"field": "longitude"},
    }
    actuators = {
        f"{name}_feedback": {"topic": "/inputs", "type": "sensor_msgs/msg/JointState", "field": f"position[{name}]"}
        for name in ("throttle", "steering")
    }
    signals = {name: source for name, source in sources.items() if name in names} | actuators
    content = {"name": "own", "signals": signals} | ({"estimation": estimation} if estimation else {})
    return validate(SignalMap, content, "signal map")


ALL = ("v_x", "omega", "a_x", "a_y", "latitude", "longitude")


@pytest.mark.parametrize("lacks", [(), ("latitude", "longitude"), ("latitude", "longitude", "a_x")])
def test_v_y_is_recovered_with_an_error_as_large_as_stated(drive: Drive, lacks: tuple[str, ...]) -> None:
    errors, normalised = [], []
    for both_sides in (False, True):
        found = estimated(without(drive, *lacks), SETTINGS, GAP, both_sides=both_sides)
        truth = drive.state[np.searchsorted(drive.stamps, found.stamps)]
        errors.append(rms((found.states - truth)[50:]))
        normalised.append(rms(((found.states - truth) / found.deviations)[50:]))
    assert (np.array(normalised) > 0.3).all()
    assert (np.array(normalised) < 1.2).all()
    assert (errors[1] < 1.05 * errors[0]).all()  # two-sided no worse than causal; the gyro's white noise is in both
    v_y, omega = drive.state[50:, 1:].T
    assert errors[0][1] < 0.9 * min(rms(v_y), rms(v_y - 1.7 * omega))
    assert errors[1][1] < 0.7 * min(rms(v_y), rms(v_y - 1.7 * omega))


def test_without_accelerometers_v_y_is_that_of_a_steady_turn(drive: Drive) -> None:
    found = estimated(without(drive, "a_x", "a_y", "latitude", "longitude"), SETTINGS, GAP)
    error = (found.states - drive.state[np.searchsorted(drive.stamps, found.stamps)])[50:]
    assert rms(error[:, 1] / found.deviations[50:, 1]) < 1.0
    assert rms(error)[1] < 0.7 * rms(drive.state[50:, 1] - 1.7 * drive.state[50:, 2])


def test_fixes_give_position_and_heading_though_nothing_measures_the_heading(drive: Drive) -> None:
    found = estimated(drive.streams, SETTINGS, GAP)
    known = np.isfinite(found.poses[:, 2])
    assert known[-1]
    assert 0.85 < known.mean() < 1.0  # after the first metres
    error = found.poses[known] - drive.pose[np.searchsorted(drive.stamps, found.stamps[known])]
    assert (rms(error) < [0.4, 0.4, 0.02]).all()
    assert found.origin == ORIGIN
    first = estimated(drive.streams, Estimation(), GAP).origin
    assert first == (drive.streams["latitude"][1][0], drive.streams["longitude"][1][0])


def test_positions_and_velocities_of_an_antenna_that_is_elsewhere(drive: Drive) -> None:
    ahead, left = 3.0, -1.0
    x, y, theta = drive.pose.T
    v_x, v_y, omega = drive.state.T
    c, s = np.cos(theta), np.sin(theta)
    u, v = v_x - omega * left, v_y + omega * ahead
    seen = {
        "x": x + c * ahead - s * left,
        "y": y + s * ahead + c * left,
        "v_east": c * u - s * v,
        "v_north": s * u + c * v,
    }
    streams = without(drive, "latitude", "longitude") | {
        name: (drive.stamps[::5], one[::5]) for name, one in seen.items()
    }
    errors = []
    for at in ((ahead, left), (0.0, 0.0)):
        found = estimated(streams, SETTINGS.model_copy(update={"position_at": at}), GAP)
        known = np.isfinite(found.poses[:, 2])
        error = found.poses[known] - drive.pose[np.searchsorted(drive.stamps, found.stamps[known])]
        errors.append(
            [*rms(error), rms(found.states[:, 1] - drive.state[np.searchsorted(drive.stamps, found.stamps), 1])]
        )
    right, wrong = np.array(errors)
    assert (right < [0.1, 0.1, 0.01, 0.15]).all()
    assert (right[[0, 1, 3]] < 0.5 * wrong[[0, 1, 3]]).all()


def test_a_long_log_is_smoothed_in_blocks(drive: Drive, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = estimated(drive.streams, SETTINGS, GAP)
    monkeypatch.setattr("dynssm_ros.signals.estimation._BLOCK", 300)
    apart = []
    for ahead in (50, 500):  # 1.2 and 12 s; what is learned of the car later does not reach a block
        monkeypatch.setattr("dynssm_ros.signals.estimation._AHEAD", ahead)
        blocks = estimated(drive.streams, SETTINGS, GAP)
        np.testing.assert_array_equal(blocks.stamps, whole.stamps)
        apart.append(rms(blocks.states - whole.states) / rms(whole.deviations))
    assert (apart[1] < 0.1).all()
    assert (apart[1] < 0.3 * apart[0]).all()
    causal = estimated(drive.streams, SETTINGS, GAP, both_sides=False)
    np.testing.assert_array_equal(causal.stamps, whole.stamps)


def test_live_it_is_what_it_is_forwards_over_a_log(drive: Drive) -> None:
    batch = estimated(drive.streams, SETTINGS, GAP, both_sides=False)
    live = LiveEstimation(live_map(*ALL, **SETTINGS.model_dump()))
    found = []
    samples = sorted(
        (int(t), name, float(v))
        for name, (at, values) in drive.streams.items()
        for t, v in zip(at, values, strict=True)
    )
    together: dict[int, dict[str, float]] = {}
    for stamp, name, value in samples:
        together.setdefault(stamp, {})[name] = value
    for stamp, values in together.items():
        live.add(stamp, values)
        if "omega" in values and (now := live.at(stamp)):
            found.append([now[name] for name in ("v_x", "v_y", "omega")])
    np.testing.assert_allclose(found, batch.states, rtol=0, atol=1e-12)


def test_samples_that_come_late_count_when_they_were_measured(drive: Drive) -> None:
    content, end = live_map(*ALL, **SETTINGS.model_dump()), int(drive.stamps[300])
    random, order = np.random.default_rng(3), []
    for name, (stamps, values) in drive.streams.items():
        late = 0 if name == "omega" else 200_000_000
        pair = round(random.uniform(0, late))  # latitude and longitude come together
        for stamp, value in zip(stamps.tolist(), values.tolist(), strict=True):
            if stamp <= end:
                arrives = stamp + (200_000_000 if name in ("latitude", "longitude") else pair)
                order.append((arrives, name, stamp, value))
    one, other = LiveEstimation(content), LiveEstimation(content)
    fixes: dict[int, dict[str, float]] = {}
    for _, name, stamp, value in sorted(order):
        if name in ("latitude", "longitude"):
            fixes.setdefault(stamp, {})[name] = value
            if len(fixes[stamp]) < 2:
                continue
        one.add(stamp, fixes.get(stamp, {}) if name in ("latitude", "longitude") else {name: value})
        one.at(stamp)
    together: dict[int, dict[str, float]] = {}
    for _, name, stamp, value in order:
        together.setdefault(stamp, {})[name] = value
    for stamp in sorted(together):
        other.add(stamp, together[stamp])
    assert one.at(end) == pytest.approx(other.at(end), abs=1e-9)


def test_a_step_integrates_the_equations_of_motion_and_has_their_derivatives() -> None:
    a_x, a_y, omega, seconds = 2.0, -1.0, 0.8, 0.1

    def rates(x: np.ndarray) -> np.ndarray:
        return np.array([a_x + x[V_Y] * omega, a_y - x[V_X] * omega])

    motion = MotionFilter(Estimation(), ("v_x", "omega", "a_x", "a_y"))
    inputs = {"a_x": a_x, "a_y": a_y, "omega": omega}
    first = motion.begin(START, {"v_x": 10.0, **inputs})
    first = first._replace(P=np.zeros((9, 9)), has_pose=True)
    count, at = 1000, first.x.astype(float)
    for _ in range(count):  # midpoint rule
        dt, half = seconds / count, at[:2] + seconds / count / 2 * rates(at)
        at[:2] += dt * rates(half)
    moved, F = motion._moved(first, {}, seconds)
    np.testing.assert_allclose(moved[:2], at[:2], rtol=0, atol=2e-4)  # a dt (omega dt)^2 / 12
    assert moved[THETA] == pytest.approx(omega * seconds)
    for k in range(9):  # its derivative
        step = np.zeros(9)
        step[k] = 1e-6
        ahead, behind = (motion._moved(first._replace(x=first.x + s * step), {}, seconds)[0] for s in (1, -1))
        np.testing.assert_allclose((ahead - behind) / 2e-6, F[:, k], atol=1e-6)


def test_at_rest_the_gyro_shows_its_bias() -> None:
    stamps = START + np.arange(500) * 10_000_000
    zero = np.zeros(500)
    streams = {
        "v_x": (stamps, zero),
        "omega": (stamps, zero + 0.03),
        "a_x": (stamps, zero),
        "a_y": (stamps, zero + 0.2),
    }
    found = estimated(streams, Estimation(), GAP)
    assert np.abs(found.states[100:]).max() < 0.003


def test_a_gap_begins_anew_and_a_log_without_speed_is_refused(drive: Drive) -> None:
    lost = drive.stamps[400:500]
    kept = {name: (name == "v_x") | ~np.isin(at, lost) for name, (at, _) in drive.streams.items()}
    streams = {name: (at[kept[name]], values[kept[name]]) for name, (at, values) in drive.streams.items()}
    found = estimated(streams, SETTINGS, GAP, both_sides=False)
    cut = int(np.flatnonzero(np.diff(found.stamps) > GAP)[0]) + 1
    assert found.deviations[cut, 1] > 1.2 * found.deviations[cut - 1, 1]
    assert np.isnan(found.poses[cut]).all()
    with pytest.raises(RecordingError, match="log: no velocities: omega and v_x are nowhere known together"):
        estimated({"omega": drive.streams["omega"]}, SETTINGS, GAP, where="log")


def test_the_plane_is_that_of_the_ellipsoid() -> None:
    one = Plane((0.0, 179.9999))
    assert one.at(0.0, -179.9999) == pytest.approx((22.264, 0.0), abs=1e-3)  # across the date line
    assert Plane((0.0, 0.0)).at(1e-3, 0.0)[1] == pytest.approx(110.574, abs=1e-3)  # m per 0.001 degrees at the equator
    assert Plane((45.0, 7.0)).at(45.0, 7.001)[0] == pytest.approx(78.847, abs=1e-3)
    assert Plane((45.0, 7.0)).at(45.001, 7.0)[1] == pytest.approx(111.132, abs=1e-3)


@pytest.mark.parametrize(("name", "value"), [("latitude", 4807.038), ("longitude", -1131.0)])
def test_fixes_in_degrees_and_minutes_are_refused(name: str, value: float) -> None:
    fixes = {"latitude": 48.1173, "longitude": -11.5167}
    streams = {key: Stream(START + np.arange(3), np.full(3, one)) for key, one in fixes.items()}
    require_degrees(streams, "log")
    with pytest.raises(
        RecordingError, match=rf"log: {name} is up to {abs(value):.7g}; expected at most \d+ degrees .*7.038 / 60"
    ):
        require_degrees(streams | {name: Stream(START + np.arange(3), np.full(3, value))}, "log")


def test_sensors_that_are_noisier_than_stated_are_told(drive: Drive) -> None:
    assert noise_notes(drive.streams, SETTINGS) == []
    quiet = Estimation(acceleration_noise=0.02, gyro_noise=0.001)
    assert [note.split(":")[0] for note in noise_notes(drive.streams, quiet)] == ["a_x", "a_y", "omega"]
    assert "write gyro_noise: 0.00" in noise_notes(drive.streams, quiet)[2]


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (("v_x", "omega"), "missing v_y (commands: none); map a_y or write `estimation: {}` to have v_y estimated"),
        (("v_x", "a_y"), "signals: missing omega"),
        (("omega", "a_y"), "signals: missing v_x"),
        (
            ("v_x", "omega", "a_y", "latitude"),
            "latitude and longitude come alone or apart; expected both from one topic",
        ),
    ],
)
def test_a_map_that_lacks_what_the_estimator_needs_is_told_what(names: tuple[str, ...], expected: str) -> None:
    with pytest.raises(ConfigurationError) as error:
        live_map(*names)
    assert expected in str(error.value)


def test_v_y_comes_from_one_place() -> None:
    content = live_map(*ALL).model_dump()
    content["signals"]["v_y"] = content["signals"]["v_x"]
    with pytest.raises(ConfigurationError, match=r"v_y comes from signals\.v_y; expected either"):
        validate(SignalMap, content, "signal map")
    content = live_map(*ALL).model_dump()
    content["signals"]["latitude"]["unit"] = "deg"
    with pytest.raises(ConfigurationError, match=r"signals\.latitude\.unit: 'deg'; it is in degrees, expected none"):
        validate(SignalMap, content, "signal map")
    assert live_map("v_x", "omega", "a_y").estimation == Estimation()
    assert live_map("v_x", "omega", rear_axle=0.1).estimation == Estimation(rear_axle=0.1)


def bag_of(drive: Drive, rows: int) -> list[Any]:
    """Records of the drive's first ``rows``: IMU, wheel speed without a stamp, fixes, actuators."""
    from rosbags.typesys import Stores, get_typestore

    types = get_typestore(Stores.ROS2_JAZZY).types

    def head(t: int) -> Any:
        return types["std_msgs/msg/Header"](types["builtin_interfaces/msg/Time"](t // 10**9, t % 10**9), "")

    vector, records = types["geometry_msgs/msg/Vector3"], []
    turn = types["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0)
    nine, status = np.zeros(9), types["sensor_msgs/msg/NavSatStatus"](status=0, service=1)
    for k, t in enumerate(drive.stamps[:rows].tolist()):
        a_x, a_y, omega = (float(drive.streams[name][1][k]) for name in ("a_x", "a_y", "omega"))
        inputs = messages.joint_state(t, {"throttle": 0.1, "steering": 0.01})
        records.append(("/inputs", messages.JOINT_STATE, t, inputs))
        imu = types["sensor_msgs/msg/Imu"](
            head(t), turn, nine, vector(x=0.0, y=0.0, z=omega), nine, vector(x=a_x, y=a_y, z=9.81), nine
        )
        records.append(("/imu", "sensor_msgs/msg/Imu", t, imu))
        if k % 5 == 0:
            where = (float(drive.streams[name][1][k // 5]) for name in ("latitude", "longitude"))
            fix = types["sensor_msgs/msg/NavSatFix"](head(t), status, *where, 0.0, nine, 0)
            records.insert(len(records) - (k > 0), ("/fix", "sensor_msgs/msg/NavSatFix", t, fix))
        if k % 2 == 0:
            speed = types["std_msgs/msg/Float64"](float(drive.streams["v_x"][1][k // 2]))
            records.append(("/wheel_speed", "std_msgs/msg/Float64", t + 3_000_000, speed))
    return records


def test_a_log_is_extracted_with_its_deviations_and_live_messages_give_the_same(
    drive: Drive, make_bag: Any, tmp_path: Path
) -> None:
    records = bag_of(drive, 300)
    settings = {"rear_axle": 1.7, "origin": ORIGIN}
    recording = extract([make_bag(records)], live_map(*ALL, **settings), 25.0)
    notes = recording.info.notes
    assert any(
        one.startswith("v_x, v_y, omega: estimated from v_x, omega, a_x, a_y, latitude, longitude; ") for one in notes
    )
    assert any("latitude, longitude 48.2000000, 11.6000000" in one for one in notes)
    assert recording.has_pose
    assert set(recording.info.standard_deviations) == {"v_x", "v_y", "omega"}
    assert recording.info.standard_deviations["v_y"] == pytest.approx(float(rms(recording["v_y_std"])), rel=0.1)
    recording.save(tmp_path / "r.parquet")
    np.testing.assert_array_equal(Recording.load(tmp_path / "r.parquet")["v_y_std"], recording["v_y_std"])

    decoders = live_decoders(live_map(*ALL, **settings))
    found = [one for topic, _, t, message in records if (one := decoders[topic].decode(message, t)) and topic == "/imu"]
    assert set(found[-1]) == {"v_x", "v_y", "omega", "x", "y", "theta"}
    end = drive.stamps[300]
    streams = {name: (at[at < end], values[at < end]) for name, (at, values) in drive.streams.items()}
    batch = estimated(streams, Estimation(**settings), GAP, both_sides=False)
    np.testing.assert_allclose([one["v_y"] for one in found], batch.states[:, 1], rtol=0, atol=1e-12)
    assert (decoders["/wheel_speed"].decode(records[3][3], START), decoders["/inputs"].decode(records[0][3])) == (
        {},
        {"throttle_feedback": 0.1, "steering_feedback": 0.01},
    )


@pytest.mark.slow
def test_v_y_of_the_real_car_is_better_than_that_of_its_simplest_rivals(data: Path) -> None:
    """Gyro, accelerometers (10 Hz, not levelled), encoder and positions (5 Hz, 2 cm) of logs that chose nothing."""
    imu, encoder = {"topic": "/imu", "type": "sensor_msgs/msg/Imu"}, "geometry_msgs/msg/TwistStamped"
    measured = load_signal_map("default").with_commands("none")
    content = measured.model_dump()
    pose = {"topic": "/vehicle/odometry", "type": messages.ODOMETRY, "field": "pose.pose.position."}
    own = {
        "v_x": {"topic": "/wheel_speed", "type": encoder, "field": "twist.linear.x", "scale": 1 / 1.015, "delay": 0.1},
        "omega": imu | {"field": "angular_velocity.z", "delay": 0.04},
        "a_x": imu | {"field": "linear_acceleration.x", "delay": 0.04},
        "a_y": imu | {"field": "linear_acceleration.y", "delay": 0.04},
        "x": pose | {"field": "pose.pose.position.x"},
        "y": pose | {"field": "pose.pose.position.y"},
    }
    own |= {name: content["signals"][name] for name in ("throttle_feedback", "steering_feedback")}
    estimating = validate(SignalMap, content | {"signals": own, "estimation": {"rear_axle": 0.093}}, "signal map")
    settings = Estimation(rear_axle=0.093, acceleration_noise=0.6, gyro_noise=0.035, position_noise=0.02)
    squares, random = [], np.random.default_rng(0)
    tests = ("free_driving_1027", "circles_right_03_ramp_1653", "tape_and_tiles_right_03_ramp_1758")
    for name in tests:
        with open_log(data / "dart" / name) as log:
            sensors, truth = (read_streams(log, one, drop_bad=True)[0] for one in (estimating, measured))
        streams = {name: (one.stamps, one.values) for name, one in sensors.items()}
        for axis in ("x", "y"):
            stamps, values = (one[::20] for one in streams[axis])
            streams[axis] = stamps, values + random.normal(scale=0.02, size=len(values))
        for both_sides in (False, True):
            found = estimated(streams, settings, GAP, both_sides=both_sides)
            at = found.stamps[20:]
            v_y, omega = (
                np.interp(at - at[0], truth[one].stamps - at[0], truth[one].values) for one in ("v_y", "omega")
            )
            squares.append([np.mean(error**2) for error in (found.states[20:, 1] - v_y, v_y, v_y - 0.093 * omega)])
    causal, smooth = (np.sqrt(np.mean(squares[k::2], axis=0)) for k in (0, 1))
    for estimate, zero, kinematic in (causal, smooth):
        assert estimate < 0.85 * zero
        assert estimate < 0.5 * kinematic
