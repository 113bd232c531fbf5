"""One door for logs: bags of ROS 2 and ROS 1, and tables."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from dynssm_ros.signals.bags import STORAGE_SUFFIXES, Bag, bag_suffix, open_bag
from dynssm_ros.signals.tables import LogTable, open_table

_BAGS = (*STORAGE_SUFFIXES, ".bag", ".zstd")  # of files that may be damaged from their first byte on


@contextmanager
def open_log(path: str | Path) -> Iterator[Bag | LogTable]:
    """Opens a log; what it is follows from its content, and from its name where that is damaged.

    Raises:
        BagError: nothing there, neither a bag nor a table, or nothing to recover.
        MissingExtraError: a MATLAB file, and there is no scipy.
    """
    path = Path(path)
    if os.path.isfile(path) and bag_suffix(path) is None and path.suffix not in _BAGS:
        yield open_table(path)
    else:
        with open_bag(path) as bag:
            yield bag
