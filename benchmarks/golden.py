"""Golden results: the main numbers of the commands for small fixed inputs, to hold behaviour still while code moves.

``python -m benchmarks.golden record FILE`` runs the commands and writes their numbers to ``FILE`` (JSON), in about three
minutes of one core. ``python -m benchmarks.golden compare OLD NEW`` lists every number of ``OLD`` that differs in ``NEW``
by more than 1e-9 (relative to the larger of 1 and its size) and exits with 1 if there is one. Results of one machine are
compared: another processor rounds otherwise. Times are left out.
"""

from __future__ import annotations

import argparse
import json
import math
import re
import resource
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml
from pyarrow import parquet
from rosbags.highlevel import AnyReader

TOLERANCE = 1e-9
SIGNALS = r"(v_x|v_y|omega|r_fb|delta_fb|r_cmd|delta_cmd|x|y|theta)/(mean|signature)$"
ERRORS = r"models/\w+/(rmse/\w+|max_error/\w+|ade|fde|parameters|flops|coverage_90/\w+)$"
LAPS = r"models/\w+/(lap_time_s|violation|mean_v_x|mean_abs_v_y|mean_abs_omega|steering_total_variation|steps)$"
CAUSES = r"verdict|causes\[|improvement/|minimum_detectable|(nominal|value)$"
MESSAGES = (
    r"(prediction/(pose/pose/position/[xy]|twist/twist/(linear/[xy]|angular/z))|parameters.*\])/(mean|signature)$"
)
DYNSSM_ORCA = {
    "base": "dynssm_paper_orca", "name": "dynssm_orca", "history": 0.3, "ssm": {"channels": 256, "states": 48},
    "gru": {"hidden": 128}, "physics": {"nominal": "calibrated"}, "adaptation": {"hidden": 256},
    "residual": {"hidden": [192, 192], "inputs": "normalised"}, "loss": {"scale": "increment", "parameters": 0.001},
    "training": {"epochs": 200, "batch_size": 128, "learning_rate": 0.001, "weight_decay": 0.0001, "gradient_clip": 1.0,
                 "patience": 60},
}  # fmt: skip
"""The model file that is trained, as changes of a shipped one."""


class Golden(NamedTuple):
    """A command whose results are kept."""

    name: str
    arguments: str  # with {folder} for where its inputs and outputs lie
    written: tuple[str, ...]  # files in that folder
    kept: str  # which places in these files, a regular expression


def drives(car: str, plant: str, options: str, rate: int, min_speed: int) -> Iterator[Golden]:
    """From a simulated drive to a calibrated car."""
    name = f"{car}_{plant}"
    yield Golden(
        f"{car}/{plant}/simulate",
        f"simulate --vehicle {car} --plant {plant} --seed 3 --aggressiveness 0.8 {options} "
        f"--out {{folder}}/{name}_bag --json {{folder}}/{name}_bag.json",
        (f"{name}_bag.json",),
        "lap|speed",
    )
    yield Golden(
        f"{car}/{plant}/extract",
        f"extract {{folder}}/{name}_bag --signals default --rate {rate} --out {{folder}}/{name}.parquet",
        (f"{name}.parquet",),
        SIGNALS,
    )
    yield Golden(
        f"{car}/{plant}/calibrate",
        f"calibrate {{folder}}/{name}.parquet --vehicle {car} --min-speed {min_speed} --starts 2 "
        f"--out {{folder}}/{name}.yaml --json {{folder}}/{name}_calibrate.json",
        (f"{name}.yaml", f"{name}_calibrate.json"),
        r"nominal$|std$|rmse|unidentified|rows",
    )


