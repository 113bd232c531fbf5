"""A training by several processes: each computes the gradient of its share of every batch, Lightning Fabric averages them.

All of them draw the same batches and make the same steps, so that what they train is what one process would, but for the
order in which numbers are added. They talk by gloo on processors and by nccl on GPUs, one GPU each. The gradients are
averaged after the backward pass, and not by hooks within it, since a rollout calls the network several times before.
"""

from __future__ import annotations

import logging
import pickle
import threading
from collections.abc import Callable, Iterable
from typing import Any, TypeVar

import torch
from torch import Tensor

from dynssm_ros.errors import UserError
from dynssm_ros.extras import require
from dynssm_ros.progress import NamedProgress

Result = TypeVar("Result")

logging.getLogger("lightning_fabric").setLevel(logging.ERROR)  # in processes that are begun, which import this after it


class ProcessGroup:
    """The processes of a training; as it stands, this one alone.

    Attributes:
        rank: of this process; the first one writes.
        count: how many there are.
        device: that this process computes on; ``None``: as it likes.
    """

    rank, count = 0, 1
    device: torch.device | None = None

    def share(self, rows: Tensor) -> Tensor:
        """Those rows of a batch that are for this process; all if there are fewer than processes."""
        return rows if self.count == 1 or len(rows) < self.count else rows[self.rank :: self.count]

    def weight(self, rows: int) -> float:
        """By which the mean over the own share counts, for the mean over the processes to be that over the batch."""
        own = len(range(self.rank, rows, self.count))
        return 1.0 if self.count == 1 or rows < self.count else self.count * own / rows

    def average_gradients(self, parameters: Iterable[Tensor]) -> None:
        """Gives each parameter the mean of the processes' gradients."""

    def average(self, values: dict[str, float]) -> dict[str, float]:
        """The mean of each value over the processes."""
        return values


class FabricProcessGroup(ProcessGroup):
    """Processes that Fabric has begun."""

    def __init__(self, fabric: Any) -> None:
        self._fabric = fabric
        self.rank, self.count, self.device = fabric.global_rank, fabric.world_size, fabric.device

    def average_gradients(self, parameters: Iterable[Tensor]) -> None:
        """As above, in one message."""
        gradients = [parameter.grad for parameter in parameters if parameter.grad is not None]
        mean = self._fabric.all_reduce(torch.cat([each.flatten() for each in gradients]), reduce_op="mean")
        for gradient, part in zip(gradients, mean.split([each.numel() for each in gradients]), strict=True):
            gradient.copy_(part.view_as(gradient))

    def average(self, values: dict[str, float]) -> dict[str, float]:
        """As above, in one message."""
        own = torch.tensor(list(values.values()), dtype=torch.float64, device=self._fabric.device)
        mean = self._fabric.all_reduce(own, reduce_op="mean")
        return dict(zip(values, mean.tolist(), strict=True))


def run_in_processes(
    count: int,
    device: torch.device,
    progress: NamedProgress | None,
    function: Callable[[ProcessGroup, NamedProgress, Any], Result],
    what: Any,
) -> Result:
    """Calls ``function`` with the group, a progress and ``what`` in ``count`` processes; returns what the first one does.

    Args:
        count: processes.
        device: ``cpu`` or ``cuda``; of the latter each process has one.
        progress: called here with what the first process tells.
        function: of a module, so that it can be sent; its errors come back as text.
        what: can be pickled.

    Raises:
        UserError: a process was killed or has failed.
        MissingExtraError: Fabric is not installed.
    """
    require("--processes", "processes")
    from lightning_fabric import Fabric
    from lightning_fabric.strategies.ddp import DDPStrategy
    from torch.multiprocessing.spawn import ProcessException

    told: Any = torch.multiprocessing.get_context("spawn").SimpleQueue()
    results: list[Result] = []
    listener = threading.Thread(target=_listen, args=(told, progress, results), daemon=True)
    listener.start()
    fabric = Fabric(accelerator=device.type, devices=count, strategy=DDPStrategy(start_method="spawn"))
    try:
        member: Any = _member  # Fabric's types leave out what it hands on
        fabric.launch(member, function, pickle.dumps(what), told)  # by value: tensors would be shared, weights too
    except ProcessException as error:
        reason = str(error).strip().splitlines()[-1]
        raise UserError(f"training in {count} processes: {reason}; the same command continues") from error
    finally:
        told.put(None)
        listener.join()
    return results[0]


def _listen(told: Any, progress: NamedProgress | None, results: list[Any]) -> None:
    """Until ``None``: progress is a tuple; the result comes as bytes, for memory that is shared ends with its process."""
    while (news := told.get()) is not None:
        if isinstance(news, bytes):
            results.append(pickle.loads(news))  # noqa: S301 - from a process of ours
        elif progress is not None:
            progress(*news)


def _member(fabric: Any, function: Callable[[ProcessGroup, NamedProgress, Any], Any], what: bytes, told: Any) -> None:
    """What each process does."""
    torch.set_num_threads(1)
    group = FabricProcessGroup(fabric)
    try:
        result = function(group, lambda *news: told.put(news) if group.rank == 0 else None, pickle.loads(what))  # noqa: S301
    finally:
        torch.distributed.destroy_process_group()  # its threads, if they outlive the interpreter, abort the process
    if group.rank == 0:
        told.put(pickle.dumps(result))
