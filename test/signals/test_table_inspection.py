"""What an inspection says of tables as people have them: exports of Excel, MATLAB, loggers; and the map it suggests."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import yaml

from dynssm_ros.errors import BagError
from dynssm_ros.signals.columns import heading, known_unit
from dynssm_ros.signals.contents import TopicContent
from dynssm_ros.signals.extraction import extract
from dynssm_ros.signals.inspection import Inspection, inspect
from dynssm_ros.signals.recording import Recording
from dynssm_ros.signals.signal_map import SignalMap
from dynssm_ros.signals.suggestions import suggest

WHEELBASE = 0.3
T = np.arange(0.0, 20.0, 0.02)
DELTA, V_X = 0.2 * np.sin(T), 3.0 + np.sin(0.3 * T)
OMEGA, V_Y = V_X * np.tan(DELTA) / WHEELBASE, 0.01 * np.sin(T)


def suggested(found: Inspection) -> SignalMap:
    """The signal map, read back."""
    return SignalMap.model_validate(yaml.safe_load(found.signal_map()))


def rows(path: Path, head: str, form: str, *columns: Any, encoding: str = "utf-8", comma: bool = False) -> Path:
    """Writes a text table whose rows have the ``columns`` in the form ``form``, with a decimal comma if wanted."""
    lines = [form.format(*cells) for cells in zip(*columns, strict=True)]
    text = head + "\n".join(line.replace(".", ",") if comma else line for line in lines) + "\n"
    path.write_bytes(text.replace("\n", "\r\n").encode(encoding))
    return path


def german(path: Path) -> Path:
    clock = [f"13:{int(t) // 60:02d}:{int(t) % 60:02d}.{round(t * 1000) % 1000:03d}" for t in T]
    head = (
        "Messung 7;;;;;\nFahrer: Müller;;;;;\n\nZeit;Geschwindigkeit [km/h];Gierrate [°/s];Quergeschwindigkeit [m/s];"
        "Lenkwinkel [°];Gaspedal [%]\n"
    )
    columns = (clock, V_X * 3.6, np.degrees(OMEGA), V_Y, np.degrees(DELTA) * 14, 40 + 10 * np.sin(T))
    return rows(path, head, "{};{:.6f};{:.6f};{:.6f};{:.6f};{:.1f}", *columns, encoding="cp1252", comma=True)


def matlab(path: Path) -> Path:
    head = "time,vx,vy,yawRate,steer_angle,throttle_pos,steer_cmd,throttle_cmd\ns,m/s,m/s,deg/s,deg,%,deg,%\n"
    steer = np.degrees(DELTA)
    return rows(
        path,
        head,
        "{},{},{},{},{},{},{},{}",
        T,
        V_X,
        V_Y,
        np.degrees(OMEGA),
        steer,
        40 + 10 * np.sin(T),
        steer,
        41 + 0 * T,
    )


def night(path: Path) -> Path:
    seconds = (86_390 + T) % 86_400
    clock = [f"{int(s // 3600):02d}:{int(s // 60 % 60):02d}:{s % 60:06.3f}" for s in seconds]
    head = "Time of Day\tSpeed (mph)\tLateral Velocity (m/s)\tYaw Rate (rad/s)\tSteering Angle\tThrottle\tGear\tState\n"
    state = ["OK" if k % 7 else "WARN" for k in range(len(T))]
    columns = (clock, V_X / 0.44704, V_Y, OMEGA, DELTA, 0.4 + 0.1 * np.sin(T), 3 + 0 * T, state)
    return rows(path, head, "{}\t{}\t{}\t{}\t{}\t{}\t{}\t{}", *columns, encoding="utf-16")


def logger(path: Path) -> Path:
    x, y, theta = (
        np.cumsum(0.02 * one)
        for one in (V_X * np.cos(np.cumsum(0.02 * OMEGA)), V_X * np.sin(np.cumsum(0.02 * OMEGA)), OMEGA)
    )
    duty = [f"{0.4 + 0.001 * (k % 9):.3f}" if k != 500 else "ERR" for k in range(len(T))]
    battery = ["" if k % 10 else "12.1" for k in range(len(T))]
    head = "# logger v2, 3 sensors\n# boot_ms,x_m,y_m,yaw_deg,servo,duty,battery\n"
    columns = (123_456 + np.round(T * 1e3).astype(int), x, y, np.degrees(theta) % 360, DELTA, duty, battery)
    return rows(path, head, "{},{},{},{},{},{},{}", *columns)


def plotted(path: Path) -> Path:
    """As PlotJuggler exports topics, in an order of its own and stamped since 1970."""
    head = (
        "__time,/odom/twist/twist/angular/z,/odom/twist/twist/linear/x,/odom/twist/twist/linear/y,/joints/steering/position,"
        "/joints/throttle/position\n"
    )
    return rows(path, head, "{:.6f},{},{},{},{},{}", 1_700_000_000 + T, OMEGA, V_X, V_Y, DELTA, 0.4 + 0.1 * np.sin(T))


TABLES = {
    "german.csv": (german, 4, {"throttle_feedback": ("Gaspedal [%]", "%"), "v_x": ("Geschwindigkeit [km/h]", "km/h")}),
    "matlab.csv": (matlab, 2, {"omega": ("yawRate", "deg/s"), "throttle_command": ("throttle_cmd", "%")}),
    "night.txt": (night, 1, {"v_x": ("Speed (mph)", "mph"), "omega": ("Yaw Rate (rad/s)", "1")}),
    "logger.csv": (logger, 2, {"theta": ("yaw_deg", "deg"), "throttle_feedback": ("duty", "1")}),
    "plotted.csv": (plotted, 1, {"v_x": ("/odom/twist/twist/linear/x", "1")}),
}  # fmt: skip


@pytest.mark.parametrize("name", TABLES)
def test_tables_as_people_have_them_give_the_signals_that_are_in_them(tmp_path: Path, name: str) -> None:
    write, above, sources = TABLES[name]
    found = inspect(write(tmp_path / name), WHEELBASE)
    assert f"{above} line{'s' * (above > 1)} above the first row" in found.notes[0]
    assert found.missing == ()
    mapped = suggested(found)
    assert {one: (mapped.signals[one].column, mapped.signals[one].unit) for one in sources} == sources
    recording = extract([tmp_path / name], mapped, 50.0, drop_bad=name == "logger.csv")
    assert_driven(recording, 0.05 if name == "logger.csv" else 1e-4)


def assert_driven(recording: Recording, tolerance: float) -> None:
    """That the recording has the drive of this page."""
    t = (recording.time - recording.time[0]) / 1e9 + (
        T[-1] - recording.duration + 0.02 if len(recording) < len(T) else 0.0
    )
    rows = slice(20, 900)
    np.testing.assert_allclose(recording["v_x"][rows], np.interp(t, T, V_X)[rows], rtol=tolerance + 0.01)
    np.testing.assert_allclose(recording["omega"][rows], np.interp(t, T, OMEGA)[rows], atol=tolerance * 8)
    np.testing.assert_allclose(recording["delta_fb"][rows], np.interp(t, T, DELTA)[rows], atol=tolerance / 2 + 0.02)
    assert 0.25 < recording["r_fb"].mean() < 0.5


HEADINGS = {
    "aim": {"v_x": "GPS Speed [km/h]", "omega": "GPS Gyro [deg/s]", "throttle_feedback": "PPS [%]",
            "steering_feedback": "Steering Pos [deg]", "brake_feedback": "Brake Press [bar]", "a_x": "InlineAcc [g]",
            "a_y": "LateralAcc [g]", "latitude": "GPS Latitude", "longitude": "GPS Longitude", "gear": "Gear",
            "engine_speed": "RPM"},
    "can": {"v_x": "VehSpd_KPH", "omega": "YawRate_DPS", "throttle_feedback": "AccelPedalPos_pct",
            "steering_feedback": "StrgAng_deg", "brake_feedback": "BrkPress_bar", "a_x": "LongAccel_mps2",
            "a_y": "LatAccel_mps2", "gear": "TransGear", "engine_speed": "EngSpd_rpm", "wheel_speed": "WhlSpd_FL"},
    "german": {"v_x": "v_Fzg [km/h]", "omega": "Gierrate [deg/s]", "throttle_feedback": "Fahrpedal [%]",
               "steering_feedback": "Lenkradwinkel [°]", "brake_feedback": "Bremsdruck [bar]",
               "a_x": "Längsbeschleunigung [m/s²]", "a_y": "Querbeschleunigung [m/s²]", "gear": "Gang [-]",
               "engine_speed": "Motordrehzahl [1/min]"},
    "telephone": {"v_x": "speed", "omega": "z_rate_of_rotation", "throttle_feedback": "accelerator_pos",
                  "steering_feedback": "steering_angle", "brake_feedback": "brake_pos", "a_x": "longitudinal_acc",
                  "a_y": "lateral_acc", "latitude": "latitude", "longitude": "longitude", "engine_speed": "rpm"},
    "simulator": {"v_x": "LocalVelocityX", "v_y": "LocalVelocityY", "omega": "LocalAngularVelZ", "x": "CarPosX",
                  "y": "CarPosY", "theta": "Heading", "throttle_feedback": "Gas", "steering_feedback": "SteerAngle",
                  "gear": "Gear", "engine_speed": "EngineRpm"},
    "plotted": {"v_x": "/odom/twist/twist/linear/x", "v_y": "/odom/twist/twist/linear/y",
                "omega": "/odom/twist/twist/angular/z", "steering_feedback": "/drive/drive/steering_angle",
                "speed_feedback": "/drive/drive/speed"},
}  # fmt: skip
"""Headings of loggers, by signal."""


@pytest.mark.parametrize("logger", HEADINGS)
def test_headings_of_loggers_are_known(logger: str) -> None:
    values = {"gear": np.floor(V_X), "engine_speed": 2000 * V_X, "v_x": V_X, "speed_feedback": V_X + 0.1}
    topics = {
        name: TopicContent(name, "number", len(T), 50.0, 0.02, T, {name: values.get(signal, np.sin(T + k))}, unit)
        for k, (signal, name) in enumerate(HEADINGS[logger].items())
        for unit in [known_unit(heading(name).unit) or ""]
    }
    found = suggest(topics, WHEELBASE, [], is_table=True)
    assert {name: one.field for name, one in found.items()} == {
        name: column for name, column in HEADINGS[logger].items() if name != "wheel_speed"
    }
    assert found["engine_speed"].unit == "rpm" if "engine_speed" in found else "speed_feedback" in found


def test_columns_are_told_with_type_rate_range_and_zeros(tmp_path: Path) -> None:
    found = inspect(logger(tmp_path / "log.csv"))
    battery, duty = found.topics["battery"], found.topics["duty"]
    assert (battery.count, battery.limits, round(battery.rate, 6)) == (100, (12.1, 12.1, 0.0), 5.0)
    assert found.topics["x_m"].unit == "m"
    assert duty.reason == "1 of its cells is no number, first 'ERR' in row 501"
    assert f"duty: {duty.reason}" in found.notes
    assert "no column is v_x, v_y, omega; velocities follow from the poses" in found.notes
    assert found.notes[0].endswith("time in ms from column 'boot_ms'")


def test_a_column_that_cannot_be_read_is_listed_with_its_reason(tmp_path: Path) -> None:
    found = inspect(night(tmp_path / "log.txt"))
    assert found.topics["State"].reason == "text, 'WARN' first"
    nested = pa.array([[1.0, 2.0]] * len(T))
    table = {"t": T, "speed": V_X, "path": nested, "none": pa.nulls(len(T)), "on": V_X > 3, "kind": ["a"] * len(T)}
    pq.write_table(pa.table(table), tmp_path / "log.parquet")
    topics = inspect(tmp_path / "log.parquet").topics
    reasons = {name: one.reason for name, one in topics.items() if one.reason}
    assert reasons == {
        "path": "list<element: double>, no number", "none": "no cell has a value", "kind": "text, 'a' first"
    }  # fmt: skip
    assert topics["on"].limits is not None


def test_a_fast_speed_and_large_angles_without_units_are_asked_about(tmp_path: Path) -> None:
    head = "t,speed,v_y,yaw_rate,steering,throttle\n"
    path = rows(
        tmp_path / "log.csv", head, "{},{},{},{},{},{}", T, 60 * V_X, V_Y, np.degrees(OMEGA), DELTA, 0.4 + 0 * T
    )
    text = inspect(path).signal_map()
    still = rows(tmp_path / "still.csv", head, "{},{},{},{},{},{}", T, V_X, 0 * T, OMEGA, DELTA, 0.4 + 0 * T)
    told = "v_y: v_y is constant, so that nothing is known of how the car slides (leave v_y out and write `estimation: {}` to"
    assert any(note.startswith(told) for note in inspect(still).notes)
    assert "# too fast for m/s: find its unit\n  v_x: {column: speed}" in text
    assert "# large for rad: deg?\n  omega: {column: yaw_rate}" in text
    assert "# its scale is not known before v_x (too fast" in text
    assert "steering_feedback: {column: steering}" in text


def test_what_no_signal_can_be_disturbs_no_suggestion(tmp_path: Path) -> None:
    """Infinities and values near the end of what a number can hold, as some loggers write for an empty cell."""
    columns = {"time": T, "vx": V_X, "vy": V_Y, "yaw rate": OMEGA, "steering": DELTA, "throttle": 0.4 + 0.1 * np.sin(T)}
    odd = {name: values.copy() for name, values in columns.items()}
    for name in set(odd) - {"time"}:
        odd[name][[3, 40, 41]] = np.inf, 1.7e308, -1e200
    found = []
    for name, each in (("good", columns), ("odd", odd)):
        pq.write_table(pa.table(each), tmp_path / f"{name}.parquet")
        found.append(inspect(tmp_path / f"{name}.parquet", WHEELBASE))
    good, spoilt = ({name: (one.field, one.scale) for name, one in each.signals.items()} for each in found)
    assert len(good) == 5
    assert spoilt == good
    with pytest.raises(BagError, match=r"is larger than any signal|is not finite"):
        extract([tmp_path / "odd.parquet"], suggested(found[1]), 50.0)
    assert len(extract([tmp_path / "odd.parquet"], suggested(found[1]), 50.0, drop_bad=True)) > 950


def test_units_without_words_and_headings_in_degrees_are_told_by_their_values(tmp_path: Path) -> None:
    t = np.arange(1500) / 50
    omega, v = 0.6 + 0.5 * np.sin(t), 12.0 + 3.0 * np.sin(t / 3)
    theta = np.cumsum(omega) / 50
    place = np.cumsum(v * np.exp(1j * theta)) / 50
    heading = np.degrees(theta) % 360.0
    pulses = 1500.0 + 400.0 * np.sin(t)
    path = tmp_path / "log.csv"
    head = "t,east,north,yaw,v_Fzg [km/h],vy,yaw_rate,throttle_us,steer"
    np.savetxt(
        path, np.stack([t, place.real, place.imag, heading, 3.6 * v, 0 * t + 0.01 * omega, omega, pulses, 0.1 * omega], 1),
        delimiter=",", header=head, comments="",
    )  # fmt: skip
    found = inspect(path)
    signals = found.signals
    assert signals["theta"].unit == "deg"
    assert (signals["v_x"].field, signals["v_x"].unit) == ("v_Fzg [km/h]", "km/h")
    np.testing.assert_allclose(signals["throttle_feedback"].values, 0.8 * np.sin(t), atol=1e-6)
    recording = extract([path], suggested(found), 50.0)
    np.testing.assert_allclose(recording["v_x"], v, atol=1e-6)
    np.testing.assert_allclose(recording["theta"] - recording["theta"][0], theta - theta[0], atol=1e-6)


def test_a_throttle_that_follows_the_speed_one_to_one_is_a_set_point(tmp_path: Path) -> None:
    t = np.arange(1500) / 50
    v = 3.0 + np.sin(t / 3)
    path = tmp_path / "log.csv"
    np.savetxt(
        path, np.stack([t, v, 0.01 * np.sin(t), np.sin(t), v + 0.2 * np.cos(t / 3), 0.1 * np.sin(t)], 1),
        delimiter=",", header="t,vx,vy,yaw_rate,throttle,steer", comments="",
    )  # fmt: skip
    found = inspect(path)
    assert found.signals["speed_feedback"].field == "throttle"
    assert "throttle_feedback" not in found.signals
    assert found.missing == ()
    assert any("set-point of the speed" in note for note in found.notes)
