"""Work on several processes and on clusters: all of it is done, also if a process dies."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from pathlib import Path

import pytest

from dynssm_ros.errors import ConfigurationError, ProcessDiedError
from dynssm_ros.parallel import HERE, Workers, each

CLUSTERS = [pytest.param(Workers(2, backend), marks=pytest.mark.slow) for backend in ("ray", "dask")]
SEVERAL = [Workers(2), *CLUSTERS]


@pytest.fixture
def squared() -> Callable[[int], int]:
    # functions of this module would be looked for by its name, which the processes do not know
    def squared(number: int) -> int:
        if number < 0:
            raise ConfigurationError(f"{number}: expected a positive number")
        return number**2

    return squared


def name(workers: Workers) -> str:
    return f"{workers.jobs}-{workers.backend}"


@pytest.mark.parametrize("workers", [HERE, *SEVERAL], ids=name)
def test_every_item_has_its_result_and_an_error_is_the_one_that_was_raised(
    squared: Callable[[int], int], workers: Workers
) -> None:
    assert dict(each(squared, range(6), workers)) == {k: k**2 for k in range(6)}
    with pytest.raises(ConfigurationError, match="-1: expected a positive number"):
        list(each(squared, [1, -1, 2], workers))


@pytest.mark.parametrize("workers", SEVERAL, ids=name)
def test_what_a_dead_process_took_along_is_done_again(tmp_path: Path, workers: Workers) -> None:
    mark = tmp_path / "mark"

    def dies_once(number: int) -> int:
        if number == 3 and not mark.exists():
            mark.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return number**2

    assert sorted(each(dies_once, range(8), workers)) == [(k, k**2) for k in range(8)]
    assert mark.exists()


@pytest.mark.parametrize("workers", SEVERAL, ids=name)
def test_what_kills_every_process_is_said(workers: Workers) -> None:
    def dies(number: int) -> int:
        if number == 1:
            os.kill(os.getpid(), signal.SIGKILL)
        return number

    with pytest.raises(ProcessDiedError, match="expected less memory"):
        list(each(dies, range(4), workers))


def test_what_is_no_place_to_work_is_refused() -> None:
    with pytest.raises(ConfigurationError, match="address tcp://there:8786: of no cluster"):
        Workers(address="tcp://there:8786")
    for workers in ((0, "processes", "1"), (1, "ray", "2"), (1, "dask", "2")):
        with pytest.raises(ConfigurationError, match=f"jobs {workers[0]}: expected {workers[2]} or more"):
            Workers(workers[0], workers[1])
