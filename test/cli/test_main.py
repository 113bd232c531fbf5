"""The command line as a whole: help, version, and usage errors in one line."""

from __future__ import annotations

import platform
import subprocess
import sys
from collections.abc import Callable

import pytest

COMMANDS = ("simulate", "extract", "calibrate", "train", "evaluate", "replay")


def dynssm(*arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "dynssm_ros.cli.main", *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)


def test_help_lists_every_command() -> None:
    result = dynssm("--help")
    assert result.returncode == 0
    assert all(command in result.stdout for command in COMMANDS)


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_help(command: str, told: Callable[..., tuple[int, str]]) -> None:
    status, words = told(command, "--help")
    assert status == 0
    assert "Usage" in words


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["drive"], "No such command 'drive'"),
        (["extract"], "Missing argument"),
        (["extract", "bag", "--signals", "av21", "--rate", "0", "--out", "r.parquet"], "'--rate'"),
    ],
)
def test_a_usage_error_is_one_line_and_exit_status_1(arguments: list[str], expected: str) -> None:
    result = dynssm(*arguments)
    assert result.returncode == 1
    (line,) = result.stderr.strip().splitlines()
    assert line.startswith("error: ")
    assert expected in line


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["--model", "nothing", "--vehicle", "orca", "--out", "m"], "'nothing' is neither a file"),
        (["--model", "ridge", "--vehicle", "orca", "--out", "m", "--device", "tpu"], "tpu"),
    ],
)
def test_an_error_of_an_option_is_one_line_too(
    refused: Callable[..., str], arguments: list[str], expected: str
) -> None:
    assert expected in refused("train", "r.parquet", *arguments)


_MEMORY = """
import sys
import numpy as np
from dynssm_ros.cli.main import main

resident = lambda: int(open("/proc/self/statm").read().split()[1])
sys.argv = ["dynssm", "--version"]
try:
    main()
except SystemExit:
    pass
np.ones(3_000_000)
before = resident()
columns = [(np.ones(200_000), [bytes(1000) for _ in range(20)]) for _ in range(40)]
small = [each[1] for each in columns]
highest = resident()
del columns
print((resident() - before) / (highest - before))
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="only glibc keeps what is freed")
def test_a_command_gives_large_arrays_back_when_they_are_freed() -> None:
    """Also those between which small things are kept."""
    result = subprocess.run([sys.executable, "-c", _MEMORY], capture_output=True, text=True, check=True)
    assert float(result.stdout.split()[-1]) < 0.05
