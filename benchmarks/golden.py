"""Golden results: what the commands print and write for small fixed inputs, to hold behaviour still while code moves.

``python benchmarks/golden.py record FILE`` runs the commands and writes their numbers to ``FILE`` (JSON);
``python benchmarks/golden.py compare OLD NEW`` lists every number that differs by more than 1e-9 (relative to the larger
of 1 and its size) and exits with 1 if there is one. Results of one machine are compared: another processor rounds
otherwise. Times are left out.
"""

from __future__ import annotations

import argparse
import json
import math
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from pyarrow import parquet
from rosbags.highlevel import AnyReader

TOLERANCE = 1e-9
TIMED = re.compile(r"latency|seconds|_us\b|_ms\b|late\b|step_time|control_step|milliseconds|compute")
PAIR = ("--effect", "steering_offset:offset=0.02", "--effect", "rear_grip:factor=0.85")


# the model files of 0.1.0, as changes of those that are shipped
MODELS: dict[str, dict[str, Any]] = {
    "dynssm_av21": {"base": "dynssm", "training": {"validation_block": 10.0}},
    "dynssm_orca": {
        "base": "dynssm_paper_orca", "physics": {"nominal": "calibrated"}, "residual": {"inputs": "normalised"},
        "loss": {"scale": "increment"},
    },
    "rls_av21": {"base": "rls"},
    "rls_orca": {"base": "rls"},
    "ridge_av21": {"base": "ridge", "training": {"validation_block": 10.0}},
    "ridge_orca": {"base": "ridge", "history": 0.3, "training": {"validation_block": 1.0}},
}  # fmt: skip


def commands(folder: Path) -> Iterator[tuple[str, list[str], list[Path]]]:
    """Name, arguments and written files of every command, in the order in which they need each other."""
    for car, track, rate, speed, plants in (
        ("orca", "club", "50", "0", ("euler", "rk4", "double_track")),
        ("av21", "road_course", "25", "5", ("euler", "rk4", "double_track")),
    ):
        noise = "0.01,0.01,0.03" if car == "orca" else "0.02,0.01,0.002"
        seconds = "60" if car == "orca" else "150"
        for plant in plants:
            hidden = PAIR if plant == "rk4" else ()
            bag, log = folder / f"{car}_{plant}_bag", folder / f"{car}_{plant}.parquet"
            yield (
                f"{car}/{plant}/simulate",
                ["simulate", "--vehicle", car, "--track", track, "--duration", seconds, "--plant", plant, "--seed", "3",
                 "--aggressiveness", "0.8", "--noise", noise, *hidden, "--out", f"{bag}", "--json", f"{bag}.json"],
                [Path(f"{bag}.json")],
            )  # fmt: skip
            yield (
                f"{car}/{plant}/extract",
                ["extract", f"{bag}", "--signals", "default", "--rate", rate, "--out", f"{log}"],
                [log],
            )
            vehicle, result = folder / f"{car}_{plant}.yaml", folder / f"{car}_{plant}_calibrate.json"
            yield (
                f"{car}/{plant}/calibrate",
                ["calibrate", f"{log}", "--vehicle", car, "--min-speed", speed, "--starts", "2", "--out", f"{vehicle}",
                 "--json", f"{result}"],
                [vehicle, result],
            )  # fmt: skip
        log = folder / f"{car}_euler.parquet"
        for model in (f"dynssm_{car}", f"ddm_{car}", f"ridge_{car}", f"rls_{car}"):
            out = folder / model
            yield (
                f"{car}/train/{model}",
                ["train", f"{log}", "--model", model_file(folder, model), "--vehicle",
                 f"{folder / f'{car}_euler.yaml'}", "--epochs", "1",
                 "--out", f"{out}"],
                [out / "metrics.json"],
            )  # fmt: skip
        models = [f"{folder / name}" for name in (f"dynssm_{car}", f"ddm_{car}", f"ridge_{car}", f"rls_{car}")]
        rivals = [*models, "persistence", "single_track", "single_track_ewma"]
        out = folder / f"{car}_evaluate"
        yield (
            f"{car}/evaluate",
            ["evaluate", f"{folder / f'{car}_rk4.parquet'}", *(a for m in rivals for a in ("--model", m)), "--vehicle",
             f"{folder / f'{car}_euler.yaml'}", "--stride", "5", "--out", f"{out}"],
            [out / "results.json"],
        )  # fmt: skip
        out = folder / f"{car}_replay"
        yield (
            f"{car}/replay",
            ["replay", f"{folder / f'{car}_rk4_bag'}", "--model", f"{folder / f'dynssm_{car}'}", "--out", f"{out}"],
            [out],
        )
        for plant in ("rk4",) if car == "av21" else ("rk4", "double_track"):
            out = folder / f"{car}_{plant}_diagnose"
            yield (
                f"{car}/{plant}/diagnose",
                ["diagnose", f"{folder / f'{car}_{plant}.parquet'}", "--vehicle", car, "--out", f"{out}"],
                [out / "results.json", out / "vehicle.yaml"],
            )
        for plant in plants if car == "orca" else ("rk4",):
            out = folder / f"{car}_{plant}_race"
            yield (
                f"{car}/{plant}/race",
                ["race", "--vehicle", car, "--track", "club" if car == "orca" else "oval", "--plant", plant,
                 "--model", "true", "--model", f"{folder / f'dynssm_{car}'}", "--speed-scale", "0.8", "--out", f"{out}"],
                [out / "results.json"],
            )  # fmt: skip
    out = folder / "orca_progress"
    yield (
        "orca/progress/race",
        ["race", "--vehicle", "orca", "--track", "club", "--model", "true", "--model", f"{folder / 'orca_rk4.yaml'}",
         "--objective", "progress", "--offset-free", "--speed-scale", "0.85", "--effect", "front_grip:factor=0.9", "--out",
         f"{out}"],
        [out / "results.json"],
    )  # fmt: skip


