"""Casadi functions whose arguments and results stay in numpy's memory; casadi's own matrices cost more than small
functions do.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from dynssm_ros.arrays import Vector


class Buffered:
    """A casadi ``function`` with dense arguments and results, in memory of its own. Not to be called by two threads at
    once.

    ``given`` are its flat arguments, to be filled in place; zeros at first. ``results`` are those of the last
    evaluation. Matrices are stored by columns.
    """

    def __init__(self, function: Any) -> None:
        self.given: list[Vector] = [np.zeros(function.numel_in(k)) for k in range(function.n_in())]
        self.results: list[Vector] = [np.zeros(function.numel_out(k)) for k in range(function.n_out())]
        self._buffer, self.evaluate = function.buffer()
        for attach, arrays in ((self._buffer.set_arg, self.given), (self._buffer.set_res, self.results)):
            for k, array in enumerate(arrays):
                if array.size:
                    attach(k, array.data)

    @property
    def success(self) -> bool:
        """Whether the last evaluation of a solver found what it was to find."""
        return bool(self._buffer.stats()["success"])


class BufferedRows:
    """A function of column vectors with dense results, evaluated for ``n`` rows at once."""

    def __init__(self, function: Any, n: int) -> None:
        self._buffered = Buffered(function.map(n) if n > 1 else function)
        self._given = [array.reshape(n, -1) for array in self._buffered.given]
        self._results = [array.reshape(n, -1) for array in self._buffered.results]

    def __call__(self, *given: Vector) -> list[Vector]:
        """The results, ``(n, size)`` each, matrices stored by columns, of arguments ``(n, size)``, or ``(size,)`` for
        all rows alike.
        """
        for array, values in zip(self._given, given, strict=True):
            array[...] = values
        self._buffered.evaluate()
        return [array.copy() for array in self._results]


class QuadraticProgram(NamedTuple):
    """``z' H z / 2 + g' z``, to be least with ``low <= A z <= high`` and ``z_low <= z <= z_high``."""

    H: Vector
    g: Vector
    A: Vector
    low: Vector
    high: Vector
    z_low: Vector
    z_high: Vector


class QuadraticSolver:
    """Solves dense quadratic programs with ``z`` of size ``variables`` and ``rows`` rows of ``A`` by an active set."""

    def __init__(self, variables: int, rows: int) -> None:
        import casadi as ca  # takes a while, and most of the command line does without

        shape = {"h": ca.Sparsity.dense(variables, variables), "a": ca.Sparsity.dense(rows, variables)}
        solver = ca.conic("program", "daqp", shape, {"error_on_fail": False})
        self._buffered = Buffered(solver)
        given = dict(zip(solver.name_in(), self._buffered.given, strict=True))
        self._given = [given[name] for name in ("h", "g", "a", "lba", "uba", "lbx", "ubx")]

    def solve(self, program: QuadraticProgram) -> Vector:
        """The solution ``(variables,)``; not a number where there is none."""
        for array, values in zip(self._given, program._replace(A=program.A.T), strict=True):
            array.reshape(values.shape)[...] = values
        self._buffered.evaluate()
        z = self._buffered.results[0]
        return z.copy() if self._buffered.success else np.full_like(z, np.nan)
