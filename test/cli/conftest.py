"""The command line, run in this process."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from dynssm_ros.cli import main as cli

TINY = """
base: dynssm_orca
name: tiny
H: 4
ssm: {channels: 4, states: 2}
gru: {hidden: 4}
fusion: {hidden: 8, latent: 8}
physics: {nominal: mid_range}
adaptation: {hidden: 8}
residual: {hidden: [8]}
training: {epochs: 4, batch_size: 64}
"""


@pytest.fixture
def tiny_model(tmp_path: Path) -> Path:
    """A model file that trains in a second, four epochs."""
    path = tmp_path / "tiny.yaml"
    path.write_text(TINY)
    return path


@pytest.fixture
def dynssm(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, str, str]]:
    """Runs the command line: ``dynssm(...) -> (status, stdout, stderr)``."""

    def run(*arguments: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["dynssm", *map(str, arguments)])
        with pytest.raises(SystemExit) as stopped:
            cli.main()
        out, err = capsys.readouterr()
        return int(stopped.value.code or 0), out, err

    return run
