"""Which fields of topics, or columns, the signals of a signal map may be: names suggest it, values correct it."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np

from dynssm_ros.arrays import Vector
from dynssm_ros.signals.columns import heading, known_unit
from dynssm_ros.signals.contents import ODOMETRY, POSES, TWISTS, TopicContent, pose_fields, spread, twist_fields
from dynssm_ros.signals.decoding import LOG_TIME
from dynssm_ros.signals.rest_value import rest_value
from dynssm_ros.signals.sensor_topics import COLUMNS, of_use, sensors
from dynssm_ros.signals.signal_map import STATE_SIGNALS, UNITS, command_signals, set_point_of, yaw_of
from dynssm_ros.signals.stamps import clock_notes, frames_note, log_time_note
from dynssm_ros.signals.stated_units import FITTING, QUANTITY_OF, is_unknown, unit_of_field
from dynssm_ros.signals.steering_scale import TOO_FAST, TOO_LARGE, Suggestion, scaled_steering

_MOTION = {
    "v_y": (r"(^|_)(v|vel|velocity|linear)_?(y|lat\w*)$|^v?_?lat\w*_(vel\w*|speed)$|^vlat|quergeschw",),
    "v_x": (
        r"(^|_)(v|vel|velocity|linear)_?(x|long\w*)$|^v_?long\w*$|^long\w*_(vel\w*|speed)$",
        r"speed|spd|velocity|geschw|^v$",
    ),
    "omega": (
        r"yaw_?(rate|vel\w*|speed)|gierrate|psi_?dot|angular(_vel\w*)?_z$|gyro(_?z)?$|z_gyro$|z_rate_of_rotation$|omega(_?z)?$|^(r|wz|w_z)$",
    ),
    "x": (r"^(pos\w*_|pose_)?x(_pos\w*)?$|(^|_)pos(ition)?_?x$|^(east|easting)$",),
    "y": (r"^(pos\w*_|pose_)?y(_pos\w*)?$|(^|_)pos(ition)?_?y$|^(north|northing)$",),
    "theta": (r"^(pose_)?(yaw|theta|heading|psi|gierwinkel)(_angle)?$|orientation_yaw$", r"^phi$"),
}
"""Words for signals in headings, in the order in which they are tried."""
_LEAVE = " (leave v_y out and write `estimation: {}` to have it estimated)"
_QUATERNION = re.compile(
    r"^(?P<name>(?:.*(?:orient|quat|rot|pose)\w*[._/ ]+|.*\bq_?|.*_q_?))x(?P<end>\W.*|)$", re.IGNORECASE
)
_NOT_MOTION = re.compile(
    r"wheel|whl|(^|_)(rad|wind|soll|eng)_|longitude|cmd|command|target|desired|setpoint|engine|motor|std|cov|sigma|acc|rpm|_ref|steer|lenk|error",
    re.IGNORECASE,
)
_WORDS = {
    "steering": re.compile(r"steer|strg|delta|servo|lenk", re.IGNORECASE),
    "throttle": re.compile(
        r"throttle|accelerator|pedal|gas|duty|drossel|(?:^|[\W_])(?:tps|pps|app)(?:$|[\W_])", re.IGNORECASE
    ),
    "brake": re.compile(r"brake|brk|brems", re.IGNORECASE),
}
_COMMAND = re.compile(r"cmd|command|target|desired|set_?point|request|soll", re.IGNORECASE)
_SPEED = re.compile(r"(^|[_\[])(speed|velocity|vel|v|(?:soll)?geschw\w*)($|[_\]])", re.IGNORECASE)
_SET = re.compile(r"ackermann|(^|[\s_/\[])v_?set|position\[speed\]|drive/speed$", re.IGNORECASE)
_NO_SPEED = re.compile(r"steer|angular|ang_?vel|wheel|lat\w*_?vel|\.y$|\.z$|rate", re.IGNORECASE)
_MEASURED = re.compile(r"report|feedback|measured|actual|angle|position|output|pressure", re.IGNORECASE)
_OTHER = re.compile(
    r"clutch|kuppl|rate|veloc|speed|torque|current|status|state|enable|fault|counter|temp|rolling|valid|overrid|timeout|limit|effort"
    r"|covariance|stamp|warn|error|source|mode",
    re.IGNORECASE,
)
_CONTEXT = {
    "gear": re.compile(r"(^|_)(gear|gang)(_?(nr|no|num\w*|pos\w*|actual|current|engaged|state))?$"),
    "engine_speed": re.compile(r"(^|_)(engine|eng|motor)_?(speed|spd|rpm|drehzahl)|(^|_)(rpm|drehzahl)$"),
}
"""Words for signals that are only looked at."""
_RPM = 1000.0  # engine speed from which on it is none in rad/s, where no unit says what it is in
_SHARE = 1.5  # larger values are no throttle between -1 and 1
_ONE_TO_ONE = 0.3  # by which a set-point may change more or less than the speed
_AGREES = 0.5  # correlation with the speed, from which on it may be one
_PULSES = (900.0, 2100.0)  # us, of servos: 1500 is neutral, 500 more is full
_POSES_HZ = 20.0  # of a localisation, from which on a window of 0.1 s has poses enough for velocities
_TURN = 0.1  # rad, of a heading that changes
_FASTEST = 110.0  # m/s
_MOST = {"omega": 15.0, "theta": 60.0}  # range in rad/s, and in rad, from which on degrees are likelier


def suggest(
    topics: dict[str, TopicContent], wheelbase: float | None, notes: list[str], *, is_table: bool
) -> dict[str, Suggestion]:
    """A source for each signal for which one is found; what to look at is added to ``notes``."""
    motion = _motion(topics, notes) if is_table else _odometry(topics, notes)
    used = {one.field for one in motion.values()} if is_table else set()
    others = {name: one for name, one in topics.items() if name not in used}
    signals = motion | _with_set_point(_actuators(others), _speed_set_points(others), notes)
    signals = _set_point_by_speed(signals, notes) | _context(others)
    if not set(command_signals(set_point_of(signals))) <= set(signals):  # of no use alone
        signals = {name: source for name, source in signals.items() if not name.endswith("_command")}
    for name in ("steering_feedback", "steering_command"):
        if name in signals:
            signals[name] = scaled_steering(signals[name], signals, wheelbase)
    notes += _stamps(signals)
    return signals


def _fastest(values: Vector) -> float:
    """Speed that 2 % of the rows exceed, which may be no speeds at all; 0 of none."""
    known = np.abs(values[np.isfinite(values)])
    return float(np.percentile(known, 98)) if len(known) else 0.0


def _motion(columns: dict[str, TopicContent], notes: list[str]) -> dict[str, Suggestion]:
    """Velocities and poses among the columns of a table, by their headings."""
    found: dict[str, Suggestion] = {}
    names = {name: _plain(heading(name).bare) for name, one in columns.items() if one.values}
    names = {name: plain for name, plain in names.items() if not _NOT_MOTION.search(plain)}
    for signal, patterns in _MOTION.items():
        fitting = [
            name
            for pattern in patterns
            for name, plain in names.items()
            if re.search(pattern, plain)
            and name not in [one.field for one in found.values()]
            and _may_be(columns[name], signal)
        ]
        if fitting:
            best = max(fitting, key=lambda name: (spread(columns[name].values[name]) > 0, -fitting.index(name)))
            found[signal] = _with_unit(Suggestion(columns[best], best), QUANTITY_OF[signal])
            others = [name for name in fitting if name != best and not re.search(patterns[0], names[best])]
            if others:
                found[signal] = replace(found[signal], note=f"or {', '.join(dict.fromkeys(others))}")
    if "v_x" not in found:
        taken = {one.field for one in found.values()}
        by_unit = [name for name in names if columns[name].unit in FITTING["m/s"] and name not in taken]
        if by_unit:
            best = max(by_unit, key=lambda name: spread(columns[name].values[name]))
            found["v_x"] = replace(
                _with_unit(Suggestion(columns[best], best), "m/s"), note="taken for the speed by its unit"
            )
    if "theta" not in found and (yaw := _yaw_of_columns(columns)):
        found["theta"] = yaw
    if not {"x", "y", "theta"} <= set(found):
        found = {name: one for name, one in found.items() if name in STATE_SIGNALS}
    has_path = "x" in found and spread(found["x"].values) + spread(found["y"].values) > 0
    if not set(STATE_SIGNALS) <= set(found) and has_path:
        lack = ", ".join(name for name in STATE_SIGNALS if name not in found)
        notes.append(f"no column is {lack}; velocities follow from the poses")
        found = {name: one for name, one in found.items() if name not in STATE_SIGNALS}
    elif "v_y" not in found and (sensed := _sensor_columns(columns, found)):
        found = {name: one for name, one in found.items() if name in STATE_SIGNALS} | sensed
        notes.append(f"no column is v_y; it is estimated from {', '.join(found)} (estimation: give rear_axle, m)")
    elif "v_y" not in found and {"v_x", "omega"} <= set(found):
        notes.append("no column is v_y; it is that of a steady turn (estimation: give rear_axle, m)")
    elif not found:
        notes.append("no column tells where the car is or how fast; find v_x, v_y and omega, or x, y and theta")
    if "v_y" in found and spread(found["v_y"].values) == 0:
        notes.append(f"{found['v_y'].field}: v_y is constant, so that nothing is known of how the car slides{_LEAVE}")
    if "v_x" in found and _fastest(found["v_x"].values) > _FASTEST:
        found["v_x"] = replace(found["v_x"], note=TOO_FAST)
    if "theta" in found and found["theta"].unit == "1" and _wraps_at_360(found["theta"].values):
        found["theta"] = replace(found["theta"], unit="deg", note="taken for degrees: it wraps by 360")
    for name in ("omega", "theta"):
        if name in found and found[name].unit == "1" and spread(found[name].values) > _MOST[name]:
            found[name] = replace(found[name], note=TOO_LARGE)
    return found


def _wraps_at_360(values: Vector) -> bool:
    """Whether a heading jumps by about 360 and keeps within that."""
    known = values[np.isfinite(values)]
    return spread(known) <= 361.0 and float(np.abs(np.diff(known)).max(initial=0.0)) > 300.0


def _sensor_columns(columns: dict[str, TopicContent], found: dict[str, Suggestion]) -> dict[str, Suggestion]:
    """Accelerations, fixes and, where nothing else is the speed, a wheel's; nothing without both speed and yaw rate."""
    sensed: dict[str, Suggestion] = {}
    for signal, pattern in COLUMNS.items():
        fitting = [
            Suggestion(one, name)
            for name, one in columns.items()
            if one.values and re.search(pattern, _plain(heading(name).bare)) and spread(one.values[name]) > 0
        ]
        if fitting and signal not in found:
            sensed[signal] = _with_unit(fitting[0], QUANTITY_OF.get(signal))
    return of_use(sensed, found)


