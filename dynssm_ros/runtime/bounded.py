"""Work in a process of its own, with limits of memory and time: work that takes all of either ends it, and not the caller.

This module imports little, as such a process is waited for.
"""

from __future__ import annotations

import json
import os
import pickle
import resource
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from dynssm_ros.errors import ArtifactError, UserError

TIME_LIMIT_S = 15.0
"""From the start of the process to its answer."""
_WORK_S = 5  # without the start of Python
_PROCESSOR_S = 3  # likewise, of a core
_MEMORY = 1 << 30  # bytes, likewise
_TOO_SLOW = "takes too long or too much memory"


def ask(module: str, path: Path, *task: Any) -> None:
    """Lets ``module`` judge what is at ``path`` in another process, where it calls :func:`answer`.

    Args:
        module: that is run.
        path: that messages name.
        task: arguments of its judgement after the path.

    Raises:
        ArtifactError: it refuses ``path``, or needs more than the limits.
    """
    try:
        done = subprocess.run(  # noqa: S603 - a module of ours
            [sys.executable, "-m", module],
            input=pickle.dumps((path, *task)),
            capture_output=True,
            timeout=TIME_LIMIT_S,
            start_new_session=True,
            check=False,
        )
    except subprocess.TimeoutExpired as error:
        raise ArtifactError(f"{path}: {_TOO_SLOW}; expected an answer within {TIME_LIMIT_S:g} s") from error
    except OSError as error:
        raise ArtifactError(f"{path}: cannot be tried in a process of its own ({error.strerror})") from error
    if done.returncode in (-signal.SIGXCPU, -signal.SIGALRM, -signal.SIGKILL):
        raise ArtifactError(f"{path}: {_TOO_SLOW}; expected {_PROCESSOR_S} s and {_MEMORY >> 20} MB to be enough")
    if done.returncode:
        raise ArtifactError(f"{path}: the process that tried it ended with status {done.returncode}")
    if refusal := json.loads(done.stdout):
        raise ArtifactError(refusal)


def answer(judge: Callable[..., object], prepare: Callable[[], None] = lambda: None) -> None:
    """In the other process: judges what standard input brings, within the limits.

    Args:
        judge: path and task; the exception that it raises is the answer.
        prepare: is called first, without limits.
    """
    answered = os.dup(1)
    os.dup2(2, 1)  # what libraries print is no answer
    prepare()
    path, *task = pickle.load(sys.stdin.buffer)  # noqa: S301 - from the process that started this one
    _limit()
    refusal = ""
    try:
        judge(path, *task)
    except UserError as error:
        refusal = str(error)
    except Exception as error:  # of ONNX Runtime, or no memory
        refusal = f"{path}: cannot be used ({' '.join(f'{type(error).__name__}: {error}'.split())[:200]})"
    os.write(answered, json.dumps(refusal).encode())


def _limit() -> None:
    """Bounds what this process may take from here on; where memory is short, it goes first."""
    with open("/proc/self/statm", encoding="ascii") as status:
        pages = int(status.read().split()[0])
    with open("/proc/self/oom_score_adj", "w", encoding="ascii") as score:
        score.write("1000")
    used = resource.getrusage(resource.RUSAGE_SELF)
    resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + _MEMORY,) * 2)
    resource.setrlimit(resource.RLIMIT_CPU, (int(used.ru_utime + used.ru_stime) + _PROCESSOR_S,) * 2)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    signal.alarm(_WORK_S)
