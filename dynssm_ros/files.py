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

from dynssm_ros.errors import UserError


@contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """Yields a path beside ``path`` to write a file or folder to; it takes the name of ``path`` on success.

    On an exception what was written aside is removed and ``path`` is as it was.

    Raises:
        UserError: ``path`` cannot be written.
    """
    target = Path(path)
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        scratch = Path(tempfile.mkdtemp(prefix=f".{target.name}.", dir=target.parent))
    except OSError as error:
        raise UserError(f"{target}: cannot be written ({error.strerror}: {error.filename})") from error
    try:
        yield scratch / target.name
        _put(scratch / target.name, target, scratch / "replaced")
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


def _put(aside: Path, target: Path, replaced: Path) -> None:
    """Renames ``aside`` to ``target``; a folder cannot be renamed onto a filled one, so that goes to ``replaced``."""
    try:
        if aside.is_dir() and target.is_dir():
            target.rename(replaced)
        os.replace(aside, target)
    except OSError as error:
        if replaced.exists():
            replaced.rename(target)
        raise UserError(f"{target}: cannot be written ({error.strerror})") from error


def write_json(path: str | Path, content: dict[str, Any]) -> None:
    """Writes ``content`` as indented JSON, atomically; NaN is refused because JSON has none."""
    with replacing(path) as aside:
        aside.write_text(json.dumps(content, indent=2, allow_nan=False) + "\n", encoding="utf-8")
