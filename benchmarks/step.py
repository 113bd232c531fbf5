"""How long a step of the predictor takes, and by which means its equations run: ``python -m benchmarks.step``.

``python -m benchmarks.step --recording LAPS.parquet --model DIR --model DIR`` plays the recording's rows to a predictor with
each model, in turn and in rounds, with the compiled loops and without; with ``--evaluate`` the models are evaluated on it
instead, and the processor's time is scaled to an hour of such rows. ``python -m benchmarks.step`` alone compares the means:
the car's equations at the 31 rows of a window in numpy, as a tape in the compiled loop, as C that casadi generates and the
C compiler compiles, and as Python that Numba compiles (if it is installed; the package does not need it).

Times are percentiles of single calls on one core. The fifth says what the work takes where others keep the cores busy.
"""

from __future__ import annotations

import argparse
import ctypes
import importlib
import math
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import casadi
import numpy as np

from dynssm_ros import compiled
from dynssm_ros.arrays import Vector
from dynssm_ros.cli.console import console
from dynssm_ros.errors import UserError
from dynssm_ros.evaluation.open_loop import evaluate
from dynssm_ros.reporting.tables import Column, Table
from dynssm_ros.runtime.artifact import open_artifact
from dynssm_ros.runtime.onnx_model import OnnxModel
from dynssm_ros.runtime.predictor import Prediction, Predictor
from dynssm_ros.signals.recording import Recording
from dynssm_ros.signals.signal_map import load_signal_map
from dynssm_ros.vehicle import Applied, CarModel, Coefficients, State, load_vehicle
from dynssm_ros.vehicle.compiled_car import car_structure
from dynssm_ros.vehicle.integrators import Integrator
from dynssm_ros.vehicle.tape import OPERATIONS, trace

_ROWS = 31  # of the window that the online layer reads
_CALLS = 3000
_LOOP = """
extern int f(const double **, double **, long long *, double *, int);
void loop(const double *x, double *y, long rows, double *work) {
    for (long k = 0; k < rows; k++) {
        const double *in[8] = {x + 5 * k};
        double *out[8] = {y + 3 * k};
        long long whole[8];
        f(in, out, whole, work, 0);
    }
}
"""


class Means(NamedTuple):
    """A way to run the equations."""

    call: Callable[[], Any]
    result: Callable[[], Vector]  # of the last call
    seconds: float  # until it was ready
    kept: Any = None  # what compiled code works in


def percentiles(call: Callable[[], Any], calls: int = _CALLS) -> Vector:
    """5th, 50th and 99th percentile of the time of a call (us)."""
    taken = np.empty(calls)
    for k in range(calls):
        begin = time.perf_counter_ns()
        call()
        taken[k] = time.perf_counter_ns() - begin
    found: Vector = np.percentile(taken / 1e3, [5, 50, 99])
    return found


def means(integrator: Integrator) -> dict[str, Means]:
    """The ways that there are here, by name; numpy's first."""
    vehicle = load_vehicle("orca")
    car, theta = CarModel.of(vehicle, integrator), Coefficients(*vehicle.nominal.tolist())
    window = np.random.default_rng(0).normal(size=(1, _ROWS, 7)) * [1.5, 0.2, 2.0, 0.5, 0.2, 0.0, 0.0]
    inputs, moved = np.ascontiguousarray(window[0, :, :5]), np.empty((_ROWS, 3))

    def step(xp: Any, *q: Any) -> Any:
        return car.under(xp).increment(State(*q[:3]), Applied(*q[3:5]), theta)[0]

    found = {
        "numpy": Means(lambda: step(np, *inputs.T), lambda: np.stack(step(np, *inputs.T), axis=1), 0.0),
        "casadi, C": _by_casadi(step, inputs, moved.copy()),
    }
    begin = time.monotonic()
    structure = car_structure(car, vehicle.nominal, _ROWS)
    if compiled.LIBRARY is not None and structure is not None:
        arguments = structure.address, compiled.address(window), 1, _ROWS, _ROWS, compiled.address(moved)
        loop, seconds = compiled.LIBRARY.dynssm_over, time.monotonic() - begin
        found["tape, compiled loop"] = Means(lambda: loop(*arguments), lambda: moved, seconds, (structure, window))
    try:
        numba = importlib.import_module("numba")
    except ImportError:
        return found
    return found | {"Numba": _by_numba(step, inputs, moved.copy(), numba)}


