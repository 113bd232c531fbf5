"""Outputs are written aside and renamed: a kill leaves the old file or the new one, never half of one.

An output never replaces an input of the same command, nor lies inside one, nor replaces a log or what is neither file
nor folder.
"""

from __future__ import annotations

import ctypes
import errno
import hashlib
import json
import os
import shutil
import socket
import stat
import tempfile
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import Any

from dynssm_ros.errors import UserError

LOG_SUFFIXES = (".mcap", ".db3", ".bag", ".zstd")
"""Of files that recorders write, and we do not."""
# what writers of libraries raise where the disk is full, a quota is used up, or a file may not be as large
_NO_ROOM = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}
_CHUNK = 1 << 20  # bytes of a file that are summed at once
_HERE, _SWAP = -100, 2  # AT_FDCWD and RENAME_EXCHANGE of Linux
_INPUTS: ContextVar[tuple[Path, ...]] = ContextVar("inputs", default=())
_FORCED: ContextVar[bool] = ContextVar("forced", default=False)


@contextmanager
def protecting(inputs: Collection[Path], force: bool = False) -> Iterator[None]:
    """While this lasts, no output replaces or enters one of ``inputs``; with ``force`` it replaces what others wrote."""
    tokens = _INPUTS.set(tuple(map(real_path, inputs))), _FORCED.set(force)
    try:
        yield
    finally:
        _INPUTS.reset(tokens[0])
        _FORCED.reset(tokens[1])


def forced() -> bool:
    """Whether ``--force`` was given."""
    return _FORCED.get()


def require_replaceable(path: str | Path, ours: bool, what: str) -> None:
    """Raises a :class:`UserError` where something else than ``what`` we write is at ``path``, unless that is forced."""
    if os.path.lexists(path) and not ours and not forced():
        raise UserError(f"{path}: exists and is not {what}; not replaced (another name, or --force)")


def require_no_input(path: str | Path) -> None:
    """Raises a :class:`UserError` if ``path`` is what the command reads, or lies in a folder that it reads."""
    here = real_path(path)
    for one in _INPUTS.get():
        linked = os.path.exists(here) and os.path.exists(one) and os.path.samefile(here, one)  # by a hard link
        if here == one or one in here.parents or linked:
            raise UserError(f"{path}: the command reads {one.name} there; an output never replaces an input")


def _require_writable(target: Path) -> None:
    """Checks that writing ``target`` neither destroys nor enters what the command reads, nor destroys a log."""
    require_no_input(target)
    here = real_path(target)
    if os.path.exists(here) and not os.path.isfile(here) and not os.path.isdir(here):
        raise UserError(f"{target}: is neither a file nor a folder; not replaced")
    for one in _INPUTS.get():
        if here in one.parents:
            raise UserError(f"{target}: the command reads {one.name} there; an output never replaces an input")
    if os.path.isfile(here) and here.suffix in LOG_SUFFIXES and not forced():
        raise UserError(f"{target}: exists and looks like a log; not replaced (another name, or --force)")


def real_path(path: str | Path) -> Path:
    """The path without links; unlike ``Path.resolve`` also where links go round in a circle."""
    return Path(os.path.realpath(path))


@contextmanager
def replacing(path: str | Path, may_hold: Collection[str] = ()) -> Iterator[Path]:
    """Yields a path beside ``path`` to write a file or folder to; it takes the name of ``path`` on success.

    On an exception what was written aside is removed and ``path`` is as it was.

    Args:
        path: of the output.
        may_hold: names that a folder there may hold beside those of the new one; with others it is not replaced.

    Raises:
        UserError: ``path`` cannot be written, or would destroy what is there.
    """
    target = Path(path)
    _require_writable(target)
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        begin = f".{target.name}.{socket.gethostname()}."
        _clear_away(target, begin)
        scratch = Path(tempfile.mkdtemp(prefix=f"{begin}{os.getpid()}.", dir=target.parent))
    except OSError as error:
        raise UserError(f"{target}: cannot be written ({error.strerror}: {error.filename})") from error
    try:
        yield scratch / target.name
        _require_nothing_else(target, scratch / target.name, may_hold)
        _settle(scratch / target.name, scratch)
        _put(scratch / target.name, target, scratch / "replaced")
    except Exception as error:
        if isinstance(error, UserError) or not (number := _no_room(error, scratch)):
            raise
        raise UserError(f"{target}: cannot be written ({os.strerror(number)})") from error
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


