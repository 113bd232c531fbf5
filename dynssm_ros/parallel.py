"""Independent pieces of work on several processes or on a cluster, by joblib: the same results as one after the other."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from contextlib import contextmanager
from dataclasses import dataclass
from operator import itemgetter
from tempfile import TemporaryDirectory
from typing import Any, Literal, TypeVar

from dynssm_ros.errors import ConfigurationError, ProcessDiedError
from dynssm_ros.extras import load_plugins, require

Item = TypeVar("Item")
Result = TypeVar("Result")
Backend = Literal["processes", "ray", "dask"]

_TRIES = 3  # of a piece whose process died, as of one that the system killed for its memory


@dataclass(frozen=True)
class Workers:
    """Where pieces of work are done, and how many at a time.

    Without ``jobs`` it is one in this process, or as many as a cluster has processors. ``address`` is of a cluster that runs
    (Ray's ``auto`` or ``ray://HOST:10001``, Dask's ``tcp://HOST:8786``); if not given, one is started on this machine for
    as long as the work takes. An address of no cluster, or no job, is a :class:`ConfigurationError`.
    """

    jobs: int | None = None
    backend: Backend = "processes"
    address: str | None = None

    def __post_init__(self) -> None:
        if self.backend == "processes" and self.address is not None:
            raise ConfigurationError(f"address {self.address}: of no cluster; expected backend ray or dask with it")
        least = 1 if self.backend == "processes" else 2  # joblib would do the work of one here
        if self.jobs is not None and self.jobs < least:
            raise ConfigurationError(f"jobs {self.jobs}: expected {least} or more with backend {self.backend}")

    @property
    def elsewhere(self) -> bool:
        """Whether another process than this one works."""
        return self.backend != "processes" or self.jobs not in (None, 1)


HERE = Workers()
"""One after the other, in this process."""


class Pool:
    """Workers that are connected, for pieces of work again and again; see :func:`connected`."""

    def __init__(self, workers: Workers = HERE, died: tuple[type[Exception], ...] = ()) -> None:
        self._workers, self._died = workers, died

    def each(self, function: Callable[[Item], Result], items: Sequence[Item]) -> Iterator[tuple[int, Result]]:
        """Places and results of ``function`` on all items, in the order in which they are done; see :func:`each`."""
        if not self._workers.elsewhere or (self._workers.backend == "processes" and len(items) < 2):
            yield from ((k, function(item)) for k, item in enumerate(items))
            return
        from joblib import Parallel, delayed

        left = dict(enumerate(items))
        for _ in range(_TRIES):
            calls = [delayed(_at)(function, k, item) for k, item in left.items()]
            try:
                for k, result in Parallel(return_as="generator_unordered", pre_dispatch="n_jobs")(calls):
                    del left[k]
                    yield k, result
            except self._died:
                continue
            return
        raise ProcessDiedError(
            f"{len(left)} of {len(items)} pieces: a process died in each of {_TRIES} tries; expected less memory per "
            "process than there is (fewer --jobs)"
        )

    def map(self, function: Callable[[Item], Result], items: Sequence[Item]) -> list[Result]:
        """Results of ``function`` in the order of ``items``."""
        return [result for _, result in sorted(self.each(function, items), key=itemgetter(0))]


IN_TURN = Pool()
"""One piece after the other, in this process."""


@contextmanager
def connected(workers: Workers = HERE) -> Iterator[Pool]:
    """Connects to ``workers`` once, for work in many rounds; a :class:`MissingExtraError` without the libraries."""
    if not workers.elsewhere:
        yield IN_TURN
        return
    with _CONNECTED[workers.backend](workers) as died:
        yield Pool(workers, died)


def each(
    function: Callable[[Item], Result], items: Sequence[Item], workers: Workers = HERE
) -> Iterator[tuple[int, Result]]:
    """Places and results of ``function`` on all items, in the order in which they are done.

    For several processes, function, items and results can be pickled. Where a process dies, the pieces that it took along are
    done again, at most twice; then it is a :class:`~dynssm_ros.errors.ProcessDiedError`.
    """
    with connected(workers) as pool:
        yield from pool.each(function, items)


def _at(function: Callable[[Item], Result], place: int, item: Item) -> tuple[int, Result]:
    load_plugins()
    return place, function(item)


# Each makes joblib use the workers within, and gives the errors that mean the death of one.


@contextmanager
def _processes(workers: Workers) -> Iterator[tuple[type[Exception], ...]]:
    require(f"jobs {workers.jobs}", "scale")
    from joblib import parallel_config
    from joblib.externals.loky.process_executor import TerminatedWorkerError

    with parallel_config("loky", n_jobs=workers.jobs):
        yield (TerminatedWorkerError,)


@contextmanager
def _ray(workers: Workers) -> Iterator[tuple[type[Exception], ...]]:
    require("backend ray", "ray")
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # Ray reports its use to its makers otherwise
    import ray
    from joblib import parallel_config, register_parallel_backend
    from ray.util.joblib.ray_backend import RayBackend

    class Streaming(RayBackend):  # type: ignore[misc]
        supports_return_generator = True  # its pool can; joblib's own multiprocessing, which it is made of, cannot

    register_parallel_backend("ray", Streaming)
    again = {"max_restarts": _TRIES - 1, "max_task_retries": _TRIES - 1}
    with TemporaryDirectory(dir="/tmp") as scratch:  # its sockets lie there, and their paths must be short
        local: dict[str, Any] = {"num_cpus": workers.jobs, "include_dashboard": False, "_temp_dir": scratch}
        where = {} if workers.address else local
        ray.init(workers.address or "local", log_to_driver=False, logging_level=logging.CRITICAL, **where)
        try:
            with parallel_config("ray", n_jobs=workers.jobs or -1, ray_remote_args=again):
                yield (ray.exceptions.RayActorError,)
        finally:
            ray.shutdown()


@contextmanager
def _dask(workers: Workers) -> Iterator[tuple[type[Exception], ...]]:
    require("backend dask", "dask")
    from distributed import KilledWorker
    from joblib import parallel_config, register_parallel_backend
    from joblib._dask import DaskDistributedBackend

    class Telling(DaskDistributedBackend):  # type: ignore[misc]
        """joblib's own waits for ever for a piece that the cluster gives up, and does all here if one worker is left."""

        def effective_n_jobs(self, n_jobs: int) -> int:
            return max(2, int(super().effective_n_jobs(n_jobs)))

        def submit(self, func: Any, callback: Callable[[Any], None]) -> Future[Any]:
            future: Future[Any] = super().submit(func, callback)
            future.add_done_callback(lambda done: callback(done) if done.exception() else None)
            return future

        def retrieve_result_callback(self, out: Any) -> Any:
            return out.result() if isinstance(out, Future) else super().retrieve_result_callback(out)

    register_parallel_backend("dask", Telling)
    with _dask_client(workers), parallel_config("dask", n_jobs=workers.jobs or -1):
        yield (KilledWorker,)


@contextmanager
def _dask_client(workers: Workers) -> Iterator[None]:
    """Of the cluster that runs, or of one that is started on this machine."""
    from dask import config
    from distributed import Client, LocalCluster

    if workers.address:
        with Client(workers.address):
            yield
        return
    local = {"n_workers": workers.jobs, "threads_per_worker": 1, "dashboard_address": None}
    with (
        TemporaryDirectory() as scratch,
        config.set({"temporary-directory": scratch}),
        LocalCluster(**local, silence_logs=logging.CRITICAL) as cluster,
        Client(cluster),
    ):
        yield


_CONNECTED = {"processes": _processes, "ray": _ray, "dask": _dask}
