"""Files that others wrote, damaged or edited: each is read as it is or refused in one line, soon and in little memory."""

from __future__ import annotations

import copy
import json
import resource
import shutil
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import yaml
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from dynssm_ros.configuration import config_root
from dynssm_ros.errors import UserError
from dynssm_ros.files import checksum
from dynssm_ros.learning.models.registry import load_model_config
from dynssm_ros.runtime.artifact import CARD, ONNX, open_artifact
from dynssm_ros.runtime.baselines import SingleTrack
from dynssm_ros.runtime.onnx_model import OnnxModel
from dynssm_ros.signals import messages
from dynssm_ros.signals.bags import write_bag
from dynssm_ros.signals.extraction import extract
from dynssm_ros.signals.inspection import inspect
from dynssm_ros.signals.recording import METADATA_KEY, Recording
from dynssm_ros.signals.season import Season
from dynssm_ros.signals.signal_map import SignalMap, load_signal_map
from dynssm_ros.track.tracks import load_track
from dynssm_ros.vehicle import load_vehicle

LONGEST_S, LARGEST_BYTES = 20.0, 1 << 30  # of one file, on a computer that does other things too; of all of a kind
ODD: tuple[Any, ...] = (
    None, True, 0, -1, 1, 2**63, 10**400, 5e-324, 1e308, -1e308, float("nan"), float("inf"), "", "nan", "1e999", "x" * 300,
    "position[0]", "a*b", "../../etc/passwd", "\x00", "ä\u2028\U0001f3ce", "2001-99-99", [], {}, [[]], [None], {"": None},
    [1.0] * 3, [0.5, 0.0], {"name": "power_limit"}, "orca", "default", "euler",
)  # fmt: skip
PLACE = st.integers(0, 1 << 20)
DAMAGE = st.lists(
    st.tuples(PLACE, st.sampled_from(("flip", "set", "cut", "drop", "double")), st.integers(0, 255)),
    min_size=1,
    max_size=4,
)
EDITS = st.lists(
    st.tuples(PLACE, st.sampled_from(("set", "set", "set", "remove", "rename", "add")), st.sampled_from(ODD)),
    min_size=1,
    max_size=4,
)
FEW, MANY, MANY_BAGS = 40, 10_000, 1000  # a bag takes as long as ten other files


def damaged(content: bytes, damage: list[tuple[int, str, int]]) -> bytes:
    """Bytes that are flipped, set, cut off, dropped or doubled."""
    data = bytearray(content)
    for place, how, value in damage:
        at = place % max(len(data), 1)
        if how == "cut":
            del data[at:]
        elif how == "drop":
            del data[at : at + value]
        elif how == "double":
            data[at:at] = data[at : at + value]
        elif data:
            data[at] = value if how == "set" else data[at] ^ 1 << value % 8
    return bytes(data)


def edited(tree: Any, edits: list[tuple[int, str, Any]]) -> Any:
    """What YAML or JSON holds, with values exchanged, left out, added, or under another name."""
    tree = json.loads(json.dumps(tree))
    for place, how, each in edits:
        odd = copy.deepcopy(each)
        places: list[tuple[Any, Any]] = []
        left = [tree]
        while left:
            node = left.pop()
            inner = node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ()
            for key, value in inner:
                places.append((node, key))
                left.append(value)
        if not places:
            return odd
        node, key = places[place % len(places)]
        if how == "remove":
            del node[key]
        elif how == "rename" and isinstance(node, dict):
            node[str(odd)] = node.pop(key)
        elif how == "add" and isinstance(node, list):
            node.insert(key, odd)
        else:
            node[key] = odd
    return tree


@dataclass(frozen=True)
class Kind:
    """A kind of file: what makes one of random numbers at a path, and what opens it."""

    strategy: st.SearchStrategy[Any]
    write: Callable[[Path, Any], None]
    use: Callable[[Path], object]


def text_kind(content: bytes, use: Callable[[Path], object], suffix: str = ".yaml") -> dict[str, Kind]:
    """A YAML or JSON file: damaged, and with other values."""
    tree = yaml.safe_load(content)

    def write(path: Path, edits: Any) -> None:
        path.write_text(yaml.safe_dump(edited(tree, edits)) if suffix == ".yaml" else json.dumps(edited(tree, edits)))

    return {
        "damaged": Kind(DAMAGE, lambda path, damage: _put(path, damaged(content, damage)), use),
        "edited": Kind(EDITS, write, use),
    }


def _put(path: Path, content: bytes) -> None:
    path.write_bytes(content)


def shipped(kind: str, name: str) -> bytes:
    return (config_root() / kind / f"{name}.yaml").read_bytes()


def use_vehicle(path: Path) -> None:
    vehicle = load_vehicle(path)
    model = SingleTrack(vehicle.in_windows)
    window = np.array([[[vehicle.minimum_speed + 1.0, 0.0, 0.0, 0.1, 0.0, 0.0, 0.0]]])
    with warnings.catch_warnings(action="ignore"):
        assert model.predict(window).state.shape == (1, 3)


def use_track(path: Path) -> None:
    track = load_track(path)
    assert np.isfinite(track.clearance(track.centre.points)).all()
    assert np.isfinite(track.length)