def model_file(folder: Path, model: str) -> str:
    """The model file of that name: of ``MODELS``, or a shipped one."""
    return f"{folder / model}.yaml" if model in MODELS else model


def numbers(path: Path) -> dict[str, float | str]:
    """All numbers (and words) of a JSON, YAML or Parquet file or of a bag, by their place in it."""
    if path.is_dir():
        return bag_numbers(path)
    if path.suffix == ".parquet":
        table = parquet.read_table(path)
        columns = {name: table[name].to_numpy().astype(float) for name in table.column_names}
        return {
            f"{name}/{what}": float(value)
            for name, column in columns.items()
            for what, value in summary(column).items()
        }
    text = path.read_text(encoding="utf-8")
    return dict(flat(json.loads(text) if path.suffix == ".json" else yaml.safe_load(text)))


def bag_numbers(path: Path) -> dict[str, float | str]:
    """Sums over the messages of a bag, topic by topic."""
    found: dict[str, float | str] = {}
    values: dict[str, list[float]] = {}
    with AnyReader([path]) as reader:
        for connection, _, raw in reader.messages():
            message = reader.deserialize(raw, connection.msgtype)
            for name, value in attributes(message, connection.topic):
                values.setdefault(name, []).append(value)
    for name, column in values.items():
        found.update({f"{name}/{what}": value for what, value in summary(np.array(column)).items()})
    return found


def attributes(message: Any, name: str) -> Iterator[tuple[str, float]]:
    """Every number of a message, by the name of its field."""
    if isinstance(message, (int, float)):
        yield name, float(message)
    elif isinstance(message, np.ndarray):
        yield from ((f"{name}[{k}]", float(value)) for k, value in enumerate(message.ravel()) if name.count("/") < 9)
    elif isinstance(message, (list, tuple)):
        for k, each in enumerate(message):
            yield from attributes(each, f"{name}[{k}]")
    elif hasattr(message, "__dataclass_fields__"):
        for field in message.__dataclass_fields__:
            if not field.startswith("__"):
                yield from attributes(getattr(message, field), f"{name}/{field}")