def _by_casadi(step: Callable[..., Any], inputs: Vector, moved: Vector) -> Means:
    """The equations as C that casadi generates, compiled for this call."""
    begin, folder = time.monotonic(), Path(tempfile.mkdtemp(prefix="dynssm-step-"))
    x = casadi.SX.sym("x", 5)
    function = casadi.Function("f", [x], [casadi.vertcat(*step(casadi, *casadi.vertsplit(x)))])
    code = casadi.CodeGenerator("f.c")
    code.add(function)
    (folder / "f.c").write_text(code.dump())
    (folder / "loop.c").write_text(_LOOP)
    library = folder / "means.so"
    options = ("-O3", "-ffp-contract=off", "-shared", "-fPIC", "-o", str(library))
    subprocess.run(["cc", *options, str(folder / "f.c"), str(folder / "loop.c"), "-lm"], check=True)  # noqa: S603, S607
    loop, work = ctypes.PyDLL(str(library)).loop, np.zeros(function.sz_w() + 8)
    loop.argtypes = [ctypes.c_void_p, ctypes.c_void_p, ctypes.c_long, ctypes.c_void_p]
    arguments = compiled.address(inputs), compiled.address(moved), _ROWS, compiled.address(work)
    return Means(lambda: loop(*arguments), lambda: moved, time.monotonic() - begin, (inputs, work))


def _by_numba(step: Callable[..., Any], inputs: Vector, moved: Vector, numba: Any) -> Means:
    """The equations as a loop in Python that Numba compiles for this call."""
    begin, tape = time.monotonic(), trace(step, 5)
    forms = {
        "add": "{}+{}", "subtract": "{}-{}", "multiply": "{}*{}", "divide": "{}/{}", "power": "{}**{}", "negative": "-{}",
        "fabs": "abs({})", "less": "1.0 if {}<{} else 0.0", "less_equal": "1.0 if {}<={} else 0.0",
        "arctan": "math.atan({})", "arctan2": "math.atan2({},{})",
    }  # fmt: skip
    lines = ["def loop(x, y):", " for k in range(len(x)):", *(f"  s{i} = x[k, {i}]" for i in range(5))]
    lines += [f"  s{5 + i} = {value!r}" for i, value in enumerate(tape.constants.tolist())]
    for code, result, first, second in tape.code.tolist():
        form = forms.get(OPERATIONS[code], f"math.{OPERATIONS[code]}({{}})")
        lines.append(f"  s{result} = {form.format(f's{first}', f's{second}')}")
    lines += [f"  y[k, {i}] = s{slot}" for i, slot in enumerate(tape.outputs.tolist())]
    made: dict[str, Any] = {"math": math}
    exec("\n".join(lines), made)  # noqa: S102 - written here
    loop = numba.njit(made["loop"])
    loop(inputs, moved)
    return Means(lambda: loop(inputs, moved), lambda: moved, time.monotonic() - begin)


def means_table() -> Table:
    """Each way with each integrator: times, largest difference from numpy, how long it takes to be ready."""
    rows: list[list[Any]] = []
    for integrator in ("euler", "rk4"):
        ways = means(integrator)
        for name, way in ways.items():
            taken = percentiles(way.call)
            difference = float(np.abs(way.result() - ways["numpy"].result()).max())
            rows.append([name, integrator, *taken[:2], difference, way.seconds])
    columns = (
        Column("means"), Column("integrator"), Column("p5", "µs"), Column("p50", "µs"), Column("difference"),
        Column("ready after", "s"),
    )  # fmt: skip
    return Table(columns, rows)


