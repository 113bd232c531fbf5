"""Where the real logs lie that benchmarks measure with."""

from __future__ import annotations

import os
from argparse import ArgumentParser
from pathlib import Path


def log_folder() -> Path:
    """The folder that ``DYNSSM_DATA`` names, or the one beside the repository."""
    return Path(os.environ.get("DYNSSM_DATA") or "../shared/data")


def add_data_option(parser: ArgumentParser) -> None:
    """The option ``--data DIR``, :func:`log_folder` by default."""
    parser.add_argument("--data", type=Path, default=log_folder(), help="folder of the logs (default: DYNSSM_DATA)")
