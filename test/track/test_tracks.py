"""Built-in tracks and the racetrack-database reader."""

from pathlib import Path

import numpy as np
import pytest

from dynssm_ros.track.layouts import LAYOUTS, MILE, Corner, Straight, closed_loop
from dynssm_ros.track.tracks import Track, TrackError, load_track, read_track


@pytest.fixture(params=sorted(LAYOUTS))
def track(request) -> Track:
    return load_track(request.param)


def test_built_in_tracks_close_without_a_kink(track):
    points = track.centre.points
    seam = points[0] - points[-1]
    spacing = track.length / len(points)
    assert np.hypot(*seam) == pytest.approx(spacing, rel=0.2)
    assert np.arctan2(seam[1], seam[0]) == pytest.approx(0.0, abs=1e-9)  # the layout starts along x
    heading = np.unwrap(track.centre.heading(np.linspace(0, track.length, 5000)))
    assert abs(heading[-1] - heading[0]) == pytest.approx(2 * np.pi, abs=1e-6)


def test_curvature_of_built_in_tracks_has_no_jumps(track):
    curvature = track.centre.curvature(np.linspace(0, track.length, 20000))
    assert np.max(np.abs(np.diff(curvature))) < 0.01 * np.max(np.abs(curvature))


def test_oval_has_the_public_dimensions():
    oval = load_track("oval")
    assert oval.length == pytest.approx(2.5 * MILE, rel=1e-4)
    curvature = oval.centre.curvature(np.linspace(0, oval.length, 20000))
    assert np.max(curvature) == pytest.approx(np.pi / 2 / (MILE / 4), rel=1e-3)  # quarter-mile quarter turns
    arcs = np.flatnonzero(np.diff((curvature > 0.5 * np.max(curvature)).astype(int)) == 1)
    assert len(arcs) == 4


def test_car_of_its_size_can_follow_each_track(track):
    curvature = track.centre.curvature(np.linspace(0, track.length, 5000))
    half_width = max(track.width_left[0], track.width_right[0])
    assert np.max(np.abs(curvature)) * half_width < 0.75  # borders do not fold
    assert (track.name == "oval") == bool(np.min(curvature) > -0.01 * np.max(curvature))  # all others turn both ways


CORNER = Corner(90, 4.0)


def test_open_straights_take_the_lengths_that_close_the_loop():
    sides = (Straight(5.0), CORNER, Straight(None), CORNER, Straight(10.0), CORNER, Straight(10.0), CORNER)
    square = closed_loop((*sides, Straight(None)), 0.1)
    extent = np.ptp(square, axis=0)
    assert extent[0] == pytest.approx(extent[1], abs=1e-9)  # four equal corners and sides
    assert len(square) * 0.1 == pytest.approx(40 + 4 * CORNER.length, rel=0.01)


@pytest.mark.parametrize(
    ("segments", "complaint"),
    [
        ((Straight(None), CORNER, Straight(None)), "add up to 90"),
        ((Straight(1.0), *4 * (CORNER,), Straight(None)), "1 straights have no length"),
        ((Straight(None), CORNER, CORNER, Straight(None), CORNER, CORNER), "parallel"),
        (
            (
                Straight(9.0),
                CORNER,
                Straight(None),
                CORNER,
                Straight(1.0),
                CORNER,
                Straight(1.0),
                CORNER,
                Straight(None),
            ),
            "needs a straight of -8 m at segment 8",
        ),
    ],
)
def test_layouts_that_cannot_close_say_why(segments, complaint):
    with pytest.raises(ValueError, match=complaint):
        closed_loop(segments, 0.1)


def test_scaling_scales_lengths_widths_and_radii():
    full, small = load_track("road_course"), load_track("road_course").scaled(0.1)
    assert small.length == pytest.approx(0.1 * full.length)
    np.testing.assert_allclose(small.width_left, 0.1 * full.width_left)
    assert small.centre.curvature(30.0) == pytest.approx(10 * full.centre.curvature(300.0))
    with pytest.raises(TrackError, match="expected a positive number"):
        full.scaled(0.0)


def test_clearance_is_the_distance_to_the_nearer_border():
    club = load_track("club")
    points = club.centre.position(np.array([1.0, 5.0, 9.0]), np.array([0.0, 0.15, -0.25]))
    np.testing.assert_allclose(club.clearance(points), [0.2, 0.05, -0.05], atol=1e-8)


def write_csv(path: Path, rows, header: str = "# x_m,y_m,w_tr_right_m,w_tr_left_m\n") -> Path:
    path.write_text(header + "".join(",".join(str(value) for value in row) + "\n" for row in rows))
    return path


def ring(count: int = 40, radius: float = 20.0, right: float = 3.0, left: float = 2.0) -> list[list[float]]:
    angle = np.linspace(0, 2 * np.pi, count, endpoint=False)
    return [[radius * np.cos(a), radius * np.sin(a), right, left] for a in angle]


def eight() -> list[list[float]]:
    angle = np.linspace(0, 2 * np.pi, 80, endpoint=False)
    return [[50 * np.sin(a), 25 * np.sin(2 * a), 2.0, 2.0] for a in angle]