def step_times(folder: Path, recording: Recording, rows: int) -> Vector:
    """Times (us) of the predictions of a model along a recording's first ``rows``, with all that is published."""
    model = OnnxModel(open_artifact(folder))
    recording = recording.with_commands(model.commands or "none").select(slice(0, rows))
    predictor, taken = Predictor(model, load_signal_map("default")), []
    names = ("v_x", "v_y", "omega", *(("x", "y", "theta") if recording.has_pose else ()))
    states = np.stack([recording[name] for name in names], axis=1).tolist()
    for stamp, row, state in zip(recording.time.tolist(), recording.matrix.tolist(), states, strict=True):
        r, delta, more_r, more_delta = row[3:]
        predictor.observe(stamp, {"throttle_feedback": r, "steering_feedback": delta})
        if model.commands == "topics":
            predictor.observe(stamp, {"throttle_command": r + more_r, "steering_command": delta + more_delta})
        values = dict(zip(names, state, strict=True))
        begin = time.perf_counter_ns()
        outcome = predictor.predict(stamp, values)
        elapsed = time.perf_counter_ns() - begin
        predictor.finish()
        if isinstance(outcome, Prediction):
            taken.append(elapsed / 1e3)
    return np.array(taken)


def steps_table(models: Sequence[Path], recording: Recording, rows: int, rounds: int) -> Table:
    """Each model with the compiled loops and without, all in turn in each round."""
    library, times = compiled.LIBRARY, dict[tuple[Path, bool], list[Vector]]()
    for _ in range(rounds):
        for folder in models:
            for fast in (True, False) if library is not None else (False,):
                compiled.LIBRARY = library if fast else None
                times.setdefault((folder, fast), []).append(step_times(folder, recording, rows))
    compiled.LIBRARY = library
    columns = (Column("model"), Column("compiled loops"), *(Column(name, "µs") for name in ("p5", "p50", "p99")))
    found: list[list[Any]] = [
        [folder.name, "yes" if fast else "no", *np.percentile(np.concatenate(each), [5, 50, 99])]
        for (folder, fast), each in times.items()
    ]
    return Table(columns, found)


def evaluation_table(models: Sequence[Path], recording: Recording, rows: int) -> Table:
    """What the evaluation of an hour of such rows costs, with the compiled loops and without."""
    library, found = compiled.LIBRARY, list[list[Any]]()
    for folder in models:
        for fast in (True, False) if library is not None else (False,):
            compiled.LIBRARY = library if fast else None
            model = OnnxModel(open_artifact(folder))
            part = recording.with_commands(model.commands or "none").select(slice(0, rows))
            begin = time.process_time()
            evaluated = len(evaluate(part, {model.name: model}, calls=1).rows)
            hour = (time.process_time() - begin) * 3600 / recording.T_s / evaluated
            found.append([folder.name, "yes" if fast else "no", evaluated, hour])
    compiled.LIBRARY = library
    return Table((Column("model"), Column("compiled loops"), Column("rows"), Column("an hour", "s")), found)


def main(arguments: Sequence[str] | None = None) -> None:
    """Measures and prints the table."""
    parser = argparse.ArgumentParser(prog="benchmarks.step", description=__doc__)
    parser.add_argument(
        "--recording", type=Path, help="that the models' predictor goes along; needs the signals of `default`"
    )
    parser.add_argument("--model", type=Path, action="append", default=[], help="folder of a trained model; repeatable")
    parser.add_argument("--rows", type=int, default=2500, help="of the recording")
    parser.add_argument("--evaluate", action="store_true", help="time the evaluation and not the predictor")
    parser.add_argument("--rounds", type=int, default=3)
    given = parser.parse_args(arguments)
    try:
        if given.recording is None:
            table = means_table()
        elif given.evaluate:
            table = evaluation_table(given.model, Recording.load(given.recording), given.rows)
        else:
            table = steps_table(given.model, Recording.load(given.recording), given.rows, given.rounds)
    except UserError as error:
        sys.exit(f"error: {error}")
    console.print(table.rich())


if __name__ == "__main__":
    main()