def _yaw_of_columns(columns: dict[str, TopicContent]) -> Suggestion | None:
    """The yaw of a quaternion in four columns whose headings end in x, y, z and w alike, as ``qx`` or ``orientation.x``."""
    for first, content in columns.items():
        match = _QUATERNION.match(first)
        names = [f"{match['name']}{axis}{match['end']}" for axis in "xyzw"] if match else []
        parts = [columns[name].values[name] for name in names if name in columns and columns[name].values]
        if len(parts) == 4 and len({len(one) for one in parts}) == 1:
            field = f"yaw({', '.join(names)})"
            yaw = yaw_of(*parts)
            if np.isfinite(yaw).any():
                return Suggestion(replace(content, name=field, values={field: yaw}, unit=""), field)
    return None


def _plain(name: str) -> str:
    """A heading in lower case, its words apart by underscores."""
    words = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name)
    return re.sub(r"[^0-9a-zäöüß]+", "_", words.lower()).strip("_")


def _may_be(column: TopicContent, signal: str) -> bool:
    """Whether the unit of a column, if it has one, is one of that signal."""
    return column.unit not in UNITS or column.unit in FITTING[QUANTITY_OF[signal]]


def _with_unit(suggestion: Suggestion, quantity: str | None) -> Suggestion:
    """The source with the unit that its name states, if that is one of the ``quantity``, a unit of the SI."""
    topic = suggestion.topic
    written = topic.unit or unit_of_field(topic.name, suggestion.field)
    unit = known_unit(written) or written
    if quantity is None or unit == quantity:
        return suggestion
    if is_unknown(unit):
        return replace(suggestion, note=f"in {unit} by its name: scale it to {quantity}")
    return replace(suggestion, unit=unit) if unit in FITTING[quantity] else suggestion


