"""Names of exported cars."""

from __future__ import annotations

import re


def identifier(name: str) -> str:
    """The name of a car as C and Python take it."""
    return re.sub(r"\W|^(?=\d)", "_", name, flags=re.ASCII)
