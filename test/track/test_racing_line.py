"""The racing line: what theory says of circles, the borders, and what it gains."""

import numpy as np
import pytest
from scipy import sparse

from dynssm_ros.simulation.laps import simulate
from dynssm_ros.track.layouts import LAYOUTS
from dynssm_ros.track.lines import Line
from dynssm_ros.track.racing_line import border_margin, box_qp, curvature_integral, line_of, racing_line
from dynssm_ros.track.speed_profile import speed_profile
from dynssm_ros.track.tracks import Track, TrackError, load_track
from dynssm_ros.vehicle import load_vehicle
from dynssm_ros.vehicle.limits import vehicle_limits

PUBLISHED = {"ethz": "orca", "ethz_mobil": "orca", "austin": "av21", "ims": "av21"}
BUILT_IN = {name: "orca" if name.startswith("club") else "av21" for name in LAYOUTS}


def ring(direction=1, radius=20.0, half=3.0):
    angle = direction * np.linspace(0, 2 * np.pi, 120, endpoint=False)
    width = np.full(120, half)
    return Track("ring", Line(radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)), width, width)


@pytest.fixture(
    scope="module", params=[*BUILT_IN, "ethz", "ethz_mobil", "ims", pytest.param("austin", marks=pytest.mark.slow)]
)
def raced(request):
    """A track, the margin of its car and the line."""
    if request.param in PUBLISHED:
        track = load_track(request.getfixturevalue("data") / "tracks" / f"{request.param}.csv")
    else:
        track = load_track(request.param)
    vehicle = load_vehicle((BUILT_IN | PUBLISHED)[request.param])
    return vehicle, track, border_margin(vehicle, track), line_of("racing", vehicle, track)


@pytest.mark.parametrize("direction", [1, -1])
def test_on_a_ring_the_line_is_the_largest_circle(direction):
    line = racing_line(ring(direction), 0.5)
    radii = np.hypot(*line.points.T)
    np.testing.assert_allclose(radii, 20 + 3 - 0.5, atol=0.01)
    np.testing.assert_allclose(line.curvature(line.s), direction / 22.5, rtol=0.01)


def test_on_a_ring_strong_tension_takes_the_shortest_circle():
    np.testing.assert_allclose(np.hypot(*racing_line(ring(), 0.5, tension=3.0).points.T), 20 - 3 + 0.5, atol=0.01)


def test_a_wide_ring_is_taken_at_the_curvature_that_the_tension_asks_for():
    line = racing_line(ring(half=12.0), 0.5, tension=0.8)  # of minimal kappa^2 + lambda^2 per turn: kappa = lambda
    np.testing.assert_allclose(np.hypot(*line.points.T), 20 / 0.8, rtol=1e-3)


def test_line_keeps_its_margin_and_bends_less_than_the_centre_line(raced):
    _, track, margin, line = raced
    assert np.min(track.clearance(line.points)) >= margin
    between = line.position(np.linspace(0, line.length, 3 * len(line.points)))
    assert np.min(track.clearance(between)) > 0.85 * margin
    assert curvature_integral(line) < 0.85 * curvature_integral(track.centre)


def test_line_is_closed_even_and_smooth(raced):
    _, track, _, line = raced
    steps = np.hypot(*np.diff(line.points, axis=0, append=line.points[:1]).T)
    np.testing.assert_allclose(steps, line.length / len(steps), rtol=0.01)
    heading = np.unwrap(line.heading(np.linspace(0, line.length, 4000)))
    assert abs(heading[-1] - heading[0]) == pytest.approx(2 * np.pi, abs=1e-6)
    curvature = line.curvature(line.s)
    assert np.max(np.abs(np.diff(curvature, append=curvature[0]))) < 0.25 * np.max(np.abs(curvature))
    start = track.project(line.points[0])[0]
    assert min(start, track.length - start) < 0.02 * track.length


def test_line_is_faster_than_the_centre_line(raced):
    vehicle, track, _, line = raced
    limits = vehicle_limits(vehicle)
    times = [np.sum(np.diff(x.s, append=x.length) / speed_profile(x, limits)) for x in (line, track.centre)]
    assert times[0] < 0.998 * times[1]


def test_line_scales_with_track_and_margin():
    track = load_track("club")
    small, large = racing_line(track, 0.05), racing_line(track.scaled(40.0), 2.0)
    np.testing.assert_allclose(large.points, 40 * small.points, atol=40 * 1e-3)


def test_driver_follows_it_within_the_road():
    orca, club = load_vehicle("orca"), load_track("club")
    laps = {
        kind: simulate(orca, club, laps=1.1, line=line_of(kind, orca, club)).lap_times[0]
        for kind in ("centre", "racing")
    }
    assert laps["racing"] < 0.8 * laps["centre"]


@pytest.mark.parametrize("margin", [0.2, 0.5, -0.1, float("nan")])
def test_road_too_narrow_for_the_margin_is_one_clear_line(margin):
    with pytest.raises(TrackError, match=r"track club is 0.4 m wide at s = .*margin of") as caught:
        racing_line(load_track("club"), margin)
    assert "\n" not in str(caught.value)


def test_box_qp_meets_the_conditions_of_optimality():
    rng = np.random.default_rng(0)
    A = rng.standard_normal((30, 40))  # rank 30: H is only semidefinite
    H, g = A.T @ A, 5 * rng.standard_normal(40)
    lower = -rng.uniform(0.1, 1, 40)
    upper = lower + rng.uniform(0.01, 2, 40)
    x = box_qp(sparse.csc_array(H), g, lower, upper)
    gradient = H @ x + g
    assert np.all((x >= lower) & (x <= upper))
    at_lower, at_upper = x - lower < 1e-6, upper - x < 1e-6
    assert np.all(gradient[at_lower] > -1e-5)
    assert np.all(gradient[at_upper] < 1e-5)
    np.testing.assert_allclose(gradient[~at_lower & ~at_upper], 0, atol=1e-5)
    assert np.sum(at_lower) + np.sum(at_upper) > 5


def test_on_an_open_road_that_a_chord_fits_into_the_line_is_straight():
    angle = np.linspace(0.0, np.radians(20.0), 100)
    arc = Line(100.0 * np.stack([np.cos(angle), np.sin(angle)], axis=1), closed=False)
    road = Track("road", arc, np.full(100, 3.0), np.full(100, 3.0))
    line = racing_line(road, 0.5)
    assert not line.closed
    assert curvature_integral(line) < 0.01 * curvature_integral(arc)
    assert road.clearance(line.points).min() >= 0.5
    assert line.length == pytest.approx(arc.length, rel=0.05)
