"""Models that are to be swapped in: another car's and absurd ones are refused, and none takes more than its share."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import onnx
import pytest
import yaml
from onnx import TensorProto, helper, numpy_helper

from dynssm_ros.errors import ArtifactError
from dynssm_ros.files import checksum
from dynssm_ros.runtime.artifact import CARD, METRICS, ONNX, WEIGHTS, ModelCard, open_artifact, read_folder
from dynssm_ros.runtime.bounded import ask
from dynssm_ros.runtime.contract import WindowPrediction
from dynssm_ros.runtime.graph import _REPEATING, try_graph
from dynssm_ros.runtime.onnx_model import OnnxModel
from dynssm_ros.runtime.trial import judge, require_same_use, try_model
from dynssm_ros.signals.extraction import extract
from dynssm_ros.signals.signal_map import load_signal_map
from dynssm_ros.vehicle import load_vehicle


@pytest.fixture(scope="module")
def rows(laps_bag: Path) -> np.ndarray:
    """Six seconds of driving."""
    return extract([laps_bag], load_signal_map("default"), 50.0).matrix[200:500]


@pytest.fixture
def model(small_model: Path) -> OnnxModel:
    return OnnxModel(open_artifact(small_model))


def refusal(use: Callable[[], None]) -> str:
    with pytest.raises(ArtifactError) as refused:
        use()
    assert "\n" not in str(refused.value)
    return str(refused.value)


def test_a_model_is_good_enough_for_the_drive_that_it_was_trained_on(model: OnnxModel, rows: np.ndarray) -> None:
    assert judge(model, model.card, rows)
    assert not judge(model, model.card, rows[:3]), "hardly driven yet"
    assert not judge(model, model.card, rows[:0])


def spoilt(model: OnnxModel, monkeypatch: pytest.MonkeyPatch, change: Callable[..., WindowPrediction]) -> OnnxModel:
    well = model.predict
    monkeypatch.setattr(model, "predict", lambda windows: change(windows, well(windows)))
    return model


def test_errors_many_times_those_of_the_calibrated_car_are_refused(
    model: OnnxModel, rows: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    def farther(windows: np.ndarray, said: WindowPrediction) -> WindowPrediction:
        now = windows[:, -1, :3]
        return said._replace(state=now + 8.0 * (said.state - now))

    words = refusal(lambda: judge(spoilt(model, monkeypatch, farther), model.card, rows))
    assert "its error of " in words
    assert "that of the calibrated car" in words
    judge(model, model.card, rows[:0])  # but who can tell before it drives


def test_a_model_that_cannot_keep_up_is_refused_and_a_slow_one_compared_over_less(
    model: OnnxModel, rows: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    times = iter(np.arange(0.0, 1e3, 0.015))
    monkeypatch.setattr("dynssm_ros.runtime.trial.time.perf_counter", lambda: next(times))
    judge(model, model.card, rows)
    times = iter(np.arange(0.0, 1e3, 0.025))
    assert "takes 0.025 s for a prediction; expected less than T_s" in refusal(lambda: judge(model, model.card, rows))


@pytest.mark.parametrize("driven", [300, 0])
@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"state": np.full((1, 3), 1e29)}, "predicted v_x = 1e+29; expected -"),
        ({"state": np.full((1, 3), np.nan)}, "what it predicts is not finite"),
        ({"variance": np.array([[1.0, -1e-4, 1.0]])}, "predicted variance -0.0001; expected more than zero"),
        ({"theta": np.full((1, 17), 1e3)}, "= 1000; expected"),
    ],
)
def test_what_the_car_cannot_do_is_refused(
    model: OnnxModel, rows: np.ndarray, monkeypatch: pytest.MonkeyPatch, change: dict, expected: str, driven: int
) -> None:
    ill = spoilt(model, monkeypatch, lambda _, said: said._replace(**change))
    assert expected in refusal(lambda: judge(ill, model.card, rows[:driven]))


def changed(card: ModelCard, **constants: float) -> ModelCard:
    car = card.vehicle
    return card.model_copy(
        update={"vehicle": car.model_copy(update={"constants": car.constants.model_copy(update=constants)})}
    )


def test_a_model_of_another_car_or_another_sampling_time_is_refused(model: OnnxModel) -> None:
    card, own = model.card, model.card.vehicle.constants
    require_same_use(model, changed(card, m=1.2 * own.m, l_f=1.05 * own.l_f))  # another driver, a full tank
    for other, expected in (
        (changed(card, m=1.4 * own.m), "kg is another car's"),
        (changed(card, l_f=1.5 * own.l_f), "wheelbase"),
        (card.model_copy(update={"sampling_time": 0.04}), "T_s = 0.02 s is another car's"),
        (card.model_copy(update={"vehicle": load_vehicle("av21"), "sampling_time": 0.04}), "T_s"),
        (card.model_copy(update={"commands": "none"}), "trained with commands 'topics'"),
    ):
        words = refusal(lambda other=other: require_same_use(model, other))
        assert expected in words
        assert "restart it with this model" in words


def edited(small_model: Path, folder: Path, edit: Callable[[onnx.GraphProto], None]) -> Path:
    """A model folder whose increment passes through more nodes, from ``raw``."""
    shutil.copytree(small_model, folder)
    graph = onnx.load(folder / ONNX)
    for node in graph.graph.node:
        node.output[:] = ["raw" if name == "increment" else name for name in node.output]
    edit(graph.graph)
    onnx.save(graph, folder / ONNX)
    card = yaml.safe_load((folder / CARD).read_text())
    card["checksums"] = {name: checksum(folder / name) for name in (WEIGHTS, ONNX, METRICS)}
    (folder / CARD).write_text(yaml.safe_dump(card))
    return folder


def constants(graph: onnx.GraphProto, **values: np.ndarray) -> None:
    graph.initializer.extend(numpy_helper.from_array(value, name) for name, value in values.items())


def endless(graph: onnx.GraphProto) -> None:
    """A loop of as many rounds as the window says, in a branch."""
    ports = [("i", TensorProto.INT64), ("go", TensorProto.BOOL), ("v", TensorProto.FLOAT)]
    inputs = [helper.make_tensor_value_info(name, kind, []) for name, kind in ports]
    outputs = [helper.make_tensor_value_info(f"{name}_out", kind, []) for name, kind in ports[1:]]
    nodes = [helper.make_node(kind, [name], [f"{name}_out"]) for kind, name in (("Identity", "go"), ("Sin", "v"))]
    constants(graph, one=np.array(1, np.float32), begin=np.array(True), zero=np.array(0, np.float32))
    body = helper.make_graph(nodes, "body", inputs, outputs)
    loop = helper.make_node("Loop", ["rounds", "begin", "zero"], ["turned"], body=body)
    turned = [helper.make_tensor_value_info("turned", TensorProto.FLOAT, [])]
    other = helper.make_node("Identity", ["zero"], ["turned"])
    graph.node.extend(
        [
            helper.make_node("ReduceMax", ["window"], ["fastest"], keepdims=0),
            helper.make_node("Greater", ["fastest", "one"], ["fast"]),
            helper.make_node("Cast", ["fastest"], ["rounds"], to=TensorProto.INT64),
            helper.make_node(
                "If",
                ["fast"],
                ["result"],
                then_branch=helper.make_graph([loop], "then", [], turned),
                else_branch=helper.make_graph([other], "else", [], turned),
            ),
            helper.make_node("Add", ["raw", "result"], ["increment"]),
        ]
    )


def slow(graph: onnx.GraphProto) -> None:
    """Products of large matrices, a thousand times."""
    constants(graph, shape=np.array([2000, 2000]))
    graph.node.append(helper.make_node("ConstantOfShape", ["shape"], ["m0"]))
    graph.node.extend(helper.make_node("MatMul", ["m0", f"m{k}"], [f"m{k + 1}"]) for k in range(1000))
    graph.node.append(helper.make_node("ReduceSum", ["m1000"], ["sum"], keepdims=0))
    graph.node.append(helper.make_node("Add", ["raw", "sum"], ["increment"]))


def vast(graph: onnx.GraphProto) -> None:
    """A tensor of 20 GB."""
    constants(graph, shape=np.array([5000, 1000, 1000]))
    graph.node.append(helper.make_node("ConstantOfShape", ["shape"], ["zeros"]))
    graph.node.append(helper.make_node("ReduceSum", ["zeros"], ["sum"], keepdims=0))
    graph.node.append(helper.make_node("Add", ["raw", "sum"], ["increment"]))


@pytest.mark.timeout(60)
def test_a_good_model_passes_in_its_own_process(small_model: Path, model: OnnxModel, rows: np.ndarray) -> None:
    try_model(small_model, read_folder(small_model), model.card, rows)
    words = refusal(lambda: try_model(small_model, {}, model.card, rows))
    assert words.endswith("incomplete model folder, model.yaml is missing")


@pytest.mark.timeout(60)
@pytest.mark.parametrize(
    ("edit", "expected"), [(slow, "takes too long or too much memory"), (vast, "ONNX Runtime refuses it")]
)
def test_a_model_that_would_take_all_time_or_memory_ends_its_trial_alone(
    small_model: Path, tmp_path: Path, model: OnnxModel, rows: np.ndarray, edit: Callable[..., None], expected: str
) -> None:
    folder = edited(small_model, tmp_path / "evil", edit)
    assert expected in refusal(lambda: try_model(folder, read_folder(folder), model.card, rows))


@pytest.mark.timeout(60)
def test_the_graph_of_a_first_model_is_opened_in_its_own_process(small_model: Path, vast_model: Path) -> None:
    def use(folder: Path, rows: int = 5) -> None:
        artifact = open_artifact(folder)
        try_graph(artifact.onnx, artifact.graph, rows, 7)

    use(small_model)
    assert "maps [('window', [5, 7])]" in refusal(lambda: use(small_model, rows=6))
    assert "model.onnx: cannot be used (MemoryError: " in refusal(lambda: use(small_model, rows=10**9))
    assert refusal(lambda: use(vast_model)).startswith(f"{vast_model / ONNX}: ONNX Runtime refuses it (")


@pytest.mark.timeout(60)
def test_opening_a_graph_leaves_no_telemetry_at_home(small_model: Path, tmp_path: Path) -> None:
    script = """import sys, dynssm_ros.runtime.artifact as artifact, dynssm_ros.runtime.onnx_model as onnx_model
