"""Model folders: what is written is read, and each way of damage is one clear line."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
import yaml
from safetensors.numpy import load_file, save_file

from dynssm_ros.errors import ArtifactError
from dynssm_ros.files import checksum
from dynssm_ros.runtime.artifact import (
    CARD,
    FORMAT_VERSION,
    METRICS,
    ONNX,
    WEIGHTS,
    open_artifact,
    read_card,
    read_folder,
)
from dynssm_ros.runtime.artifact import write_card as write
from dynssm_ros.runtime.onnx_model import OnnxModel


@pytest.fixture
def folder(small_model: Path, tmp_path: Path) -> Path:
    """A copy of the small model, to spoil."""
    return shutil.copytree(small_model, tmp_path / "model")


def change_card(folder: Path, change: Callable[[dict[str, Any]], None]) -> None:
    content = yaml.safe_load((folder / CARD).read_text())
    change(content)
    (folder / CARD).write_text(yaml.safe_dump(content))


def certify(folder: Path) -> None:
    """Makes the card's checksums those of the files, as somebody would who changes them on purpose."""
    change_card(folder, lambda card: card.update(checksums={n: checksum(folder / n) for n in (WEIGHTS, ONNX, METRICS)}))


def refusal(folder: Path, use: Callable[[Path], object] = open_artifact) -> str:
    """The one line with which ``folder`` is refused."""
    with pytest.raises(ArtifactError) as refused:
        use(folder)
    assert str(folder) in str(refused.value)
    assert "\n" not in str(refused.value)
    return str(refused.value)


def deploy(folder: Path) -> OnnxModel:
    return OnnxModel(open_artifact(folder))


def test_a_card_is_read_as_it_was_written(small_model: Path, tmp_path: Path) -> None:
    card = open_artifact(small_model).card
    write(card, tmp_path)
    assert read_card(tmp_path) == card
    assert card.format_version == FORMAT_VERSION


def test_a_folder_that_is_not_there_says_how_to_make_one(tmp_path: Path) -> None:
    assert refusal(tmp_path / "none").endswith("no such model folder; `dynssm train` writes one")


@pytest.mark.parametrize("name", [CARD, WEIGHTS, ONNX, METRICS])
def test_a_changed_or_missing_file_is_named(folder: Path, name: str) -> None:
    if name != CARD:
        content = bytearray((folder / name).read_bytes())
        content[len(content) // 2] ^= 1
        (folder / name).write_bytes(content)
        assert f"{name}: does not match its checksum in {CARD}; damaged or exchanged" in refusal(folder)
    (folder / name).unlink()
    assert f"incomplete model folder, {name} is missing" in refusal(folder)


def test_a_newer_format_is_refused_before_its_fields_are_judged(folder: Path) -> None:
    change_card(folder, lambda card: card.update(format_version=FORMAT_VERSION + 1, new_field=1))
    assert f"format_version {FORMAT_VERSION + 1} is newer than this package reads ({FORMAT_VERSION})" in refusal(folder)


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (lambda card: card.update(format_version=0), "format_version: Input should be greater than or equal to 1"),
        (lambda card: card.update(format_version="new"), "format_version: Input should be a valid integer"),
        (lambda card: card.pop("sampling_time"), "sampling_time: Field required"),
        (lambda card: card.update(sampling_time=-0.02), "sampling_time: Input should be greater than 0 (got -0.02)"),
        (lambda card: card.update(window="five"), "window: Input should be a valid integer"),
        (lambda card: card.update(surprise=1), "surprise: Extra inputs are not permitted (got 1)"),
        (lambda card: card.update(commands="guessed"), "commands: Input should be 'topics', 'lookahead' or 'none'"),
        (lambda card: card["columns"].reverse(), "columns ('delta_cmd',"),
        (lambda card: card["normalisation"]["input_std"].__setitem__(3, 0.0), "input_std must be positive everywhere"),
        (lambda card: card["normalisation"]["input_mean"].pop(), "normalisation.input_mean"),
        (lambda card: card["covariance"].__setitem__(1, float("nan")), "covariance.1: Input should be a finite number"),
        (lambda card: card["covariance"].__setitem__(1, 0.0), "covariance.1: Input should be greater than 0"),
        (lambda card: card.update(sampling_time=0.08), "sampling_time 0.08 s is not the vehicle's (0.02 s)"),
        (lambda card: card["vehicle"]["coefficients"].pop("B_f"), "missing B_f"),
        (
            lambda card: card["vehicle"]["constants"].update(m=0.0),
            "vehicle.constants.m: Input should be greater than 0",
        ),
        (
            lambda card: card["checksums"].pop(ONNX),
            "checksums ['metrics.json', 'weights.safetensors'] are not those of",
        ),
        (lambda card: card["checksums"].update({"../secret": "0"}), "are not those of"),
    ],
)
def test_a_card_that_does_not_fit_is_refused_by_field(
    folder: Path, change: Callable[[dict[str, Any]], None], expected: str
) -> None:
    change_card(folder, change)
    assert expected in refusal(folder)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("name: [", "not valid YAML"),
        ("- a list", "expected a mapping of fields, got list"),
        ("", "expected a mapping of fields, got NoneType"),
        ("!!python/object/apply:os.mkdir [executed]", "not valid YAML"),
    ],
)
def test_a_card_that_is_no_mapping_is_refused_and_nothing_is_executed(
    folder: Path, monkeypatch: pytest.MonkeyPatch, text: str, expected: str
) -> None:
    monkeypatch.chdir(folder.parent)
    (folder / CARD).write_text(text)
    assert expected in refusal(folder)
    assert not (folder.parent / "executed").exists()