def use_recording(path: Path) -> Recording:
    recording = Recording.load(path)
    assert np.isfinite(recording.matrix).all()
    assert len(recording.window_ends(2)) < len(recording)
    assert recording.fingerprints
    return recording


def use_model(path: Path) -> None:
    model = OnnxModel(open_artifact(path))
    assert model.predict(np.zeros((1, model.H, 7))).state.shape == (1, 3)


def vehicles(_: Path, __: Path) -> dict[str, Kind]:
    return text_kind(shipped("vehicles", "av21"), use_vehicle)


def signal_maps(_: Path, __: Path) -> dict[str, Kind]:
    return text_kind(shipped("signals", "av21"), load_signal_map)


def model_files(_: Path, __: Path) -> dict[str, Kind]:
    return text_kind(shipped("models", "dynssm"), load_model_config)


def tracks(_: Path, folder: Path) -> dict[str, Kind]:
    track = load_track("club")
    table = np.column_stack([track.centre.points, track.width_right, track.width_left])[::4]
    rows = [[f"{value:.3f}" for value in row] for row in table.tolist()]

    def write(path: Path, edits: Any) -> None:
        path.write_text("# x_m,y_m,w_tr_right_m,w_tr_left_m\n" + "".join(_line(row) for row in edited(rows, edits)))

    content = "".join(map(_line, rows)).encode()
    return {
        "damaged": Kind(DAMAGE, lambda path, damage: _put(path, damaged(content, damage)), use_track),
        "edited": Kind(EDITS, write, use_track),
    }


def _line(row: Any) -> str:
    return (",".join(map(str, row)) if isinstance(row, list) else str(row)) + "\n"


def recordings(laps: Path, folder: Path) -> dict[str, Kind]:
    original = extract([laps], load_signal_map("default"), 50.0).select(slice(0, 300))
    original.save(folder / "r.parquet")
    content, table = (folder / "r.parquet").read_bytes(), pq.read_table(folder / "r.parquet")
    info = json.loads(table.schema.metadata[METADATA_KEY])

    def use_damaged(path: Path) -> None:
        recording = use_recording(path)
        assert recording.info == original.info
        np.testing.assert_array_equal(recording.matrix, original.matrix)
        np.testing.assert_array_equal(recording.time, original.time)

    def write(path: Path, edits: Any) -> None:
        tree = edited({"info": info, "columns": {name: [] for name in table.column_names}}, edits)
        changed = table
        for name in table.column_names:
            odd = (
                tree["columns"].get(name) if isinstance(tree, dict) and isinstance(tree.get("columns"), dict) else None
            )
            at = changed.column_names.index(name)
            if odd is None:
                changed = changed.remove_column(at)
            elif isinstance(odd, (int, float)):
                values = changed[name].to_numpy().copy()
                with warnings.catch_warnings(action="ignore"):
                    values[len(edits) * 7] = np.float64(min(odd, 1e308)).astype(values.dtype)
                changed = changed.set_column(at, name, pa.array(values))
            elif odd:
                changed = changed.set_column(at, name, pa.array([str(odd)] * len(table)))
        noted = json.dumps(tree["info"] if isinstance(tree, dict) and "info" in tree else tree).encode()
        pq.write_table(changed.replace_schema_metadata({METADATA_KEY: noted}), path)

    return {
        "damaged": Kind(DAMAGE, lambda path, damage: _put(path, damaged(content, damage)), use_damaged),
        "edited": Kind(EDITS, write, use_recording),
    }


def seasons(laps: Path, folder: Path) -> dict[str, Kind]:
    from dynssm_ros import api
    from dynssm_ros.api.season import ExtractSeasonSettings

    season, _ = api.extract_season(
        [laps], folder / "season", "default", settings=ExtractSeasonSettings(rate=50.0, car="a", track="b")
    )
    (manifest,) = season.path.glob("_*.json")

    def use(path: Path) -> None:
        shutil.copyfile(path, manifest)
        for session in Season.load(season.path).sessions.values():
            assert season.file(session.place)

    return text_kind(manifest.read_bytes(), use, ".json")


def bags(_: Path, folder: Path) -> dict[str, Kind]:
    with write_bag(folder / "bag") as bag:
        bag.add_topic(messages.ODOMETRY_TOPIC, messages.ODOMETRY)
        for topic in (messages.FEEDBACK_TOPIC, messages.COMMAND_TOPIC):
            bag.add_topic(topic, messages.JOINT_STATE)
        for k in range(30):
            stamp = 1_700_000_000_000_000_000 + 20_000_000 * k
            bag.write(messages.ODOMETRY_TOPIC, stamp, messages.odometry(stamp, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0)))
            for topic in (messages.FEEDBACK_TOPIC, messages.COMMAND_TOPIC):
                bag.write(topic, stamp, messages.joint_state(stamp, {"throttle": 0.1, "steering": 0.0}))
    (file,) = (folder / "bag").glob("*.mcap")
    content, metadata = file.read_bytes(), yaml.safe_load((folder / "bag" / "metadata.yaml").read_bytes())

    def use(path: Path) -> None:
        recording = extract([path], load_signal_map("default"), 50.0)
        assert np.isfinite(recording.matrix).all()

    def write(path: Path, edits: Any) -> None:
        path.mkdir()
        (path / file.name).write_bytes(content)
        (path / "metadata.yaml").write_text(yaml.safe_dump(edited(metadata, edits)))

    def write_file(path: Path, damage: Any) -> None:
        path.mkdir()
        (path / file.name).write_bytes(damaged(content, damage))

    return {"damaged": Kind(DAMAGE, write_file, use), "edited": Kind(EDITS, write, use)}


