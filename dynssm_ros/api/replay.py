"""Replay: what the node would have published for a bag."""

from __future__ import annotations

import os
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

from dynssm_ros.api.inputs import PathLike, signal_map_of
from dynssm_ros.api.settings import VerbSettings, keywords, setting
from dynssm_ros.progress import Progress
from dynssm_ros.signals.signal_map import SignalMap

if TYPE_CHECKING:
    from dynssm_ros.signals.history import Refusal


class ReplaySettings(VerbSettings):
    """Settings of :func:`replay`."""

    with_inputs: bool = setting(False, "Also copy the topics of the bag, to look at them together.")
    max_age: float = setting(0.2, "Oldest actuator sample that a prediction may rest on (s).", ge=0.0)
    online: bool = setting(True, "Whether the model's online layer learns and corrects.", option="--online/--offline")
    online_state: Path | None = setting(
        None, "File of what the online layer has learned: read first if it is there, and written at the end."
    )


@keywords(ReplaySettings)
def replay(
    bag: PathLike,
    model: PathLike,
    out: PathLike,
    signals: SignalMap | PathLike = "default",
    *,
    settings: ReplaySettings,
    on_progress: Progress | None = None,
) -> tuple[int, Counter[Refusal], list[str]]:
    """Predicts offline what the node would have published for a bag, into a new bag.

    Args:
        bag: what was recorded.
        model: model folder.
        out: the new bag.
        signals: signal map: which topic and field is which signal.
        settings: all keywords as one object.
        on_progress: called with messages read.

    Returns:
        The number of predictions, the refusals by reason, and notes on a bag that had to be recovered.

    Example:
        >>> replay("laps_bag", "model", "predictions")  # doctest: +SKIP
        (995, Counter({<Refusal.FILLING: ...>: 5}), [])
    """
    from dynssm_ros.runtime.artifact import open_artifact
    from dynssm_ros.runtime.onnx_model import OnnxModel
    from dynssm_ros.runtime.predictor import Predictor
    from dynssm_ros.runtime.replay import replay_to_bag

    s, signal_map = settings, signal_map_of(signals)
    predictor = Predictor(OnnxModel(open_artifact(model)), signal_map, max_age=s.max_age, online=s.online)
    if s.online_state is not None and os.path.exists(s.online_state):
        predictor.load_online(s.online_state)
    outcome = replay_to_bag(Path(bag), predictor, Path(out), with_inputs=s.with_inputs, progress=on_progress)
    if s.online_state is not None:
        predictor.online_writer(s.online_state)()
    return outcome