BOMB = "a0: &a0 [x,x,x,x,x,x,x,x,x]\n" + "".join(
    f"a{k}: &a{k} [{','.join([f'*a{k - 1}'] * 9)}]\n" for k in range(1, 12)
)
MERGED = "a0: &a0 {a: 1, b: 2}\n" + "".join(
    f"a{k}: &a{k} {{<<: [{', '.join([f'*a{k - 1}'] * 9)}]}}\n" for k in range(1, 12)
)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (BOMB, "more than 50 levels or 100000 values"),
        (MERGED, "more than 50 levels or 100000 values"),
        ("name: " + "[" * 5000 + "]" * 5000, "more than 50 levels"),
        ("name: " + "[" * 200_000 + "]" * 200_000, "more than 50 levels"),
        ("- " * 5000, "more than 50 levels"),
        ("".join(f"k{k}: 1\n" for k in range(40_000)), "name: Field required"),
        ("#" * (1 << 20) + "\n", "expected a file of at most 1048576"),
    ],
    ids=["aliases", "merged aliases", "deep", "deeper", "deep lines", "many fields", "large"],
)
@pytest.mark.timeout(10)
def test_a_card_that_would_take_for_ever_is_refused_at_once(folder: Path, text: str, expected: str) -> None:
    (folder / CARD).write_text(text)
    assert expected in refusal(folder)


def test_a_card_may_repeat_itself_by_aliases(folder: Path) -> None:
    change_card(folder, lambda card: card.update(training={"a": (same := {"b": [1, 2]}), "c": same}))
    assert "&id001" in (folder / CARD).read_text()
    assert open_artifact(folder).card.training["c"] == {"b": [1, 2]}


@pytest.mark.parametrize("name", [CARD, WEIGHTS, ONNX])
def test_what_is_no_file_or_too_large_is_refused_unread(folder: Path, name: str) -> None:
    with (folder / name).open("ab") as content:
        content.truncate(30 * 10**9)
    assert f"{name}: 30000000000 bytes; expected a file of at most" in refusal(folder)
    (folder / name).unlink()
    os.mkfifo(folder / name)
    assert f"{name}: 0 bytes; expected a file" in refusal(folder)
    (folder / name).unlink()
    (folder / name).symlink_to("/dev/zero")
    assert f"{name}: 0 bytes; expected a file" in refusal(folder)


@pytest.mark.parametrize("name", ["m" * 256, "/a" * 2500, "\0"])
def test_names_that_no_folder_can_have_are_none(name: str) -> None:
    with pytest.raises(ArtifactError, match="no such model folder"):
        open_artifact(name)


def test_links_out_of_the_root_are_refused_and_those_inside_it_followed(folder: Path, small_model: Path) -> None:
    content = read_folder(folder, str(folder.parent))
    (folder / ONNX).rename(folder.parent / "shared.onnx")
    (folder / ONNX).symlink_to("../shared.onnx")
    assert read_folder(folder, str(folder.parent)) == content
    (folder / ONNX).unlink()
    (folder / ONNX).symlink_to(small_model / ONNX)
    assert read_folder(folder) == content
    assert "model.onnx: is a link out of" in refusal(folder, lambda path: read_folder(path, str(folder.parent)))


