"""Which code made a result: a digest of a module and of all that it imports from some rooms of the package."""

from __future__ import annotations

import ast
import hashlib
from collections.abc import Collection
from functools import cache
from pathlib import Path

_PACKAGE = Path(__file__).parents[1] / "dynssm_ros"


@cache
def code_digest(module: str, rooms: Collection[str]) -> str:
    """Names the code of a module and of what it imports, directly or by others, less comments, layout and docstrings.

    Args:
        module: by its full name.
        rooms: folders of the package whose modules count, wherever their imports stand; hashable.
    """
    total = hashlib.sha256()
    for _, source in sorted(reached(module, frozenset(rooms)).items()):
        total.update(ast.dump(_Bare().visit(ast.parse(source))).encode())
    return total.hexdigest()


def reached(module: str, rooms: Collection[str], found: dict[str, str] | None = None) -> dict[str, str]:
    """Texts of ``module`` and of what it imports from ``rooms``, by their names, beside those ``found`` already."""
    found = {} if found is None else found
    file = _file(module)
    if module in found or file is None:
        return found
    found[module] = file.read_text(encoding="utf-8")
    for node in ast.walk(ast.parse(found[module])):
        if isinstance(node, ast.ImportFrom) and node.module:
            for name in (node.module, *(f"{node.module}.{alias.name}" for alias in node.names)):
                parts = name.split(".")
                if len(parts) > 1 and (parts[0] == "benchmarks" or (parts[0] == _PACKAGE.name and parts[1] in rooms)):
                    reached(name, rooms, found)
    return found


def _file(module: str) -> Path | None:
    """Where the text of a module of the package is; ``None`` if it is not one."""
    path = _PACKAGE.parent.joinpath(*module.split("."))
    return next((file for file in (path.with_suffix(".py"), path / "__init__.py") if file.is_file()), None)


class _Bare(ast.NodeTransformer):
    """Drops what is only said: docstrings, and other texts that stand alone."""

    def visit_Expr(self, node: ast.Expr) -> ast.Expr | None:
        return None if isinstance(node.value, ast.Constant) and isinstance(node.value.value, str) else node
