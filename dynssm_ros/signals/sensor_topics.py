"""Gyro, accelerometers, wheel speeds and GNSS fixes among the topics of a log: what velocities are estimated from."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping
from dataclasses import replace
from typing import TypeVar

import numpy as np

from dynssm_ros.signals.contents import TopicContent, spread

IMU, FIX = "sensor_msgs/msg/Imu", "sensor_msgs/msg/NavSatFix"
_OF_IMU = {"omega": "angular_velocity.z", "a_x": "linear_acceleration.x", "a_y": "linear_acceleration.y"}
_OF_FIX = {"latitude": "latitude", "longitude": "longitude"}
_SPEED = re.compile(r"wheel\w*speed|speed\w*wheel|vehicle_?speed|(^|[/._])(speed|velocity|linear\.x)$", re.IGNORECASE)
_NO_SPEED = re.compile(
    r"cmd|command|target|desired|set_?point|drive\.|motor|engine|rpm|angular|limit|covariance|wind|steer|gps|gnss",
    re.IGNORECASE,
)
_REAR = re.compile(r"rear|(^|[_\[])r[lr]\b|hinten|(^|[_\[])h[lr]\b", re.IGNORECASE)
_WHEEL = re.compile(r"wheel|rear|front|left|right", re.IGNORECASE)

COLUMNS = {
    "v_x": r"wheel\w*(speed|vel\w*)|(speed|vel\w*)_wheel",
    "a_x": r"^(lin\w*_)?(a|acc|accel|acceleration)_?(x|long\w*)$|^(long\w*|inline)_?(acc\w*|g)$|^g_?long\w*$|^x_acc|^längsb",
    "a_y": r"^(lin\w*_)?(a|acc|accel|acceleration)_?(y|lat|lateral)$|^lat(eral)?_?(acc\w*|g)$|^g_?lat\w*$|^y_acc|^querb",
    "latitude": r"^(gps_|gnss_|fix_)?lat(itude)?$",
    "longitude": r"^(gps_|gnss_|fix_)?(lon|lng|long|longitude)$",
}
"""Words in headings of tables, in lower case and apart by underscores."""

T = TypeVar("T")
Place = tuple[TopicContent, str, float]
"""A topic, a field of it, and its scale."""


def sensors(topics: Mapping[str, TopicContent]) -> dict[str, Place]:
    """Where ``v_x``, ``omega``, ``a_x``, ``a_y``, ``latitude`` and ``longitude`` may come from, as far as they change.

    Nothing without both ``v_x`` and ``omega``.
    """
    found: dict[str, Place] = {}
    for msgtype, fields in ((IMU, _OF_IMU), (FIX, _OF_FIX)):
        fitting = [
            one for one in topics.values() if one.msgtype == msgtype and _changes(one, next(iter(fields.values())))
        ]
        if fitting:
            busiest = max(fitting, key=lambda one: one.count)
            found |= {signal: (busiest, field, 1.0) for signal, field in fields.items() if _changes(busiest, field)}
    speeds = [
        (one, field, 1.0)
        for one in topics.values()
        for field in one.values
        if one.msgtype not in (IMU, FIX) and _is_speed(one, field) and _changes(one, field)
    ]
    if speeds:
        best = max(speeds, key=lambda place: (bool(_WHEEL.search(f"{place[0].name}.{place[1]}")), place[0].count))
        found["v_x"] = _of_rear_axle(best, [place for place in speeds if place[0] is best[0]])
    return of_use(found)


def _of_rear_axle(place: Place, beside: list[Place]) -> Place:
    """The mean of both rear wheels where the topic has them, as one wheel is faster or slower in a bend; else the place."""
    topic, rear = place[0], [field for _, field, _ in beside if _REAR.search(field)]
    if len(rear) != 2:
        return place
    field = " + ".join(rear)
    total = topic.values[rear[0]] + topic.values[rear[1]]
    return replace(topic, values=topic.values | {field: total}), field, 0.5


def of_use(sensed: Mapping[str, T], known: Collection[str] = ()) -> dict[str, T]:
    """What of the ``sensed`` signals an estimate can use beside those that are ``known``: fixes only with both angles,
    and nothing without ``v_x`` and ``omega``.
    """
    has_fix = set(_OF_FIX) <= set(sensed)
    kept = {name: one for name, one in sensed.items() if has_fix or name not in _OF_FIX}
    return kept if {"v_x", "omega"} <= {*known, *kept} else {}


def _is_speed(topic: TopicContent, field: str) -> bool:
    name = f"{topic.name}.{field}"
    named = (
        _SPEED.search(field) or _SPEED.search(topic.name) or (_WHEEL.search(field) and "speed" in topic.name.lower())
    )
    return bool(named) and not _NO_SPEED.search(name) and not field.endswith((".y", ".z"))


def _changes(topic: TopicContent, field: str) -> bool:
    return spread(topic.values.get(field, np.empty(0))) > 0