def _odometry(topics: dict[str, TopicContent], notes: list[str]) -> dict[str, Suggestion]:
    """The odometry that moves most often, of those with v_y if one has it; else the twist that does, if there is one."""
    moving = _with_velocities(topics)
    if not moving:
        return _without_velocities(topics, notes)
    best = max(moving, key=lambda topic: (_slides(topic), topic.count))
    if len(moving) > 1:
        kind = "odometries" if best.msgtype == ODOMETRY else "twists"
        notes.append(f"several {kind} move: {', '.join(topic.name for topic in moving)}; taken is {best.name}")
    twist = twist_fields(best.msgtype)
    omega = best.values[twist["omega"]]
    poses = [topic for topic in topics.values() if topic.msgtype in POSES and _moves(topic)]
    turning = [topic for topic in poses if _turns(topic)]
    if spread(omega) == 0 and turning:
        pose = max(turning, key=lambda topic: (topic is not best, topic.count))
        notes.append(
            f"{best.name}: omega is constant {float(omega[0]):g} while the car turns; velocities follow from the poses of "
            f"{pose.name}"
        )
        return _fields(pose, pose_fields(pose.msgtype))
    if spread(best.values[twist["v_y"]]) == 0:
        told = f"{best.name}: v_y is constant, so that nothing is known of how the car slides"
        localised = [topic for topic in turning if topic.msgtype != ODOMETRY and topic.rate >= _POSES_HZ]
        if localised:
            pose = max(localised, key=lambda topic: topic.count)
            notes.append(f"{told}; velocities follow from the poses of {pose.name}")
            return _fields(pose, pose_fields(pose.msgtype))
        notes.append(f"{told}{_LEAVE}")
    beside = [best] if best.msgtype == ODOMETRY else poses
    placed = max((topic for topic in beside if _moves(topic)), key=lambda topic: topic.count, default=None)
    return _fields(best, twist) | (_fields(placed, pose_fields(placed.msgtype)) if placed else {})


