"""Work on several processes: all of it is done, also if one of them dies."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from pathlib import Path

import pytest

from dynssm_ros.errors import ProcessDiedError
from dynssm_ros.parallel import each


@pytest.fixture
def squared() -> Callable[[int], int]:
    # functions of this module would be looked for by its name, which the processes do not know
    def squared(number: int) -> int:
        return number**2

    return squared


@pytest.mark.parametrize("jobs", [1, 2])
def test_every_item_has_its_result(squared: Callable[[int], int], jobs: int) -> None:
    assert dict(each(squared, range(6), jobs)) == {k: k**2 for k in range(6)}


def test_what_a_dead_process_took_along_is_done_again(tmp_path: Path) -> None:
    mark = tmp_path / "mark"

    def dies_once(number: int) -> int:
        if number == 3 and not mark.exists():
            mark.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return number**2

    assert sorted(each(dies_once, range(8), 2)) == [(k, k**2) for k in range(8)]
    assert mark.exists()


def test_what_kills_every_process_is_said() -> None:
    def dies(number: int) -> int:
        if number == 1:
            os.kill(os.getpid(), signal.SIGKILL)
        return number

    with pytest.raises(ProcessDiedError, match="a process died in each of 3 tries"):
        list(each(dies, range(4), 2))
