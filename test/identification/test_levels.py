"""Recordings of one road, and of one session."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dynssm_ros.identification.problem.car import CarEstimate
from dynssm_ros.identification.problem.fit import IdentificationProblem
from dynssm_ros.identification.problem.levels import Levels
from dynssm_ros.identification.problem.recordings import RecordingSet
from dynssm_ros.identification.problem.windows import fit_windows
from dynssm_ros.identification.search.candidates import candidates
from dynssm_ros.signals.recording import Recording
from dynssm_ros.simulation.laps import as_recording, simulate
from dynssm_ros.track.tracks import load_track
from dynssm_ros.vehicle import load_vehicle

ORCA = load_vehicle("orca")


def driven(track: str, hour: float, seed: int) -> Recording:
    """A drive that begins at an hour."""
    recording = as_recording(simulate(ORCA, load_track(track), duration=20.0, seed=seed))
    return replace(recording, time=recording.time - recording.time[0] + np.int64(hour * 3600e9))


def reversed_path(recording: Recording) -> Recording:
    """The same path, driven the other way round."""
    turned = {"x": recording["x"][::-1], "y": recording["y"][::-1], "theta": recording["theta"][::-1] + np.pi}
    return replace(recording, columns=dict(recording.columns) | turned)


@pytest.fixture(scope="module")
def season() -> list[Recording]:
    """Two drives on one day on one track, and on another day one there and one elsewhere."""
    return [driven("club", 0.0, 1), driven("club", 1.0, 2), driven("club", 24.0, 3), driven("club_b", 25.0, 4)]


def test_a_season_has_sessions_and_roads(season: list[Recording]) -> None:
    levels = Levels.of(season)
    assert levels.session == (0, 0, 1, 1)
    assert levels.road == (0, 0, 0, 1)
    assert levels.groups == ((0,), (1,), (2,), (3,), (0, 1), (2, 3), (0, 1, 2))
    names = [levels.level(group) for group in ((), (1,), (0, 1), (2, 3), (0, 1, 2))]
    assert names == ["car", "recording", "session", "session", "road"]
    assert [levels.has_one_road(group) for group in ((), (0, 1), (2, 3), (3,))] == [False, True, False, True]


def test_whatever_the_order_of_the_recordings(season: list[Recording]) -> None:
    levels = Levels.of([season[k] for k in (3, 0, 2, 1)])
    assert levels.session == (0, 1, 0, 1)
    assert levels.road == (0, 1, 1, 1)


def test_the_same_laps_the_other_way_round_are_another_road(season: list[Recording]) -> None:
    assert Levels.of([season[0], reversed_path(season[0])]).road == (0, 1)


def test_suspects_are_the_only_group(season: list[Recording]) -> None:
    levels = Levels.of(season, (2, 3))
    assert levels.groups == ((2, 3),)
    assert levels.level((2, 3)) == "suspects"


def test_one_recording_is_of_the_car(season: list[Recording]) -> None:
    assert Levels.of(season[:1]) == Levels()


def test_what_acts_at_a_place_acts_on_one_road_alone(season: list[Recording]) -> None:
    together = RecordingSet.of(season, 0.25)
    windows = fit_windows(together.recording, together.rows(), 0.4, 0.0, together.held_out)
    found, _ = candidates(
        IdentificationProblem(windows, CarEstimate.of(ORCA)), CarEstimate.of(ORCA), (), together.levels
    )
    where = {candidate.only_in for candidate in found if candidate.by_place}
    assert where == {(0,), (1,), (2,), (3,), (0, 1), (0, 1, 2)}
    assert {candidate.only_in for candidate in found} == {(), *together.levels.groups}
