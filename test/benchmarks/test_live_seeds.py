"""`python -m benchmarks.endurance.live_seeds`."""

import pytest

from benchmarks.endurance.live_seeds import Seeded, drive_seeded, words


@pytest.mark.slow
@pytest.mark.parametrize("seed", [22, 23])
def test_drives_that_were_lost_stay_on_the_road(seed):
    """They spun on the patch: no small change of their plans led out of a turn that had become too tight."""
    drive = drive_seeded("orca", seed, 2)
    assert drive.laps == 2
    assert drive.least_room > 0


@pytest.mark.slow
def test_a_drive_depends_on_its_seed_alone(small_model):
    first, again, other = (drive_seeded("orca", seed, 1, small_model) for seed in (1, 1, 2))
    assert first == again
    assert first.least_room != other.least_room
    assert first.laps == 1
    assert first.predictions > 200


def test_the_drives_that_left_the_road_are_named():
    said = words("orca", [Seeded(3, 2, 0.03, 0), Seeded(4, 1, -0.1, 0), Seeded(5, 2, 0.05, 0)])
    assert said.startswith("orca: 1 of 3 drives left the road with seeds 4; least room to the borders -0.1 m")
