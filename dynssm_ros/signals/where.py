"""Conditions on the sessions of a season: ``track == 'putnam' and seconds > 60``.

Names of fields, texts and numbers; ``== != < <= > >=``, ``in`` and ``not in`` with a list; ``and``, ``or``, ``not`` and
parentheses. They look like Python and are read by its parser, but nothing of them is executed.
"""

from __future__ import annotations

import ast
import operator
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from dynssm_ros.errors import ConfigurationError

_COMPARED: dict[type[ast.cmpop], Callable[[Any, Any], bool]] = {
    ast.Eq: operator.eq,
    ast.NotEq: operator.ne,
    ast.Lt: operator.lt,
    ast.LtE: operator.le,
    ast.Gt: operator.gt,
    ast.GtE: operator.ge,
    ast.In: lambda value, among: value in among,
    ast.NotIn: lambda value, among: value not in among,
}

_ALLOWED = (
    *(ast.BoolOp, ast.And, ast.Or, ast.UnaryOp, ast.Not, ast.USub, ast.Compare, *_COMPARED),
    *(ast.Name, ast.Load, ast.Constant, ast.List, ast.Tuple),
)


def condition(text: str, fields: Sequence[str]) -> Callable[[Mapping[str, Any]], bool]:
    """The condition as a function of the fields of a session.

    Raises:
        ConfigurationError: it is none, or asks for what is no field.
    """
    try:
        tree = ast.parse(text.strip(), mode="eval").body
        _require_known(tree, text, fields)
    except (SyntaxError, ValueError) as error:
        raise ConfigurationError(
            f"--where {text!r}: not understood; expected, for example, track == 'putnam'"
        ) from error

    def holds(session: Mapping[str, Any]) -> bool:
        try:
            return bool(_value(tree, session))
        except TypeError as error:
            raise ConfigurationError(
                f"--where {text!r}: {error}; expected texts with texts, numbers with numbers"
            ) from error

    return holds


def _require_known(tree: ast.AST, text: str, fields: Sequence[str]) -> None:
    """Checks that there is nothing but what this module's text says."""
    for node in ast.walk(tree):
        if not isinstance(node, _ALLOWED):
            raise ConfigurationError(f"--where {text!r}: {type(node).__name__} is not part of a condition")
        if isinstance(node, ast.Name) and node.id not in fields:
            raise ConfigurationError(f"--where {text!r}: '{node.id}' is no field; expected one of {', '.join(fields)}")
    if not isinstance(tree, (ast.BoolOp, ast.Compare, ast.UnaryOp)):
        raise ConfigurationError(f"--where {text!r}: no comparison; expected, for example, track == 'putnam'")


def _value(node: ast.AST, session: Mapping[str, Any]) -> Any:
    if isinstance(node, ast.BoolOp):
        parts = (_value(each, session) for each in node.values)
        return all(parts) if isinstance(node.op, ast.And) else any(parts)
    if isinstance(node, ast.UnaryOp):
        value = _value(node.operand, session)
        return not value if isinstance(node.op, ast.Not) else -value
    if isinstance(node, ast.Compare):
        values = [_value(each, session) for each in (node.left, *node.comparators)]
        pairs = zip(node.ops, values, values[1:], strict=False)
        return all(_COMPARED[type(op)](one, other) for op, one, other in pairs)
    if isinstance(node, (ast.List, ast.Tuple)):
        return [_value(each, session) for each in node.elts]
    if isinstance(node, ast.Name):
        return session[node.id]
    assert isinstance(node, ast.Constant)
    return node.value