def summary(column: np.ndarray) -> dict[str, float]:
    """A column in five numbers that see a change of any row."""
    whole = np.nan_to_num(column)
    weight = np.cos(np.arange(len(whole)))
    return {
        "count": float(len(whole)),
        "first": float(whole[0]),
        "last": float(whole[-1]),
        "mean": float(whole.mean()),
        "signature": float((whole * weight).mean()),
    }


def flat(content: Any, place: str = "") -> Iterator[tuple[str, float | str]]:
    """Leaves of nested mappings and lists by their path."""
    if isinstance(content, dict):
        for key, value in content.items():
            yield from flat(value, f"{place}/{key}")
    elif isinstance(content, list):
        for k, value in enumerate(content):
            yield from flat(value, f"{place}[{k}]")
    elif isinstance(content, (bool, int, float)):
        yield place, float(content)
    elif content is not None:
        yield place, str(content)


def record(file: Path) -> None:
    """Runs all commands and writes what they printed and wrote."""
    results: dict[str, Any] = {}
    with tempfile.TemporaryDirectory(prefix="dynssm-golden-") as name:
        folder = Path(name)
        for model, content in MODELS.items():
            (folder / f"{model}.yaml").write_text(yaml.safe_dump(content | {"name": model}), encoding="utf-8")
        for case, arguments, written in commands(folder):
            begin = time.monotonic()
            run = subprocess.run(  # noqa: S603 - our own command
                [sys.executable, "-m", "dynssm_ros.cli.main", *arguments], capture_output=True, text=True, check=False
            )
            if run.returncode:
                raise SystemExit(f"{case}: {run.stderr[-2000:]}")
            found = {
                f"{path.relative_to(folder)}{place}": value
                for path in written
                for place, value in numbers(path).items()
                if not TIMED.search(place)
            }
            clean = {k: v.replace(name, "DIR") if isinstance(v, str) else v for k, v in found.items()}
            results[case] = {"values": clean, "printed": run.stdout.replace(name, "DIR").splitlines()}
            print(f"{case}: {len(clean)} values, {time.monotonic() - begin:.1f} s", flush=True)
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text(json.dumps(results, indent=0), encoding="utf-8")


def compare(old: Path, new: Path) -> int:
    """Prints every value that differs; returns how many do."""
    before, after = (json.loads(path.read_text(encoding="utf-8")) for path in (old, new))
    differences = 0
    for case in before:
        ours, theirs = before[case]["values"], after.get(case, {}).get("values", {})
        rows = [row for place in {**ours, **theirs} if (row := difference(place, ours.get(place), theirs.get(place)))]
        differences += len(rows)
        print(f"{case}: {len(ours)} values, {len(rows)} differ")
        for row in rows[:20]:
            print(f"  {row}")
    return differences


def difference(place: str, before: float | str | None, after: float | str | None) -> str | None:
    """A line about a value that changed; ``None`` if it is the same."""
    if isinstance(before, float) and isinstance(after, float):
        if math.isnan(before) and math.isnan(after):
            return None
        off = abs(before - after) / max(1.0, abs(before))
        return f"{place}: {before!r} -> {after!r} ({off:.1e})" if not off <= TOLERANCE else None
    return None if before == after else f"{place}: {before!r} -> {after!r}"


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    actions = parser.add_subparsers(dest="action", required=True)
    actions.add_parser("record").add_argument("file", type=Path)
    comparing = actions.add_parser("compare")
    comparing.add_argument("old", type=Path)
    comparing.add_argument("new", type=Path)
    given = parser.parse_args()
    if given.action == "record":
        record(given.file)
    else:
        raise SystemExit(1 if compare(given.old, given.new) else 0)


if __name__ == "__main__":
    main()
