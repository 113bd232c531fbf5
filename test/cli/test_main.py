"""The command line as a whole: help, version, and usage errors in one line."""

from __future__ import annotations

import subprocess
import sys

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
def test_every_command_has_help(command: str) -> None:
    result = dynssm(command, "--help")
    assert result.returncode == 0
    assert "Usage" in result.stdout


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["drive"], "No such command 'drive'"),
        (["extract"], "Missing argument"),
        (["extract", "bag", "--signals", "av21", "--rate", "0", "--out", "r.parquet"], "'--rate'"),
        (
            ["train", "r.parquet", "--model", "nothing", "--vehicle", "orca", "--out", "m"],
            "'nothing' is neither a file",
        ),
        (["train", "r.parquet", "--model", "ridge", "--vehicle", "orca", "--out", "m", "--device", "tpu"], "tpu"),
    ],
)
def test_a_usage_error_is_one_line_and_exit_status_1(arguments: list[str], expected: str) -> None:
    result = dynssm(*arguments)
    assert result.returncode == 1
    (line,) = result.stderr.strip().splitlines()
    assert line.startswith("error: ")
    assert expected in line
