"""A sample of more logs than fit into memory."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from dynssm_ros.errors import ConfigurationError
from dynssm_ros.signals.recording import Recording, concatenate, row_count
from dynssm_ros.signals.signal_map import Commands

_BYTES = 600  # of a row, with all that is fitted to it
_LEAST_ROWS = 2000


def sampled(
    files: Sequence[Path], memory: float, *, commands: Commands | None = None, holdouts: Sequence[float] = ()
) -> Recording:
    """The middle of each recording, one after the other: all rows if they fit, else in proportion to its length.

    Args:
        files: recordings of one car.
        memory: what the rows may take in training (MB).
        commands: source of the command inputs; the recordings' own if not given.
        holdouts: last fraction of each that is left out; of none, if not given.

    Raises:
        ConfigurationError: too little memory to train on.
    """
    kept = int(memory * 1e6 / _BYTES)
    if kept < _LEAST_ROWS:
        least = _LEAST_ROWS * _BYTES / 1e6
        raise ConfigurationError(f"memory {memory:g} MB: room for {kept} rows; expected at least {least:g} MB")
    shares = holdouts or [0.0] * len(files)
    counts = [count - round(count * share) for count, share in zip(map(row_count, files), shares, strict=True)]
    part = min(1.0, kept / sum(counts))
    middles = [slice(round(n * (1 - part) / 2), round(n * (1 + part) / 2)) for n in counts]
    return concatenate(
        [
            Recording.load(file).with_commands(commands).select(middle)
            for file, middle in zip(files, middles, strict=True)
        ]
    )
