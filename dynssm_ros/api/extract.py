"""Extraction: race logs to a recording."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from dynssm_ros.api.inputs import PathLike, signal_map_of, warn_of_findings
from dynssm_ros.api.settings import CommandsSettings, StrictSettings, keywords, setting
from dynssm_ros.progress import Progress
from dynssm_ros.signals.recording import Recording
from dynssm_ros.signals.signal_map import SignalMap


class ExtractSettings(CommandsSettings, StrictSettings):
    """Settings of :func:`extract`."""

    rate: float = setting(50.0, "Rate of the uniform time grid (Hz).", ge=1.0, le=1000.0)
    drop_bad: bool = setting(False, "Leave out samples that are not finite or out of order instead of stopping.")


@keywords(ExtractSettings)
def extract(
    bags: PathLike | Sequence[PathLike],
    signals: SignalMap | PathLike = "default",
    *,
    settings: ExtractSettings,
    on_progress: Progress | None = None,
) -> Recording:
    """Turns race logs into a recording: named SI signals on a uniform time grid.

    Args:
        bags: logs, in the order of driving: rosbag2 folders or files, ROS 1 bags, tables (CSV, Parquet, MATLAB, NumPy).
        signals: signal map: which field of which topic, or which column, is which signal.
        settings: all keywords as one object.
        on_progress: called with messages read.

    Signals that cannot be right together are a :class:`~dynssm_ros.errors.DataWarning` each, and in ``info.findings``.

    Raises:
        RecordingError: they cannot, and ``strict`` is set.

    Example:
        >>> recording = extract("laps_bag", rate=50.0)  # doctest: +SKIP
        >>> recording["v_x"].mean()  # doctest: +SKIP
        1.93
    """
    from dynssm_ros.signals.extraction import extract

    several = [bags] if isinstance(bags, (str, Path)) else list(bags)
    signal_map = signal_map_of(signals, settings.commands)
    recording = extract(several, signal_map, settings.rate, drop_bad=settings.drop_bad, progress=on_progress)
    warn_of_findings(recording, strict=settings.strict)
    return recording
