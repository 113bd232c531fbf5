"""What the animation of a race says beside the cars."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

from dynssm_ros.api import race
from dynssm_ros.reporting import animation
from dynssm_ros.reporting.animation import _changed_stretch, _most_changed, _planned

PATCH = {"grip_patch": {"factor": 0.8, "centre": 0.5, "length": 0.3}}


@pytest.fixture(scope="module")
def races():
    models = ["true", "single_track"]
    return race("orca", "club", models, plant="euler", line="centre", speed_scale=0.6, effects=PATCH)


def test_the_stretch_on_which_the_car_is_another_is_marked(races):
    marked, track = _changed_stretch(races[0], *_most_changed(races[0])), races[0].course.track
    assert marked.mean() == pytest.approx(0.3, abs=0.05)
    assert np.median(track.centre.s[marked]) == pytest.approx(0.5 * track.length, rel=0.05)


def test_belief_is_shown_against_what_is_true(races):
    name, truth = _most_changed(races[0])
    nominal = races[0].course.vehicle.coefficients[name].nominal
    assert name in ("D_f", "D_r")
    assert np.nanmin(truth) == pytest.approx(0.8 * nominal, rel=1e-3)  # its ends are smooth
    np.testing.assert_array_equal(_planned(races[0], name), truth)
    assert set(_planned(races[1], name)) == {nominal}
    (healthy,) = race("orca", "club", ["true"], plant="euler", line="centre", speed_scale=0.6)
    assert not _changed_stretch(healthy, *_most_changed(healthy)).any()
    assert set(_most_changed(healthy)[1]) == {healthy.course.vehicle.coefficients["D_f"].nominal}


def test_it_has_as_many_frames_as_are_allowed_where_the_drive_has_more(races, tmp_path, monkeypatch):
    assert animation.FRAMES == 120
    monkeypatch.setattr(animation, "FRAMES", 12)  # each takes half a second
    animation.animate(races, tmp_path / "race.gif")
    with Image.open(tmp_path / "race.gif") as image:
        assert image.n_frames == 12
