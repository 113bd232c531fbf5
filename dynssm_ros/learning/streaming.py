"""Training on more logs than fit into memory: a sample of all of them stays, the rest of each comes and goes.

The sample is the middle of each log, in proportion to its length. What looks at data as a whole is fitted to it: calibration,
scales, online layer; and its validation blocks say which epoch is best. Gradients come from all rows. In every epoch the rest
of the logs is read in another order, as many rows at a time as there is room for, and their windows are shuffled.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import torch
from torch import Tensor

from dynssm_ros.errors import ConfigurationError
from dynssm_ros.files import checksum, content_key
from dynssm_ros.learning.dataset import Digest, TrainingWindows, all_windows
from dynssm_ros.signals.recording import Recording, concatenate, row_count
from dynssm_ros.signals.signal_map import Commands

_SAMPLE_BYTES, _BYTES = (
    600,
    200,
)  # of a row of the sample, with all that is fitted to it, and of one that comes and goes
_LEAST_ROWS = 2000  # of the sample


@dataclass(frozen=True)
class Piece:
    """Rows ``first`` to ``last`` (not included) of a log."""

    file: Path
    first: int
    last: int

    @property
    def rows(self) -> int:
        """How many."""
        return self.last - self.first


class RowStream:
    """Logs of one car that are trained on.

    Args:
        files: the logs' recordings.
        memory: what their rows may take (MB): half for the sample, half for what comes and goes.
        commands: source of the command inputs; the recordings' own if not given.
        holdout: last fraction of each that is left out.

    Raises:
        ConfigurationError: too little memory to fit anything.
    """

    def __init__(
        self, files: Sequence[Path], memory: float, commands: Commands | None = None, holdout: float = 0.0
    ) -> None:
        self.commands = commands
        rows = [count - round(count * holdout) for count in map(row_count, files)]
        kept = int(memory * 1e6 / 2 / _SAMPLE_BYTES)
        if kept < _LEAST_ROWS:
            least = 2 * _LEAST_ROWS * _SAMPLE_BYTES / 1e6
            raise ConfigurationError(f"memory {memory:g} MB: room for {kept} rows; expected at least {least:g} MB")
        self.room = int(memory * 1e6 / 2 / _BYTES)
        share = min(1.0, kept / sum(rows))
        self._middles = [
            Piece(file, round(count * (1 - share) / 2), round(count * (1 + share) / 2))
            for file, count in zip(files, rows, strict=True)
        ]
        ends = [(Piece(m.file, 0, m.first), Piece(m.file, m.last, n)) for m, n in zip(self._middles, rows, strict=True)]
        self.pieces = [part for pair in ends for piece in pair for part in self._cut(piece)]

    def sample(self) -> Recording:
        """The middle of each log, one after the other."""
        return concatenate([self.read(piece) for piece in self._middles])

    def read(self, piece: Piece) -> Recording:
        """The rows of a piece."""
        log = Recording.load(piece.file).with_commands(self.commands)
        return log.select(slice(piece.first, piece.last))

    def windows(self, resident: TrainingWindows, min_speed: float) -> TrainingWindows | StreamedWindows:
        """Windows of the sample, and as long ones of all other rows that are at ``min_speed`` (m/s) or more."""
        if not self.pieces:
            return resident
        counts = [len(all_windows(self.read(piece), resident.H, min_speed)) for piece in self.pieces]
        return StreamedWindows(self, resident, min_speed, tuple(counts))

    def _cut(self, piece: Piece) -> list[Piece]:
        """In parts that there is room for."""
        count = -(-piece.rows // self.room)
        edges = [piece.first + piece.rows * k // count for k in range(count + 1)] if count else []
        return [Piece(piece.file, *edge) for edge in pairwise(edges)]


@dataclass(frozen=True)
class StreamedWindows:
    """Windows of the sample, and of all other rows, which come and go.

    Attributes:
        stream: where rows come from.
        resident: windows of the sample.
        min_speed: of others (m/s).
        counts: windows of each piece of the stream.
    """

    stream: RowStream
    resident: TrainingWindows
    min_speed: float
    counts: tuple[int, ...]

    def __len__(self) -> int:
        return len(self.resident) + sum(self.counts)

    def identify(self, digest: Digest) -> None:
        """Adds what it is to a checksum."""
        self.resident.identify(digest)
        pieces = [(checksum(piece.file), piece.first, piece.last) for piece in self.stream.pieces]
        digest.update(content_key([pieces, self.stream.room, self.stream.commands, self.min_speed]).encode())

    @property
    def mean_increment(self) -> Tensor:
        """As of the sample."""
        return self.resident.mean_increment

    def to(self, device: torch.device) -> StreamedWindows:
        """The same windows on ``device``."""
        return replace(self, resident=self.resident.to(device))

    def epoch(self, draw: torch.Generator, size: int) -> Iterator[tuple[Tensor, Tensor]]:
        """All windows once, in batches: parts of the logs in random order, windows shuffled among those that are there."""
        for windows in self._groups(draw):
            yield from windows.epoch(draw, size)

    def _groups(self, draw: torch.Generator) -> Iterator[TrainingWindows]:
        order = torch.randperm(len(self.stream.pieces), generator=draw).tolist()
        at = int(torch.randint(len(order) + 1, (1,), generator=draw))
        group: list[Piece] = []
        for k, piece in enumerate(self.stream.pieces[n] for n in order):
            if k == at:
                yield self.resident
            if group and sum(each.rows for each in group) + piece.rows > self.stream.room:
                yield self._read(group)
                group = []
            group.append(piece)
        if group:
            yield self._read(group)
        if at == len(order):
            yield self.resident

    def _read(self, group: list[Piece]) -> TrainingWindows:
        rows = concatenate([self.stream.read(piece) for piece in group])
        return all_windows(rows, self.resident.H, self.min_speed).to(self.resident.ends.device)