def commands() -> Iterator[Golden]:
    """All commands, in the order in which they need each other."""
    of_orca = "--track club --duration 60 --noise 0.01,0.01,0.03"
    hidden = "--effect steering_offset:offset=0.02 --effect rear_grip:factor=0.85"
    yield from drives("orca", "euler", of_orca, 50, 0)
    yield from drives("orca", "rk4", f"{of_orca} {hidden}", 50, 0)
    yield from drives("av21", "double_track", "--track road_course --duration 150 --noise 0.02,0.01,0.002", 25, 5)
    for name, file in (("dynssm_orca", "{folder}/dynssm_orca.yaml"), ("ridge_orca", "ridge"), ("rls_orca", "rls")):
        yield Golden(
            f"orca/train/{name}",
            f"train {{folder}}/orca_euler.parquet --model {file} --vehicle {{folder}}/orca_euler.yaml --epochs 1 "
            f"--out {{folder}}/{name}",
            (f"{name}/metrics.json",),
            "validation_rmse|windows|best_epoch|history",
        )
    trained = [f"{{folder}}/{name}" for name in ("dynssm_orca", "ridge_orca", "rls_orca")]
    models = " ".join(f"--model {name}" for name in (*trained, "persistence", "single_track", "single_track_ewma"))
    yield Golden(
        "orca/evaluate",
        f"evaluate {{folder}}/orca_rk4.parquet {models} --vehicle {{folder}}/orca_euler.yaml --stride 5 "
        "--out {folder}/orca_evaluate",
        ("orca_evaluate/results.json",),
        ERRORS,
    )
    yield Golden(
        "orca/replay",
        f"replay {{folder}}/orca_rk4_bag --model {trained[0]} --out {{folder}}/orca_replay",
        ("orca_replay",),
        MESSAGES,
    )
    yield Golden(
        "orca/rk4/diagnose",
        "diagnose {folder}/orca_rk4.parquet --vehicle orca --out {folder}/orca_rk4_diagnose",
        ("orca_rk4_diagnose/results.json", "orca_rk4_diagnose/vehicle.yaml"),
        CAUSES,
    )
    race = "race --vehicle orca --track club --model true"
    yield Golden(
        "orca/euler/race",
        f"{race} --plant euler --model {trained[0]} --speed-scale 0.8 --out {{folder}}/orca_euler_race",
        ("orca_euler_race/results.json",),
        LAPS,
    )
    yield Golden(
        "orca/progress/race",
        f"{race} --model {{folder}}/orca_rk4.yaml --objective progress --offset-free --speed-scale 0.85 "
        "--effect front_grip:factor=0.9 --out {folder}/orca_progress",
        ("orca_progress/results.json",),
        LAPS,
    )


def numbers(path: Path) -> dict[str, float | str]:
    """All numbers (and words) of a JSON, YAML or Parquet file or of a bag, by their place in it."""
    if path.is_dir():
        return of_columns(bag_columns(path))
    if path.suffix == ".parquet":
        table = parquet.read_table(path)
        return of_columns({name: table[name].to_numpy().astype(float) for name in table.column_names})
    text = path.read_text(encoding="utf-8")
    return dict(flat(json.loads(text) if path.suffix == ".json" else yaml.safe_load(text)))


def bag_columns(path: Path) -> dict[str, Any]:
    """Each number of the messages of a bag over its messages."""
    values: dict[str, list[float]] = {}
    with AnyReader([path]) as reader:
        for connection, _, raw in reader.messages():
            for name, value in attributes(reader.deserialize(raw, connection.msgtype), connection.topic):
                values.setdefault(name, []).append(value)
    return {name: np.array(column) for name, column in values.items()}


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


def of_columns(columns: dict[str, Any]) -> dict[str, float | str]:
    """Mean of each column, and a weighted one that sees a change of the order too."""
    found: dict[str, float | str] = {}
    for name, column in columns.items():
        whole = np.nan_to_num(column)
        found[f"{name}/mean"] = float(whole.mean())
        found[f"{name}/signature"] = float((whole * np.cos(np.arange(len(whole)))).mean())
    return found


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
    """Runs all commands and writes the numbers that are kept of each."""
    results: dict[str, dict[str, float | str]] = {}
    with tempfile.TemporaryDirectory(prefix="dynssm-golden-") as name:
        folder = Path(name)
        (folder / "dynssm_orca.yaml").write_text(yaml.safe_dump(DYNSSM_ORCA), encoding="utf-8")
        for golden in commands():
            arguments = golden.arguments.format(folder=folder).split()
            begin = _cpu_seconds()
            run = subprocess.run(  # noqa: S603 - our own command
                [sys.executable, "-m", "dynssm_ros.cli.main", *arguments], capture_output=True, text=True, check=False
            )
            if run.returncode:
                raise SystemExit(f"{golden.name}: {run.stderr[-2000:]}")
            results[golden.name] = {
                f"{path}{place}": value.replace(name, "DIR") if isinstance(value, str) else value
                for path in golden.written
                for place, value in numbers(folder / path).items()
                if re.search(golden.kept, place)
            }
            print(f"{golden.name}: {len(results[golden.name])} values, {_cpu_seconds() - begin:.1f} s", flush=True)
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(json.dumps(results, indent=0) + "\n", encoding="utf-8")


def _cpu_seconds() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def compare(old: Path, new: Path) -> int:
    """Prints every value that differs; returns how many do."""
    before, after = (json.loads(path.read_text(encoding="utf-8")) for path in (old, new))
    differences = 0
    for name, ours in before.items():
        theirs = after.get(name, {})
        rows = [row for place, value in ours.items() if (row := difference(place, value, theirs.get(place)))]
        differences += len(rows)
        print(f"{name}: {len(ours)} values, {len(rows)} differ")
        for row in rows[:20]:
            print(f"  {row}")
    return differences


def difference(place: str, before: float | str, after: float | str | None) -> str | None:
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
