"""Independent pieces of work on several processes, by joblib: the same results as one after the other."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from typing import TypeVar

from dynssm_ros.errors import ProcessDiedError
from dynssm_ros.extras import require

Item = TypeVar("Item")
Result = TypeVar("Result")

_TRIES = 3  # of a piece whose process died, as of one that the system killed for its memory


def each(function: Callable[[Item], Result], items: Sequence[Item], jobs: int = 1) -> Iterator[tuple[int, Result]]:
    """Places and results of ``function`` on all items, in the order in which they are done.

    Where a process dies, the pieces that it took along are done again, at most twice.

    Args:
        function: of one item; for several jobs it can be pickled, as its items and results can.
        items: in the order in which they are begun.
        jobs: processes.

    Raises:
        MissingExtraError: several jobs, and joblib is not installed.
        ProcessDiedError: processes died again and again.
    """
    if jobs == 1 or len(items) < 2:
        yield from ((k, function(item)) for k, item in enumerate(items))
        return
    require(f"--jobs {jobs}", "scale")
    left, tries = dict(enumerate(items)), 0
    while left:
        if tries == _TRIES:
            raise ProcessDiedError(
                f"{len(left)} of {len(items)} pieces: a process died in each of {_TRIES} tries; expected less memory per "
                f"process than there is (fewer --jobs)"
            )
        tries += 1
        for k, result in _until_one_dies(function, dict(left), jobs):
            del left[k]
            yield k, result


def _until_one_dies(
    function: Callable[[Item], Result], items: dict[int, Item], jobs: int
) -> Iterator[tuple[int, Result]]:
    from joblib import Parallel, delayed
    from joblib.externals.loky.process_executor import TerminatedWorkerError

    calls = [delayed(_at)(function, k, item) for k, item in items.items()]
    with suppress(TerminatedWorkerError):
        yield from Parallel(n_jobs=jobs, return_as="generator_unordered", pre_dispatch=jobs)(calls)


def _at(function: Callable[[Item], Result], place: int, item: Item) -> tuple[int, Result]:
    return place, function(item)