def _slides(topic: TopicContent) -> bool:
    """Whether a topic measures how the car slides, often enough."""
    twist = twist_fields(topic.msgtype)
    lives = [spread(topic.values[twist[signal]]) > 0 for signal in ("v_y", "omega")]
    return all(lives) and topic.rate >= _POSES_HZ


def _with_velocities(topics: dict[str, TopicContent]) -> list[TopicContent]:
    """The odometries that move, else the twists that move and turn and are no commands."""
    twists = [
        topic
        for topic in topics.values()
        if topic.msgtype in TWISTS and topic.values and spread(topic.values[twist_fields(topic.msgtype)["v_x"]]) > 0
    ]
    odometries = [topic for topic in twists if topic.msgtype == ODOMETRY]
    return odometries or [
        topic
        for topic in twists
        if spread(topic.values[twist_fields(topic.msgtype)["omega"]]) > 0 and not _COMMAND.search(topic.name)
    ]


def _without_velocities(topics: dict[str, TopicContent], notes: list[str]) -> dict[str, Suggestion]:
    """Poses or sensors that velocities follow from."""
    poses = [topic for topic in topics.values() if topic.msgtype in POSES and _moves(topic)]
    if poses:
        best = max(poses, key=lambda topic: topic.count)
        notes.append(f"no topic has velocities; they follow from the poses of {best.name}")
        return _fields(best, pose_fields(best.msgtype))
    found = sensors(topics)
    if not found:
        notes.append("nothing tells where the car is or how fast; find a topic with v_x, v_y and omega, or with poses")
        return {}
    lack = "" if "a_y" in found else "; it has no accelerometer, and v_y is that of a steady turn"
    notes.append(
        f"nothing measures v_y; it is estimated from {', '.join(found)} (estimation: give rear_axle, m from the "
        f"centre of gravity){lack}"
    )
    return {signal: _with_unit(Suggestion(*place), QUANTITY_OF.get(signal)) for signal, place in found.items()}


