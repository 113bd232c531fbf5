"""Centre lines as people have them: repeats, rounding, overlap are mended; open roads and reversals are refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from dynssm_ros.arrays import Vector
from dynssm_ros.track.centre_points import mended
from dynssm_ros.track.tracks import Track, TrackError, load_track, read_track

CLUB = load_track("club")
ROWS = np.column_stack([CLUB.centre.points, CLUB.width_right, CLUB.width_left])


def sharpest(track: Track) -> float:
    return float(np.abs(track.centre.curvature(np.linspace(0, track.length, 20000))).max())


def read(path: Path, rows: Vector, digits: int = 6) -> Track:
    file = path / "track.csv"
    file.write_text("".join(",".join(f"{value:.{digits}f}" for value in row) + "\n" for row in rows))
    return read_track(file)


def moved(k: int, by: tuple[float, float]) -> Vector:
    row = ROWS[k].copy()
    row[:2] += by
    return row


def test_a_good_file_is_taken_as_it_is(tmp_path: Path) -> None:
    track = read(tmp_path, ROWS)
    assert track.notes == ()
    np.testing.assert_allclose(track.centre.points, CLUB.centre.points, atol=1e-6)
    assert mended(ROWS).table is not None


@pytest.mark.parametrize(
    "rows",
    [
        np.vstack([ROWS, moved(0, (1e-3, 5e-4))]),
        np.vstack([ROWS, moved(0, (-1e-3, 0.0))]),
        np.vstack([ROWS, moved(0, (1e-6, 0.0))]),
        np.vstack([ROWS, ROWS[:1]]),
        np.insert(ROWS, 131, moved(130, (1e-4, 1e-4)), 0),
        np.insert(ROWS, 131, [ROWS[130]] * 3, 0),
    ],
    ids=["1 mm before the first", "1 mm behind it", "1 um", "the first again", "twice, nearly", "three times"],
)
def test_points_that_nearly_repeat_are_left_out_with_a_note(tmp_path: Path, rows: Vector) -> None:
    track = read(tmp_path, rows)
    assert len(track.centre.points) == len(ROWS)
    assert sharpest(track) == pytest.approx(sharpest(CLUB), rel=1e-2)
    assert track.length == pytest.approx(CLUB.length, rel=1e-4)
    (note,) = track.notes
    assert f"{len(rows) - len(ROWS)} points nearer than 0.003" in note


def test_a_dense_line_is_thinned_and_remains_the_track(tmp_path: Path) -> None:
    s = np.arange(0.0, CLUB.length, 5e-4)
    rows = np.column_stack([CLUB.centre.position(s, np.zeros(len(s))), np.full((len(s), 2), 0.2)])
    track = read(tmp_path, rows)
    assert len(track.centre.points) < 0.06 * len(rows)
    assert "of the road's half width" in track.notes[0]
    assert np.abs(CLUB.project(track.centre.points)[1]).max() < 1e-5
    assert sharpest(track) == pytest.approx(sharpest(CLUB), rel=0.02)


def test_coordinates_far_from_their_origin_are_not_taken_for_rounded(tmp_path: Path) -> None:
    """As those of UTM, which have seven digits before the point."""
    track = read(tmp_path, np.add(ROWS, [691_000.0, 5_335_000.0, 0.0, 0.0]))
    assert track.notes == ()
    assert sharpest(track) == pytest.approx(sharpest(CLUB), rel=1e-3)


@pytest.mark.parametrize("count", [1, 5, 20])
def test_a_lap_recorded_a_little_too_long_ends_where_it_began(tmp_path: Path, count: int) -> None:
    over = CLUB.centre.position(np.arange(count) * 0.03 + 0.014, 0.01)
    track = read(tmp_path, np.vstack([ROWS, np.column_stack([over, np.full((count, 2), 0.2)])]))
    assert len(track.centre.points) == len(ROWS)
    assert sharpest(track) == pytest.approx(sharpest(CLUB), rel=1e-2)
    assert f"the last {count} points" in track.notes[0]


@pytest.mark.parametrize("shift", [0.0, 0.0037, 0.0061])
@pytest.mark.parametrize(("digits", "sharper"), [(2, 1.4), (3, 1.1)])
def test_rounded_coordinates_are_smoothed_within_the_rounding(
    tmp_path: Path, digits: int, sharper: float, shift: float
) -> None:
    """To the centimetre the plain spline through the points has a curvature of 66 1/m where the track has 3.3."""
    track = read(tmp_path, np.add(ROWS, [shift, shift, 0.0, 0.0]), digits)
    assert sharpest(track) < sharper * sharpest(CLUB)
    assert track.length == pytest.approx(CLUB.length, rel=2e-3)
    away = np.abs(CLUB.project(track.centre.points - shift)[1])
    assert away.max() < 10.0**-digits
    assert f"rounded to {10.0**-digits:g} m" in track.notes[0]


def test_rounding_that_does_not_bend_the_line_changes_nothing() -> None:
    course = load_track("road_course")
    rows = np.column_stack([course.centre.points, course.width_right, course.width_left]).round(2)
    assert mended(rows).notes == ()
    np.testing.assert_array_equal(mended(rows).table, rows)


@pytest.mark.parametrize("name", ["ethz", "ethz_mobil", "austin", "ims"])
def test_published_tracks_are_taken_as_they_are(data: Path, name: str) -> None:
    assert load_track(data / "tracks" / f"{name}.csv").notes in {
        (), ("1 points nearer than 0 m to the one before left out (0.1 of the usual spacing)",)
    }  # fmt: skip


@pytest.mark.parametrize("last", [60, 250, 370])
def test_an_open_road_is_one_says_so_and_is_no_lap(tmp_path: Path, last: int) -> None:
    """It ends at its last point; no straight closes it."""
    road = read(tmp_path, ROWS[:last])
    assert not road.centre.closed
    assert road.length == pytest.approx(float(np.hypot(*np.diff(ROWS[:last, :2], axis=0).T).sum()), rel=1e-3)
    assert road.notes[-1].startswith("an open road: its end is ")
    with pytest.raises(TrackError, match=r"^track track: an open road of .* expected a closed lap$"):
        road.scaled(2.0).require_closed()


def test_a_rounded_open_road_is_smoothed(tmp_path: Path) -> None:
    rows = ROWS[:250].copy()
    rows[:, :2] = np.round(rows[:, :2], 2)
    road, fine = read(tmp_path, rows), read(tmp_path, ROWS[:250])
    assert len(road.notes) == 2
    assert np.abs(road.centre.curvature(road.centre.s)).max() < 1.5 * np.abs(fine.centre.curvature(fine.centre.s)).max()


@pytest.mark.parametrize(
    "rows",
    [ROWS[np.r_[0:100, 99:59:-1, 60 : len(ROWS)]], ROWS[np.r_[0:50, 51, 50, 52 : len(ROWS)]]],
    ids=["drives back a stretch", "two points swapped"],
)
def test_a_line_that_turns_back_is_refused_by_place(tmp_path: Path, rows: Vector) -> None:
    with pytest.raises(
        TrackError, match=r"its line turns by 1\d\d degrees from one point to the next at x = "
    ) as caught:
        read(tmp_path, rows)
    assert "\n" not in str(caught.value)
