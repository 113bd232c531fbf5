"""Outputs are written aside and renamed: a kill leaves the old file or the new one, never half of one."""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any


@contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """Yields a path beside ``path`` to write a file or folder to; it takes the name of ``path`` on success.

    On an exception what was written aside is removed and ``path`` is as it was.
    """
    target = Path(path)
    target.parent.mkdir(parents=True, exist_ok=True)
    scratch = Path(tempfile.mkdtemp(prefix=f".{target.name}.", dir=target.parent))
    aside = scratch / target.name
    try:
        yield aside
        if aside.is_dir() and target.is_dir():  # a folder cannot be renamed onto a filled one
            target.rename(scratch / "replaced")
        os.replace(aside, target)
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


def write_json(path: str | Path, content: dict[str, Any]) -> None:
    """Writes ``content`` as indented JSON, atomically; NaN is refused because JSON has none."""
    with replacing(path) as aside:
        aside.write_text(json.dumps(content, indent=2, allow_nan=False) + "\n", encoding="utf-8")
