"""The car's equations as a list of operations: what a compiled loop executes, traced from the one source of the equations.

:class:`Symbol` stands for a number. What :class:`~dynssm_ros.vehicle.car.CarModel` computes with symbols is written down
operation by operation, in the order in which numpy would execute it. So effects, integrators and plugins need nothing of
their own, and the result is numpy's but for the last digit of an elementary function.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

OPERATIONS = (
    "add", "subtract", "multiply", "divide", "power", "negative", "fabs", "less", "less_equal", "sqrt",
    "sin", "cos", "tan", "arctan", "arctan2", "tanh", "exp", "hypot",
)  # fmt: skip
"""By their numbers in a tape; the compiled loop knows the same."""
_CODE = {name: code for code, name in enumerate(OPERATIONS)}


class Tape(NamedTuple):
    """Operations on slots, each of which holds a number; slots are used again once nothing reads them any more."""

    code: npt.NDArray[np.int32]
    """``(n, 4)``: operation, slot of the result, slots of the operands; the second is the first one where there is one."""
    constants: npt.NDArray[np.float64]
    """Values of the slots after those of the inputs."""
    inputs: int
    """The first so many slots."""
    outputs: npt.NDArray[np.int32]
    """Slots of the results."""
    slots: int
    """In all."""


class Symbol:
    """A number that is not known yet, in a :class:`Recorder`."""

    __slots__ = ("at", "of")
    __array_ufunc__ = None  # numpy's own numbers leave the operation to this class

    def __init__(self, of: Recorder, at: int) -> None:
        self.of, self.at = of, at

    def __add__(self, other: Any) -> Symbol:
        return self.of.record("add", self, other)

    def __radd__(self, other: Any) -> Symbol:
        return self.of.record("add", other, self)

    def __sub__(self, other: Any) -> Symbol:
        return self.of.record("subtract", self, other)

    def __rsub__(self, other: Any) -> Symbol:
        return self.of.record("subtract", other, self)

    def __mul__(self, other: Any) -> Symbol:
        return self.of.record("multiply", self, other)

    def __rmul__(self, other: Any) -> Symbol:
        return self.of.record("multiply", other, self)

    def __truediv__(self, other: Any) -> Symbol:
        return self.of.record("divide", self, other)

    def __rtruediv__(self, other: Any) -> Symbol:
        return self.of.record("divide", other, self)

    def __pow__(self, other: Any) -> Symbol:
        return self.of.record("multiply", self, self) if other == 2 else self.of.record("power", self, other)

    def __rpow__(self, other: Any) -> Symbol:
        return self.of.record("power", other, self)

    def __neg__(self) -> Symbol:
        return self.of.record("negative", self)

    def __abs__(self) -> Symbol:
        return self.of.record("fabs", self)

    def __lt__(self, other: Any) -> Symbol:
        return self.of.record("less", self, other)

    def __gt__(self, other: Any) -> Symbol:
        return self.of.record("less", other, self)

    def __le__(self, other: Any) -> Symbol:
        return self.of.record("less_equal", self, other)

    def __ge__(self, other: Any) -> Symbol:
        return self.of.record("less_equal", other, self)

    def __bool__(self) -> bool:
        raise TypeError("a symbol is neither true nor false: equations that branch on a value cannot be traced")


class Recorder:
    """An array namespace that writes down what is computed."""

    pi = np.pi

    def __init__(self, inputs: int) -> None:
        self._inputs = inputs
        self._nodes: list[tuple[str, int, int]] = []  # by number less the inputs'; constants are "constant", index
        self._constants: list[float] = []
        self._known: dict[tuple[str, int, int] | float, Symbol] = {}
        self.symbols = [Symbol(self, k) for k in range(inputs)]

    def record(self, name: str, *operands: Any) -> Symbol:
        """The result of an operation; the same one is executed once."""
        first, *rest = (self._symbol(each).at for each in operands)
        return self._node((name, first, rest[0] if rest else first))

    def __getattr__(self, name: str) -> Callable[..., Any]:
        if name == "abs":
            name = "fabs"
        if name not in _CODE:
            raise AttributeError(f"{name} cannot be traced; expected one of {', '.join(OPERATIONS)}")

        def call(*operands: Any) -> Any:
            if not any(isinstance(each, Symbol) for each in operands):
                return getattr(np, name)(*operands)
            return self.record(name, *operands)

        return call

    def _symbol(self, value: Any) -> Symbol:
        if isinstance(value, Symbol):
            return value
        number = float(value)
        key = ("constant", *np.frombuffer(np.float64(number).tobytes(), dtype=np.int32).tolist())
        if key not in self._known:
            self._constants.append(number)
            self._known[key] = self._append(("constant", len(self._constants) - 1, 0))
        return self._known[key]

    def _node(self, node: tuple[str, int, int]) -> Symbol:
        if node not in self._known:
            self._known[node] = self._append(node)
        return self._known[node]

    def _append(self, node: tuple[str, int, int]) -> Symbol:
        self._nodes.append(node)
        return Symbol(self, self._inputs + len(self._nodes) - 1)

    def tape(self, outputs: Sequence[Any]) -> Tape:
        """What yields ``outputs``; what they do not hang on is left out."""
        results = [self._symbol(each).at for each in outputs]
        last: dict[int, int] = dict.fromkeys(results, len(self._nodes))  # node that reads a value last
        for k in range(len(self._nodes) - 1, -1, -1):
            name, *operands = self._nodes[k]
            if name != "constant" and k + self._inputs in last:
                for operand in operands:
                    last.setdefault(operand, k)
        slot = {k: k for k in range(self._inputs)}
        used = [k for k, (name, *_) in enumerate(self._nodes) if name == "constant" and k + self._inputs in last]
        slot |= {k + self._inputs: self._inputs + place for place, k in enumerate(used)}
        fixed = slots = self._inputs + len(used)
        free: list[int] = []
        code = []
        for k, (name, first, second) in enumerate(self._nodes):
            at = k + self._inputs
            if name == "constant" or at not in last:
                continue
            reads = slot[first], slot[second]
            free += [slot[each] for each in sorted({first, second}) if last[each] == k and slot[each] >= fixed]
            if free:
                slot[at] = free.pop()
            else:
                slot[at], slots = slots, slots + 1
            code.append((_CODE[name], slot[at], *reads))
        return Tape(
            np.array(code, dtype=np.int32).reshape(-1, 4),
            np.array([self._constants[self._nodes[k][1]] for k in used]),
            self._inputs,
            np.array([slot[at] for at in results], dtype=np.int32),
            slots,
        )


def trace(function: Callable[..., Sequence[Any]], inputs: int) -> Tape:
    """The tape of ``function(xp, *numbers)``, which gives a sequence of numbers.

    Raises:
        TypeError: it branches on a value.
        AttributeError: it needs an operation that a tape does not have.
    """
    recorder = Recorder(inputs)
    return recorder.tape(function(recorder, *recorder.symbols))


def execute(tape: Tape, inputs: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """The outputs ``(m, n)`` of a tape for ``inputs`` ``(inputs, n)``, in numpy: what the compiled loop must give."""
    slots = np.empty((tape.slots, inputs.shape[1]))
    slots[: tape.inputs] = inputs
    slots[tape.inputs : tape.inputs + len(tape.constants)] = tape.constants[:, None]
    with np.errstate(all="ignore"):
        for code, result, first, second in tape.code.tolist():
            function = getattr(np, OPERATIONS[code])
            slots[result] = function(*(slots[k] for k in (first, second)[: function.nin]))
    found: npt.NDArray[np.float64] = slots[tape.outputs]
    return found
