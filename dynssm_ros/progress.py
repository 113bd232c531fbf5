"""What long work calls while it goes on."""

from __future__ import annotations

from collections.abc import Callable

Progress = Callable[[int, int], None]
"""Called with what is done and what there is to do."""
NamedProgress = Callable[[int, int, str], None]
"""The same, and what is being done."""
OnProgress = Callable[[str], None]
"""Called with what is being done."""
