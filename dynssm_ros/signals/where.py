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

Value = Callable[[Mapping[str, Any]], Any]
"""A part of a condition: from the fields of a session to what it says."""

_JOINED: dict[type[ast.boolop], Callable[[Any], bool]] = {ast.And: all, ast.Or: any}
_ALONE: dict[type[ast.unaryop], Callable[[Any], Any]] = {ast.Not: operator.not_, ast.USub: operator.neg}
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


def condition(text: str, fields: Sequence[str]) -> Callable[[Mapping[str, Any]], bool]:
    """The condition as a function of the fields of a session.

    Raises:
        ConfigurationError: it is none, or asks for what is no field.
    """
    try:
        tree = ast.parse(text.strip(), mode="eval").body
    except (SyntaxError, ValueError) as error:
        raise ConfigurationError(
            f"--where {text!r}: not understood; expected, for example, track == 'putnam'"
        ) from error
    value = _Reader(text, fields).visit(tree)
    if not isinstance(tree, (ast.BoolOp, ast.Compare, ast.UnaryOp)):
        raise ConfigurationError(f"--where {text!r}: no comparison; expected, for example, track == 'putnam'")

    def holds(session: Mapping[str, Any]) -> bool:
        try:
            return bool(value(session))
        except TypeError as error:
            raise ConfigurationError(
                f"--where {text!r}: {error}; expected texts with texts, numbers with numbers"
            ) from error

    return holds


class _Reader(ast.NodeVisitor):
    """Each part of a condition as a function of a session; what has no method here is no part of one."""

    def __init__(self, text: str, fields: Sequence[str]) -> None:
        self.text, self.fields = text, fields

    def generic_visit(self, node: ast.AST) -> Value:
        raise ConfigurationError(f"--where {self.text!r}: {type(node).__name__} is not part of a condition")

    def visit_BoolOp(self, node: ast.BoolOp) -> Value:
        join, parts = _JOINED[type(node.op)], [self.visit(each) for each in node.values]
        return lambda session: join(part(session) for part in parts)

    def visit_UnaryOp(self, node: ast.UnaryOp) -> Value:
        apply, operand = _ALONE.get(type(node.op)) or self.generic_visit(node.op), self.visit(node.operand)
        return lambda session: apply(operand(session))

    def visit_Compare(self, node: ast.Compare) -> Value:
        compared = [_COMPARED.get(type(op)) or self.generic_visit(op) for op in node.ops]
        parts = [self.visit(each) for each in (node.left, *node.comparators)]

        def holds(session: Mapping[str, Any]) -> bool:
            values = [part(session) for part in parts]
            return all(compare(*pair) for compare, *pair in zip(compared, values, values[1:], strict=False))

        return holds

    def visit_List(self, node: ast.List) -> Value:
        return self._several(node.elts)

    def visit_Tuple(self, node: ast.Tuple) -> Value:
        return self._several(node.elts)

    def visit_Name(self, node: ast.Name) -> Value:
        if node.id not in self.fields:
            raise ConfigurationError(
                f"--where {self.text!r}: '{node.id}' is no field; expected one of {', '.join(self.fields)}"
            )
        return operator.itemgetter(node.id)

    def visit_Constant(self, node: ast.Constant) -> Value:
        return lambda session: node.value

    def _several(self, nodes: list[ast.expr]) -> Value:
        parts = [self.visit(each) for each in nodes]
        return lambda session: [part(session) for part in parts]