def tables(_: Path, folder: Path) -> dict[str, Kind]:
    t = np.arange(0.0, 3.0, 0.02)
    columns = {
        "t": t,
        "vx": 3.0 + t,
        "vy": 0.0 * t,
        "yaw_rate": np.cos(t),
        "steering": np.sin(t) / 3,
        "throttle": 0.4 + 0 * t,
    }
    rows = [[f"{value:.3f}" for value in row] for row in np.column_stack(list(columns.values())).tolist()]
    text = [list(columns), *rows]
    (folder / "csv").write_text("".join(map(_line, text)))
    pq.write_table(pa.table(columns), folder / "parquet", write_page_checksum=True)
    with (folder / "npz").open("wb") as file:
        np.savez_compressed(file, **columns)
    contents = {name: (folder / name).read_bytes() for name in ("csv", "parquet", "npz")}
    mapped = SignalMap.model_validate(yaml.safe_load(inspect(folder / "csv").signal_map()))

    def use(path: Path) -> None:
        assert inspect(path).topics
        assert np.isfinite(extract([path], mapped, 50.0, drop_bad=True).matrix).all()

    def write(path: Path, what: Any) -> None:
        name, damage = what
        path.write_bytes(damaged(contents[name], damage))

    def write_cells(path: Path, edits: Any) -> None:
        path.write_text("".join(map(_line, edited(text, edits))), errors="replace")

    damage = st.tuples(st.sampled_from(list(contents)), DAMAGE)
    return {"damaged": Kind(damage, write, use), "edited": Kind(EDITS, write_cells, use)}


def model_folders(model: Path, _: Path) -> dict[str, Kind]:
    card = yaml.safe_load((model / CARD).read_bytes())
    names = sorted(path.name for path in model.iterdir())

    def write(path: Path, what: Any) -> None:
        """A file of the folder is damaged, or the card edited; its checksums may be made to fit, but not for the graph.

        That may take any time and memory then, for which a trial has limits.
        """
        name, damage, edits, fitting = what
        shutil.copytree(model, path)
        file = path / name
        file.write_bytes(damaged(file.read_bytes(), damage))
        tree = card
        if fitting and name not in (CARD, ONNX):
            tree = card | {"checksums": {each: checksum(path / each) for each in card["checksums"]}}
        if edits:
            tree = edited(tree, edits)
        if name != CARD:
            (path / CARD).write_text(yaml.safe_dump(tree))

    files = [name for name in names if name.endswith((".yaml", ".json", ".safetensors", ".onnx"))]
    damage = st.tuples(st.sampled_from(files), DAMAGE, st.just([]), st.booleans())
    edits = st.tuples(st.just("metrics.json"), st.just([]), EDITS, st.just(True))
    return {"damaged": Kind(damage, write, use_model), "edited": Kind(edits, write, use_model)}


KINDS = {
    "vehicle": vehicles, "signals": signal_maps, "model file": model_files, "track": tracks, "recording": recordings,
    "season": seasons, "bag": bags, "table": tables, "model folder": model_folders,
}  # fmt: skip


@pytest.mark.parametrize("many", [False, pytest.param(True, marks=[pytest.mark.slow, pytest.mark.timeout(7200)])])
@pytest.mark.parametrize("form", ["damaged", "edited"])
@pytest.mark.parametrize("name", list(KINDS))
def test_a_file_from_outside_is_read_or_refused_in_one_line(
    name: str, form: str, many: bool, laps_bag: Path, small_model: Path, tmp_path: Path
) -> None:
    kind = KINDS[name](small_model if name == "model folder" else laps_bag, tmp_path)[form]
    target = tmp_path / {"recording": "f.parquet", "track": "f.csv", "table": "f.csv"}.get(name, "f.yaml")
    if name in ("bag", "model folder"):
        target = tmp_path / "folder"
    refusals: list[str] = []
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    count = MANY_BAGS if many and name == "bag" else MANY if many else FEW

    @settings(max_examples=count, suppress_health_check=list(HealthCheck), phases=[Phase.generate])
    @given(kind.strategy)
    def check(changes: Any) -> None:
        shutil.rmtree(target, ignore_errors=True)
        kind.write(target, changes)
        begin = time.perf_counter()
        try:
            kind.use(target)
        except UserError as error:
            refusals.append(str(error))
        assert time.perf_counter() - begin < LONGEST_S

    check()
    assert refusals
    assert all(words.strip() and "\n" not in words for words in refusals)
    assert 1024 * (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) < LARGEST_BYTES