def _fields(topic: TopicContent, fields: dict[str, str]) -> dict[str, Suggestion]:
    return {signal: Suggestion(topic, path) for signal, path in fields.items()}


def _moves(topic: TopicContent) -> bool:
    fields = pose_fields(topic.msgtype)
    return any(spread(topic.values[fields[name]]) > 0 for name in ("x", "y") if fields[name] in topic.values)


def _turns(topic: TopicContent) -> bool:
    return spread(topic.values.get(pose_fields(topic.msgtype)["theta"], np.empty(0))) > _TURN


def _actuators(topics: dict[str, TopicContent]) -> dict[str, Suggestion]:
    """Throttle, steering and brake by their names, as measured and as commanded."""
    found: dict[str, Suggestion] = {}
    for actuator, words in _WORDS.items():
        ranked: dict[str, list[tuple[tuple[int, ...], Suggestion]]] = {"feedback": [], "command": []}
        for topic in topics.values():
            for path, values in topic.values.items():
                name = f"{topic.name} {path}"
                leaf = path.rsplit(".", 1)[-1]
                own = bool(words.search(path)) + bool(words.search(leaf))
                others = any(word.search(path) for key, word in _WORDS.items() if key != actuator)
                if not (own or words.search(topic.name)) or others or _OTHER.search(path):
                    continue
                kind = "command" if _COMMAND.search(name) else "feedback"
                varied = len(np.unique(values[np.isfinite(values)])) > 2
                rank = (varied, own, bool(_MEASURED.search(leaf)), bool(_MEASURED.search(topic.name)), topic.count)
                quantity = "rad" if actuator == "steering" else "1"
                ranked[kind].append((rank, _with_unit(Suggestion(topic, path), quantity)))
        for kind, candidates in ranked.items():
            if candidates:
                best = _scaled(actuator, max(candidates, key=lambda pair: pair[0])[1])
                found[f"{actuator}_{kind}"] = _at_rest(best) if actuator == "brake" else best
        if f"{actuator}_feedback" not in found and f"{actuator}_command" in found and actuator != "brake":
            command = found[f"{actuator}_command"]
            note = "no feedback found: the command is taken for it"
            found[f"{actuator}_feedback"] = replace(command, note=note)
    return found


def _context(topics: dict[str, TopicContent]) -> dict[str, Suggestion]:
    """Gear and engine speed by their names, where they change."""
    found: dict[str, Suggestion] = {}
    for signal, words in _CONTEXT.items():
        fitting = [
            Suggestion(topic, path)
            for topic in topics.values()
            for path, values in topic.values.items()
            if spread(values) > 0 and not _COMMAND.search(f"{topic.name} {path}") and words.search(_leaf(topic, path))
        ]
        if fitting:
            found[signal] = max(fitting, key=lambda one: one.topic.count)
    if (engine := found.get("engine_speed")) is not None:
        in_rpm = engine.topic.unit == "rpm" or float(np.nanmax(np.abs(engine.values), initial=0.0)) > _RPM
        found["engine_speed"] = replace(engine, unit="rpm" if in_rpm else "1")
    return found


def _leaf(topic: TopicContent, path: str) -> str:
    """The words of a field, with those of its topic where it is but ``data`` or such."""
    bare = heading(path).bare if path == topic.name else path
    leaf = _plain(bare.rsplit(".", 1)[-1])
    return _plain(topic.name) if leaf in ("data", "value") else leaf


def _speed_set_points(topics: dict[str, TopicContent]) -> dict[str, Suggestion]:
    """The speed that a car is asked for: as it acts and, where there are two, as it is commanded."""
    found: dict[str, list[Suggestion]] = {"feedback": [], "command": []}
    for topic in topics.values():
        for path in topic.values:
            leaf, name = path.rsplit(".", 1)[-1], f"{topic.name} {path}"
            is_speed = _SPEED.search(_plain(leaf)) or _SPEED.search(leaf)
            asked = _SET.search(f"{topic.msgtype} {path}") or _COMMAND.search(name)
            if is_speed and asked and not _NO_SPEED.search(path):
                kind = "command" if _COMMAND.search(name) else "feedback"
                found[kind].append(_with_unit(Suggestion(topic, path), "m/s"))
    best = {
        kind: max(some, key=lambda one: (spread(one.values), one.topic.count)) for kind, some in found.items() if some
    }
    if "feedback" not in best and "command" in best:
        return {"speed_feedback": best["command"]}
    return {f"speed_{kind}": one for kind, one in best.items()}


