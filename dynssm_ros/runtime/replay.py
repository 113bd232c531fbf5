"""Offline replay: the live predictor fed from a bag, message by message in recorded order."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

from dynssm_ros.errors import BagError
from dynssm_ros.files import real_path
from dynssm_ros.runtime.predictor import Prediction, Predictor
from dynssm_ros.signals.bags import Bag, copy_topics, open_bag, write_bag
from dynssm_ros.signals.decoding import Frames, frames_of, header_stamp_ns, live_decoders
from dynssm_ros.signals.history import Refusal
from dynssm_ros.signals.messages import (
    JOINT_STATE,
    ODOMETRY,
    PARAMETERS_TOPIC,
    PREDICTION_TOPIC,
    joint_state,
    odometry,
    planar_covariance,
)
from dynssm_ros.vehicle import COEFFICIENTS


class Replayed(NamedTuple):
    """The answer to one odometry message."""

    log_time: int  # ns
    stamp: int  # ns, of the odometry
    outcome: Prediction | Refusal
    frames: Frames
    """``frame_id`` and ``child_frame_id`` of the odometry, empty where it has none."""


def replay(bag: Bag, predictor: Predictor, progress: Callable[[int, int], None] | None = None) -> Iterator[Replayed]:
    """Feeds the messages of ``bag`` to ``predictor`` as the node would receive them.

    Yields:
        The outcome for each odometry message.

    Raises:
        BagError: a topic is missing, of another type, or a message damaged.
    """
    by_topic = live_decoders(predictor.signal_map)
    for topic, decoder in by_topic.items():
        bag.require(topic, decoder.msgtype)
    total = sum(bag.counts[topic] for topic in by_topic)
    for done, (topic, log_time, raw) in enumerate(bag.messages(list(by_topic)), 1):
        message = bag.decode(topic, raw)
        stamp = header_stamp_ns(message)
        stamp = log_time if stamp is None else stamp
        values = by_topic[topic].decode(message, stamp)
        if topic == predictor.signal_map.odometry_topic:
            frames = frames_of(message)
            yield Replayed(log_time, stamp, predictor.predict(stamp, values, frames), frames or ("", ""))
        else:
            predictor.observe(stamp, values)
        if progress is not None:
            progress(done, total)


def replay_to_bag(
    bag: Path,
    predictor: Predictor,
    out: Path,
    with_inputs: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[int, Counter[Refusal], list[str]]:
    """Writes the predictions for ``bag`` into a new bag with the node's output topics.

    Args:
        bag: what was recorded.
        predictor: freshly made.
        out: the new bag.
        with_inputs: also copy all topics of ``bag``, to look at them together.
        progress: told of each message.

    Returns:
        The number of predictions, the refusals by reason, and notes on a bag that had to be recovered.

    Raises:
        BagError: as :func:`replay`, or ``out`` is the bag itself.
    """
    if real_path(out) in (real_path(bag), real_path(bag).parent):
        raise BagError(f"{out}: is the bag that is replayed; expected another folder to write")
    refusals: Counter[Refusal] = Counter()
    count = 0
    with open_bag(bag) as source, write_bag(out) as sink:
        sink.add_topic(PREDICTION_TOPIC, ODOMETRY)
        sink.add_topic(PARAMETERS_TOPIC, JOINT_STATE)
        for log_time, _, outcome, frames in replay(source, predictor, progress):
            if not isinstance(outcome, Prediction):
                refusals[outcome] += 1
                continue
            count += 1
            v_x, v_y, omega = outcome.state.tolist()
            covariance = planar_covariance(outcome.variance)
            frame_id, child_frame_id = frames
            message = odometry(
                outcome.stamp, outcome.pose or (0.0, 0.0, 0.0), (v_x, v_y, omega), twist_covariance=covariance,
                frame_id=frame_id, child_frame_id=child_frame_id,
            )  # fmt: skip
            sink.write(PREDICTION_TOPIC, log_time, message)
            if outcome.theta is not None:
                values = dict(zip(COEFFICIENTS, outcome.theta.tolist(), strict=True))
                sink.write(PARAMETERS_TOPIC, log_time, joint_state(outcome.stamp, values, outcome.theta_std))
        if with_inputs:
            copy_topics(source, sink)
            for message in source.messages(list(source.types)):
                sink.write_raw(*message)
        notes = list(source.notes)
    return count, refusals, notes