def test_what_was_checked_is_what_runs_though_the_file_is_exchanged_meanwhile(folder: Path) -> None:
    window = np.random.default_rng(0).normal(size=(1, 5, 7))
    expected, artifact = deploy(folder).predict(window).state, open_artifact(folder)
    (folder / ONNX).write_bytes(b"another graph")
    np.testing.assert_array_equal(OnnxModel(artifact).predict(window).state, expected)


@pytest.mark.parametrize("location", ["weights.safetensors", "../secret", "/etc/passwd"])
def test_a_graph_reads_no_other_files(folder: Path, location: str) -> None:
    graph = onnx.load(folder / ONNX)
    tensor = max(graph.graph.initializer, key=lambda each: len(each.raw_data))
    size = len(tensor.raw_data)
    (folder.parent / "secret").write_bytes(tensor.raw_data)
    onnx.external_data_helper.set_external_data(tensor, location, offset=0, length=size)
    tensor.ClearField("raw_data")
    (folder / ONNX).write_bytes(graph.SerializeToString())
    certify(folder)
    assert "ONNX Runtime refuses it" in refusal(folder, deploy)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_weight_that_is_not_finite_is_named_though_its_checksum_fits(folder: Path, value: float) -> None:
    weights = load_file(folder / WEIGHTS)
    weights["head.deviate.bias"][3] = value
    save_file(weights, folder / WEIGHTS)
    certify(folder)
    assert "weight head.deviate.bias holds NaN or infinity" in refusal(folder)


def test_weights_that_are_no_safetensors_are_refused(folder: Path) -> None:
    (folder / WEIGHTS).write_bytes(b"\x80\x04garbage" * 10)
    certify(folder)
    assert "not a readable safetensors file" in refusal(folder)


@pytest.mark.parametrize(
    "spoil",
    [
        lambda content: b"garbage",
        lambda content: content[:200],
        lambda content: b"",
        lambda content: content.replace(b"increment", b"increm\xf7nt"),
    ],
)
def test_a_graph_that_onnx_runtime_refuses_is_an_error_on_opening(
    folder: Path, spoil: Callable[[bytes], bytes], capfd: pytest.CaptureFixture[str]
) -> None:
    (folder / ONNX).write_bytes(spoil((folder / ONNX).read_bytes()))
    certify(folder)
    assert "ONNX Runtime refuses it" in refusal(folder, deploy)
    assert capfd.readouterr() == ("", "")


def test_the_graph_of_another_model_is_an_error_on_opening(folder: Path) -> None:
    change_card(folder, lambda card: card.update(window=9))
    assert "expected a window of 9 rows and 7 columns" in refusal(folder, deploy)


@pytest.mark.parametrize("count", [1, 3])
def test_a_graph_that_states_variances_is_believed_and_else_those_of_the_validation_data_hold(
    folder: Path, count: int
) -> None:
    windows = np.random.default_rng(0).normal(size=(count, 5, 7))
    windows[..., 0] = 1.0 + np.abs(windows[..., 0])  # forwards, as it was trained
    plain = deploy(folder).predict(windows)
    np.testing.assert_array_equal(plain.variance, np.tile(open_artifact(folder).card.covariance, (count, 1)))

    graph = onnx.load(folder / ONNX)
    graph.graph.node.append(onnx.helper.make_node("Mul", ["increment", "increment"], ["variance"]))
    graph.graph.output.append(onnx.helper.make_tensor_value_info("variance", onnx.TensorProto.FLOAT, ["N", 3]))
    onnx.save(graph, folder / ONNX)
    certify(folder)
    stated = deploy(folder).predict(windows)
    np.testing.assert_allclose(stated.variance, (stated.state - windows[:, -1, :3]) ** 2, rtol=1e-5)
    assert stated.variance.dtype == np.float64
    np.testing.assert_array_equal(stated.state, plain.state)


def test_a_graph_without_the_increment_is_an_error_on_opening(folder: Path) -> None:
    graph = onnx.load(folder / ONNX)
    index = next(k for k, output in enumerate(graph.graph.output) if output.name == "increment")
    del graph.graph.output[index]
    onnx.save(graph, folder / ONNX)
    certify(folder)
    assert "to ['theta', 'physics']" in refusal(folder, deploy)
