"""The model folder: what is wrong with one is found when it is opened, in one clear line."""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from safetensors.numpy import load_file, save_file

from dynssm_ros.errors import ArtifactError
from dynssm_ros.runtime.artifact import FORMAT_VERSION, open_artifact
from dynssm_ros.runtime.models import OnnxModel

Damage = Callable[[Path], None]
FILES = ("model.yaml", "weights.safetensors", "model.onnx", "metrics.json")


@pytest.fixture
def folder(small_model: Path, tmp_path: Path) -> Path:
    """A copy to be damaged."""
    return shutil.copytree(small_model, tmp_path / "model")


def edit_card(folder: Path, **changes: Any) -> None:
    card = yaml.safe_load((folder / "model.yaml").read_text())
    (folder / "model.yaml").write_text(yaml.safe_dump(card | changes))


def sign(folder: Path) -> None:
    """Makes the checksums right again, as a careful forger would."""
    sums = {name: hashlib.sha256((folder / name).read_bytes()).hexdigest() for name in FILES[1:]}
    edit_card(folder, checksums=sums)


def poison(folder: Path) -> None:
    weights = load_file(folder / "weights.safetensors")
    name = sorted(weights)[0]
    weights[name] = np.full_like(weights[name], np.nan)
    save_file(weights, folder / "weights.safetensors")
    sign(folder)


def test_a_good_folder_opens_and_says_what_it_is(folder: Path) -> None:
    card = open_artifact(folder).card
    assert (card.name, card.kind, card.window, card.sampling_time, card.commands) == (
        "small",
        "dynssm",
        5,
        0.02,
        "topics",
    )
    assert card.vehicle.name == "orca"
    assert card.training["recordings"] == ["club"]
    assert json.loads((folder / "metrics.json").read_text())["onnx_difference"] <= 1e-5


@pytest.mark.parametrize("name", FILES)
def test_a_missing_file_is_named(folder: Path, name: str) -> None:
    (folder / name).unlink()
    with pytest.raises(ArtifactError, match=f"incomplete model folder, {name} is missing"):
        open_artifact(folder)


@pytest.mark.parametrize("name", FILES[1:])
def test_an_exchanged_or_truncated_file_is_noticed(folder: Path, name: str) -> None:
    (folder / name).write_bytes((folder / name).read_bytes()[:-7])
    with pytest.raises(ArtifactError, match=f"{name}: does not match its checksum"):
        open_artifact(folder)


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (lambda f: edit_card(f, format_version=FORMAT_VERSION + 1), f"{FORMAT_VERSION + 1} is newer than"),
        (lambda f: edit_card(f, window=0), "window: "),
        (lambda f: edit_card(f, colour="red"), "colour: "),
        (lambda f: edit_card(f, columns=["v_x"] * 7), "columns"),
        (lambda f: (f / "model.yaml").write_text("name: ["), "not valid YAML"),
        (poison, "weight .* holds NaN"),
        (lambda f: ((f / "weights.safetensors").write_bytes(b"weights"), sign(f)), "not a readable safetensors file"),
    ],
)
def test_each_damage_is_one_clear_line(folder: Path, damage: Damage, words: str) -> None:
    damage(folder)
    with pytest.raises(ArtifactError, match=words) as caught:
        open_artifact(folder)
    assert "\n" not in str(caught.value)
    assert str(folder) in str(caught.value)


def test_a_graph_that_is_none_is_refused(folder: Path) -> None:
    (folder / "model.onnx").write_bytes(b"no graph")
    sign(folder)
    with pytest.raises(ArtifactError, match="ONNX Runtime refuses it"):
        OnnxModel(open_artifact(folder))


def test_a_graph_of_another_window_is_refused(folder: Path) -> None:
    edit_card(folder, window=6)
    with pytest.raises(ArtifactError, match="expected a window of 6 rows"):
        OnnxModel(open_artifact(folder))


def test_no_folder_at_all_says_how_to_get_one(tmp_path: Path) -> None:
    with pytest.raises(ArtifactError, match="no such model folder; `dynssm train` writes one"):
        open_artifact(tmp_path / "nothing")
