"""Fixtures that several rooms share."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parent.parent


@pytest.fixture(scope="session")
def data() -> Path:
    """The folder of real measurements, which is not part of the repository."""
    folder = Path(os.environ.get("DYNSSM_DATA", REPOSITORY.parent / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip(f"no measured data at {folder} (set DYNSSM_DATA)")
    return folder


@pytest.fixture(scope="session")
def putnam(data: Path) -> Path:
    """The AV-21 log of Putnam Park as a rosbag2 folder."""
    return data / "av21" / "putnam_park_run4_2"


@pytest.fixture(scope="session")
def orca_bag(data: Path) -> Path:
    """The published ORCA run on ETHZ as a rosbag2 folder."""
    return data / "orca" / "ethz_pure_pursuit"
