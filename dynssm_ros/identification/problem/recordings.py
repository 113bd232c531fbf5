"""Recordings of one car side by side: which row is of which, which rows only measure, and which are left out together."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from dynssm_ros.arrays import Indices, Mask, Vector
from dynssm_ros.identification import tuning
from dynssm_ros.identification.problem.levels import Group, Levels
from dynssm_ros.identification.problem.windows import RecordedRows, SimulationWindows, rows_per_sample, v_y_variance
from dynssm_ros.signals.recording import Recording, concatenate
from dynssm_ros.track.lap_position import first_lap, lap_context, lap_number, track_position
from dynssm_ros.track.lines import Line


class Folds(NamedTuple):
    """What is left out together, and what counts as one piece of evidence, of each simulation.

    Attributes:
        fold: number of the fit that does not see it, ``(W,)``.
        unit: number of the lap, the quarter or the recording that it belongs to, ``(W,)``; within one fold.
    """

    fold: Indices
    unit: Indices


class CrossValidation(NamedTuple):
    """How simulations are left out in turn.

    Attributes:
        recordings: whole recordings; with fewer than three of them their parts.
        parts: laps, or quarters of the time where there are fewer than three.
        places: the same; where the laps are so few that one part alone has most places, every fourth stretch of
            3 s, so that what acts at a place is predicted by what was driven there before and after.
    """

    recordings: Folds
    parts: Folds
    places: Folds

    @property
    def has_recordings(self) -> bool:
        """Whether whole recordings are left out: there are enough of them."""
        return self.recordings is not self.parts

    @property
    def has_places_once(self) -> bool:
        """Whether one part alone has most places."""
        return self.places is not self.parts


@dataclass(frozen=True)
class RecordingSet:
    """Recordings of one car, one after the other.

    Attributes:
        recording: all rows.
        number: of the recording that each row is of, ``(N,)``.
        names: of the recordings.
        clock: time since the first row of its recording, of each row (s), ``(N,)``.
        held_out: the rows that neither fit nor selection sees, ``(N,)``.
        split: how they were chosen, in words.
        levels: which of them belong together.
        lines: along which places are counted, of each recording; those of one road have the same. ``None``: there is none.
    """

    recording: Recording = field(repr=False)
    number: Indices
    names: tuple[str, ...]
    clock: Vector
    held_out: Mask
    split: str
    levels: Levels
    lines: tuple[Line | None, ...]

    @classmethod
    def of(
        cls, recordings: Sequence[Recording], holdout: float, line: Line | None = None, suspects: Group = (),
        known: Mapping[str, float] | None = None,
    ) -> RecordingSet:  # fmt: skip
        """Joins recordings and holds out the share ``holdout`` at the end of each; whole laps if there are three.

        Args:
            recordings: of one car.
            holdout: share of each.
            line: along which places are counted; ``None``: of each road the first full lap among the fitted rows.
            suspects: numbers of the recordings in which something may have changed.
            known: other shares of some recordings (:attr:`Recording.beginning`), each held out as one block.

        Raises:
            RecordingError: sampling times or command protocols differ, or there is none.
        """
        joined = concatenate(recordings)
        number = np.repeat(np.arange(len(recordings)), [len(one) for one in recordings])
        clock = np.concatenate([(one.time - one.time[0]) / 1e9 for one in recordings])
        cuts = [_cut(one, holdout, (known or {}).get(one.beginning)) for one in recordings]
        held = np.concatenate([np.arange(len(one)) >= cut for one, (cut, _) in zip(recordings, cuts, strict=True)])
        levels = Levels.of(recordings, suspects)
        ends, splits = zip(*cuts, strict=True)
        lines = _first_laps(recordings, ends, levels.road) if line is None else (line,) * len(recordings)
        return cls(joined, number, _names(recordings), clock, held, _in_words(splits), levels, lines)

    @cached_property
    def time(self) -> Vector:
        """Time of each row (s), ``(N,)``: each recording follows the one before, at a multiple of 3 s."""
        longest = [self.clock[self.number == k].max() for k in range(len(self.names))]
        begins = np.cumsum([0.0, *(tuning.BLOCK_S * (np.floor(t / tuning.BLOCK_S) + 1.0) for t in longest[:-1])])
        return np.asarray(begins[self.number] + self.clock)

    @property
    def has_places(self) -> bool:
        """Whether each recording's place on a lap is known."""
        return all(line is not None for line in self.lines)

    @property
    def shares(self) -> dict[str, float]:
        """Share at the end of each recording (:attr:`Recording.beginning`) that is held out."""
        each = ((self._part(k), self.held_out[self.number == k]) for k in range(len(self.names)))
        return {part.beginning: float(held.mean()) for part, held in each}

    def rows(self) -> RecordedRows:
        """As simulations read them, with the place on the lap; ``t`` is the recording's own clock."""
        lines = self.lines if self.has_places else (None,) * len(self.names)
        parts = [lap_context(self._part(k), line) for k, line in enumerate(lines)]
        context = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]} | {"t": self.clock}
        samples, variance = rows_per_sample(self.recording), v_y_variance(self.recording)
        rows, T_s = self.recording.matrix.T, self.recording.T_s
        return RecordedRows(rows, context, T_s, self.time, self.number, samples, variance)

    def _part(self, k: int, rows: Indices | None = None) -> Recording:
        """One of the recordings, or those of its rows that are among ``rows``."""
        chosen = np.flatnonzero(self.number == k) if rows is None else rows[self.number[rows] == k]
        return self.recording.select(chosen)

    def place(self, time: float) -> tuple[str, float]:
        """The recording that is at a :attr:`time`, and its own clock (s) there."""
        row = int(np.argmin(np.abs(self.time - time)))
        return self.names[self.number[row]], float(self.clock[row])

    def left_out(self, starts: Indices) -> CrossValidation:
        """How simulations from the rows ``starts`` are left out: recordings in turn, and parts of each of them in turn."""
        whose, most = self.number[starts], tuning.QUARTERS if len(self.names) > 1 else tuning.MAX_PARTS
        part = np.empty(len(starts), dtype=np.intp)
        for k in np.unique(whose):
            own = starts[whose == k]
            lap = lap_number(self._part(k), self.lines[k])
            passed = None if lap is None else lap[own - int(np.argmax(self.number == k))]
            if passed is not None and np.ptp(passed) + 1 >= tuning.LEAST_PARTS:
                laps, order = np.unique(passed, return_inverse=True)
                part[whose == k] = order * min(most, len(laps)) // len(laps)
            else:
                t = self.clock[own] - self.clock[own[0]]
                part[whose == k] = np.floor(tuning.QUARTERS * t / (np.ptp(t) + 1e-9))
        parts = Folds(*(np.unique(n, return_inverse=True)[1] for n in (part, whose * (part.max() + 1) + part)))
        places = parts
        if self.has_places and not self._passed_again(starts, parts):
            stretch = (self.time[starts] // tuning.BLOCK_S).astype(np.intp) % tuning.QUARTERS
            places = Folds(*2 * (np.unique(stretch, return_inverse=True)[1],))
        if len(np.unique(whose)) < tuning.LEAST_PARTS:
            return CrossValidation(parts, parts, places)
        number = np.unique(whose, return_inverse=True)[1]
        return CrossValidation(Folds(number, number), parts, places)

    def _passed_again(self, starts: Indices, parts: Folds) -> bool:
        """Whether nearly all places of each part of the drive are in another part as well."""
        whose, place = self.number[starts], np.empty(len(starts), dtype=np.intp)
        for k, line in enumerate(self.lines):
            if line is not None:
                s = track_position(line, self._part(k, starts))
                on_lap = np.floor(tuning.LAP_BINS * s / line.length).astype(np.intp) % tuning.LAP_BINS
                place[whose == k] = tuning.LAP_BINS * self.levels.road[k] + on_lap
        there = np.unique(np.stack([place, parts.fold]), axis=1)[0]  # each place once for each part that has it
        return bool(np.mean(np.bincount(there)[place] > 1) >= tuning.NEARLY_ALL)


def driven_alike(windows: SimulationWindows, recordings: Collection[int]) -> float:
    """Share of the simulations of ``recordings`` that the others have at like speed, steering and throttle.

    What only one recording has can be told from what its driving shows only where others were driven alike.
    """
    rows = windows.driven
    driven = np.stack([rows[0], rows[3] + rows[5], rows[4] + rows[6]], axis=1)
    driven /= np.maximum(driven.std(axis=0), 1e-9)
    own = np.isin(windows.number, list(recordings))
    return float(np.mean(cKDTree(driven[~own]).query(driven[own])[0] < tuning.LIKE_SPREADS))


def _first_laps(recordings: Sequence[Recording], cuts: Sequence[int], road: Sequence[int]) -> tuple[Line | None, ...]:
    """Of each recording the first full lap on its road before the rows that are held out."""
    laps: dict[int, Line | None] = {}
    for one, cut, number in zip(recordings, cuts, road, strict=True):
        if laps.get(number) is None:
            laps[number] = first_lap(one.select(np.arange(len(one)) < cut))
    return tuple(laps[number] for number in road)


def _names(recordings: Sequence[Recording]) -> tuple[str, ...]:
    """What each recording is called: its source, with a number where that is not enough."""
    sources = [", ".join(one.info.source) or f"recording {k}" for k, one in enumerate(recordings, 1)]
    return tuple(source if sources.count(source) == 1 else f"{source} ({k})" for k, source in enumerate(sources, 1))


def _in_words(splits: Sequence[str]) -> str:
    """How the rows of one or of several recordings were held out."""
    if len(splits) == 1:
        return splits[0]
    return "of each recording " + (splits[0] if len(set(splits)) == 1 else "in turn: " + "; ".join(splits))


def _cut(recording: Recording, holdout: float, known: float | None = None) -> tuple[int, str]:
    """First held-out row, and in words."""
    if known is not None:
        first = len(recording.split_last(known)[0])
        return first, f"the last {100 * known:.0f} % as one block, as when the vehicle was calibrated"
    N, lap = len(recording), lap_number(recording, first_lap(recording))
    if lap is not None:
        # laps are counted from the first row's place, so that the last full ones are held out
        total = int(lap[-1] - lap[0])
        held = max(1, round(holdout * total))
        cut = int(np.argmax(lap >= lap[-1] - held))
        if total >= tuning.LEAST_PARTS and 0 < cut < N:
            return cut, f"the last {held} of {total} laps and what follows"
    cut = N - max(1, round(holdout * N))
    return cut, f"the last {100 * holdout:.0f} % as one block (fewer than {tuning.LEAST_PARTS} laps)"