def test_csv_round_trip_keeps_sides(tmp_path):
    track = load_track(write_csv(tmp_path / "ring.csv", ring()))
    assert track.name == "ring"
    assert np.hypot(*track.right_border[0]) == pytest.approx(23.0, abs=1e-3)  # counter-clockwise: right is outside
    assert np.hypot(*track.left_border[0]) == pytest.approx(18.0, abs=1e-3)
    right, left = track.widths(7.0)
    assert (right, left) == (3.0, 2.0)


def test_repeated_first_point_is_left_out(tmp_path):
    rows = ring()
    closed = read_track(write_csv(tmp_path / "closed.csv", [*rows, rows[0]]))
    assert len(closed.centre.points) == len(rows)


@pytest.mark.parametrize(
    ("rows", "complaint"),
    [
        (ring(9), "9 points; expected at least 10"),
        ([], "0 points; expected at least 10"),
        ([*ring()[:5], [*ring()[5][:2], 0.0, 2.0], *ring()[6:]], "width_right at point 5 is 0 m"),
        ([*ring()[:5], [*ring()[5][:2], 1.0, -2.0], *ring()[6:]], "width_left at point 5 is -2 m"),
        ([*ring()[:5], [1.0, 2.0, 1.0], *ring()[6:]], "line 7: 3 values; expected 4"),
        ([*ring()[:5], [1.0, "far", 1.0, 1.0], *ring()[6:]], "line 7: '1.0,far,1.0,1.0'; expected four numbers"),
        ([*ring()[:5], [1.0, "nan", 1.0, 1.0], *ring()[6:]], "line 7: .* expected finite numbers"),
        (
            [*ring()[:5], [1.0, -1e308, 1.0, 1.0], *ring()[6:]],
            "line 7: .* expected finite numbers of at most 1e\\+09 m",
        ),
        (eight(), "borders cross near"),
        ([[x, y, 0.0, 0.0] for x, y, _, _ in ring()], "width_right at point 0 is 0 m"),
        ([[x, y, -2.0, 2.0] for x, y, _, _ in ring()], "width_right at point 0 is -2 m"),
        ([ring()[0]] * 40, "points 0 and 1 are the same"),
        ([[1e3 * x, 1e3 * y, w, v] for x, y, w, v in ring()], "long where it is .* wide: x_m, y_m in mm or cm"),
        ([[1e-5 * x, 1e-5 * y, w, v] for x, y, w, v in ring()], "x_m, y_m in degrees, or km"),
        ([[1e3 * each for each in row] for row in ring()], "width_right is up to .* m: in mm or cm"),
        (ring(left=21.0), "borders cross: the left border runs backwards along 100% of the lap"),
    ],
)
def test_malformed_tracks_are_refused_in_one_line(tmp_path, rows, complaint):
    path = write_csv(tmp_path / "bad.csv", rows)
    with pytest.raises(TrackError, match=complaint) as caught:
        read_track(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("header", ["# x_m;y_m;w_tr_right_m;w_tr_left_m\n", "x_m;y_m;w_tr_right_m;w_tr_left_m\n", ""])
@pytest.mark.parametrize("between", [";", "\t", " ", "; "])
def test_cells_are_apart_as_people_have_them(tmp_path, header, between):
    text = header + "".join(between.join(f"{each:.6f}" for each in row) + "\r\n" for row in ring())
    (tmp_path / "track.csv").write_bytes(b"\xef\xbb\xbf" + text.replace(";", between).encode())
    np.testing.assert_allclose(read_track(tmp_path / "track.csv").centre.points, [row[:2] for row in ring()], atol=1e-6)


def test_neighbouring_stretches_that_overlap_are_refused(tmp_path):
    angle = np.linspace(0, 2 * np.pi, 300, endpoint=False)
    radius = 20 * (1 - 0.75 * np.exp(-(((angle - np.pi) / 0.25) ** 2)))  # a deep narrow bay
    rows = [[r * np.cos(a), r * np.sin(a), 4.5, 4.5] for r, a in zip(radius, angle, strict=True)]
    with pytest.raises(TrackError, match="borders cross"):
        read_track(write_csv(tmp_path / "bay.csv", rows))


def test_other_columns_and_unknown_names_are_refused(tmp_path):
    path = write_csv(tmp_path / "raceline.csv", ring(), header="# s_m,x_m,y_m,v_mps\n")
    with pytest.raises(TrackError, match=r"columns s_m,x_m,y_m,v_mps; expected x_m,y_m,w_tr_right_m,w_tr_left_m"):
        read_track(path)
    with pytest.raises(TrackError, match=r"neither a file nor a built-in name .*club.*oval"):
        load_track("nowhere")


@pytest.mark.parametrize(
    ("name", "length"), [("ethz", 17.84), ("ethz_mobil", 12.85), ("austin", 5507.5), ("ims", 4022.3)]
)
def test_published_tracks_load(data, name, length):
    assert load_track(data / "tracks" / f"{name}.csv").length == pytest.approx(length, rel=1e-3)


@pytest.mark.parametrize(("name", "length"), [("austin", 401.0), ("ims", 291.0)])
def test_published_full_size_tracks_scale_to_the_lengths_of_the_literature(data, name, length):
    full = load_track(data / "tracks" / f"{name}.csv")
    small = full.scaled(length / full.length)
    assert small.length == pytest.approx(length, rel=1e-9)
    np.testing.assert_allclose(small.width_left / full.width_left, length / full.length)