def _no_room(error: Exception, folder: Path) -> int:
    """The number of the system's error if writing failed because there is no room in ``folder``, else 0.

    Libraries raise errors of their own then, so a file is tried.
    """
    if not isinstance(error, OSError):
        try:
            (folder / "room").write_bytes(bytes(_CHUNK))
        except OSError as tried:
            error = tried
    number = getattr(error, "errno", None)
    return number if number in _NO_ROOM else 0


def _clear_away(target: Path, begin: str) -> None:
    """Removes scratch folders for an output, which ``begin`` so, of processes of this machine that were killed."""
    for path in target.parent.iterdir():
        owner = path.name.removeprefix(begin).partition(".")[0]
        if path.name.startswith(begin) and owner.isdigit() and not os.path.exists(f"/proc/{owner}"):
            shutil.rmtree(path, ignore_errors=True)


def _require_nothing_else(target: Path, aside: Path, may_hold: Collection[str]) -> None:
    """Checks that a folder which is replaced holds nothing of somebody else's."""
    if not (os.path.isdir(aside) and os.path.isdir(target)) or forced():
        return
    foreign = sorted(set(os.listdir(target)) - set(os.listdir(aside)) - set(may_hold))
    if foreign:
        raise UserError(
            f"{target}: holds {foreign[0]}, which we did not write; not replaced (another name, or --force)"
        )


def _settle(aside: Path, scratch: Path) -> None:
    """Lets others read the files, as the umask says, and brings them to the disk."""
    usual = scratch / "usual"
    usual.touch()
    mode = stat.S_IMODE(usual.stat().st_mode)
    for file in [path for path in aside.rglob("*") if os.path.isfile(path)] if os.path.isdir(aside) else [aside]:
        file.chmod(mode)
        with file.open("rb") as content:
            os.fsync(content.fileno())


def _exchange(one: Path, other: Path) -> bool:
    """Lets two folders change names in one atomic step, where the system and the file system can."""
    renameat2 = getattr(ctypes.CDLL(None, use_errno=True), "renameat2", None)
    if renameat2 is None:
        return False
    done: int = renameat2(_HERE, os.fsencode(one), _HERE, os.fsencode(other), _SWAP)
    return done == 0


def _put(aside: Path, target: Path, replaced: Path) -> None:
    """Renames ``aside`` to ``target``.

    A folder cannot be renamed onto a filled one: both change names at once, or the older one goes to ``replaced`` first.
    """
    try:
        if os.path.isdir(aside) and os.path.isdir(target):
            if _exchange(aside, target):
                return
            target.rename(replaced)
        os.replace(aside, target)
    except OSError as error:
        if os.path.exists(replaced):
            replaced.rename(target)
        raise UserError(f"{target}: cannot be written ({error.strerror})") from error


def write_json(path: str | Path, content: dict[str, Any]) -> None:
    """Writes ``content`` as indented JSON, atomically; NaN is refused because JSON has none."""
    with replacing(path) as aside:
        aside.write_text(json.dumps(content, indent=2, allow_nan=False) + "\n", encoding="utf-8")


def checksum(file: Path) -> str:
    """SHA-256 of a file, hexadecimal."""
    total = hashlib.sha256()
    with open(file, "rb") as content:
        while chunk := content.read(_CHUNK):
            total.update(chunk)
    return total.hexdigest()


def digest(path: Path) -> str:
    """SHA-256 of a file, or of the files in a folder and their names."""
    total = hashlib.sha256()
    for file in files_in(path):
        total.update(f"{file.relative_to(path)} {checksum(file)}\n".encode())
    return total.hexdigest()


def content_key(content: Any) -> str:
    """SHA-256 of what JSON can hold: the same content has the same key."""
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def files_in(path: Path) -> list[Path]:
    """A file, or all files in a folder, however deep; none if nothing is there."""
    return [file for file in (sorted(path.rglob("*")) if os.path.isdir(path) else [path]) if os.path.isfile(file)]