onnx_model.OnnxModel(artifact.open_artifact(sys.argv[1]))"""
    kept = {
        name: value for name, value in os.environ.items() if name not in ("ORT_DISABLE_TELEMETRY", "XDG_CACHE_HOME")
    }
    subprocess.run([sys.executable, "-c", script, small_model], env=kept | {"HOME": str(tmp_path)}, check=True)
    assert list(tmp_path.iterdir()) == []


def test_a_trial_whose_process_ends_lasts_or_does_not_begin_is_a_refusal(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def words() -> str:
        return refusal(lambda: ask("no_such_module", tmp_path)).removeprefix(f"{tmp_path}: ")

    assert words() == "the process that tried it ended with status 1"
    monkeypatch.setattr("dynssm_ros.runtime.bounded.TIME_LIMIT_S", 1e-3)
    assert words() == "takes too long or too much memory; expected an answer within 0.001 s"
    monkeypatch.setattr("sys.executable", str(tmp_path / "python"))
    assert words() == "cannot be tried in a process of its own (No such file or directory)"


def test_a_model_whose_inputs_say_how_long_it_runs_is_refused_unopened(
    small_model: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = edited(small_model, tmp_path / "evil", endless)
    words = refusal(lambda: OnnxModel(open_artifact(folder)))
    assert words == f"{folder / ONNX}: has the operator Loop, which may never end; expected none"
    monkeypatch.setattr("dynssm_ros.runtime.graph._REPEATING", re.compile(b"no such operator"))
    OnnxModel(open_artifact(folder))  # nothing else is wrong with it


@pytest.mark.parametrize("start", [b'"', b"\xa2\x00", b"\xa2\x80\x80\x00"])
@pytest.mark.parametrize("name", [b"\x04Scan", b"\x84\x00Scan", b"\x0bSequenceMap", b"\x8b\x80\x00SequenceMap"])
def test_such_operators_are_known_however_the_format_writes_their_length(start: bytes, name: bytes) -> None:
    assert _REPEATING.search(b"\n\x01x" + start + name)
    assert not _REPEATING.search(b"\n\x01x\x1a" + name)  # what is called so