def _with_set_point(
    found: dict[str, Suggestion], asked: dict[str, Suggestion], notes: list[str]
) -> dict[str, Suggestion]:
    """The actuators, with a speed set-point where no throttle is found."""
    if not asked:
        return found
    one = asked["speed_feedback"]
    where = one.field if one.field == one.topic.name else f"{one.topic.name}: {one.field}"
    words = f"{where} is a set-point of the speed, no throttle"
    if "throttle_feedback" in found:
        notes.append(
            f"{words}; for a vehicle with inputs.set_point: speed map it as speed_feedback, instead of the throttle"
        )
        return found
    notes.append(f"{words}; take a vehicle with inputs.set_point: speed, such as f1tenth")
    without = {name: each for name, each in found.items() if not name.startswith(("throttle", "brake"))}
    return without | {name: replace(each, note="a set-point") for name, each in asked.items()}


def _set_point_by_speed(signals: dict[str, Suggestion], notes: list[str]) -> dict[str, Suggestion]:
    """The signals with a speed set-point instead of a throttle that is larger than one can be and follows the speed."""
    one = signals.get("throttle_feedback")
    if one is None or "v_x" not in signals or spread(signals["v_x"].values) == 0:
        return signals
    asked = replace(one, scale=1.0, offset=0.0, note="a set-point: it follows v_x")
    values, v_x = asked.values, np.interp(one.topic.time, signals["v_x"].topic.time, signals["v_x"].values)
    if not np.isfinite(values).all() or not _SHARE < np.abs(values).max(initial=0.0) < _FASTEST or spread(values) == 0:
        return signals
    if np.corrcoef(values, v_x)[0, 1] < _AGREES or abs(float(np.polyfit(v_x, values, 1)[0]) - 1.0) > _ONE_TO_ONE:
        return signals
    kept = {name: each for name, each in signals.items() if not name.startswith(("throttle", "brake"))}
    if "throttle_command" in signals:
        kept["speed_command"] = replace(signals["throttle_command"], scale=1.0, offset=0.0)
    return _with_set_point(kept, {"speed_feedback": asked}, notes)


def _scaled(actuator: str, suggestion: Suggestion) -> Suggestion:
    """Pedals between 0 and 1; the steering is scaled by the curvature."""
    values = suggestion.values
    largest = float(np.nanmax(np.abs(values))) if np.isfinite(values).any() else 0.0
    if actuator == "steering" or largest <= _SHARE:
        return suggestion
    if actuator == "throttle" and _PULSES[0] <= np.nanmin(values) and largest <= _PULSES[1]:
        return replace(suggestion, scale=1 / 500, offset=-3.0, note="taken for servo pulses: 1500 is neutral")
    if actuator == "throttle" and largest <= 100.0 * _SHARE:
        return replace(suggestion, scale=0.01, note="taken for percent")
    note = f"up to {largest:.4g} in the log, which is taken for full {actuator}"
    return replace(suggestion, scale=1.0 / largest, note=note)


def _at_rest(brake: Suggestion) -> Suggestion:
    """The brake without what its sensor shows while nobody brakes."""
    limit = rest_value(brake.values)
    note = f"up to {limit:.4g} nobody brakes: offset"
    return replace(brake, offset=-limit, note=f"{brake.note}; {note}" if brake.note else note) if limit else brake


def _stamps(signals: dict[str, Suggestion]) -> list[str]:
    """What is to be said of the stamps and frames of the topics that the signals come from."""
    used = {suggestion.topic.name: suggestion.topic for suggestion in signals.values()}
    found = [log_time_note(name) for name, one in used.items() if one.stamped == LOG_TIME]
    found += [note for name, one in used.items() for note in frames_note(name, one.frames)]
    first = signals.get("v_x", signals.get("x"))
    if first is not None:
        found += clock_notes({name: one.late for name, one in used.items()}, first.topic.name)
    return found
