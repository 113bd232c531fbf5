"""Configuration files: found by name or path, read safely, and refused in one line."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from pydantic import Field, model_validator

from dynssm_ros import configuration
from dynssm_ros.configuration import StrictModel, config_root, find_config, load, read_yaml, validate
from dynssm_ros.errors import ConfigurationError, UserError


class Wheel(StrictModel):
    radius: float = Field(gt=0)
    name: str = ""


class Cart(StrictModel):
    wheels: tuple[Wheel, ...]
    sizes: dict[str, float] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _stands(self) -> Cart:
        if len(self.wheels) < 2:
            raise ValueError("a cart with fewer than two wheels falls over")
        return self


def test_the_shipped_configuration_is_found() -> None:
    assert {"vehicles", "signals"} <= {folder.name for folder in config_root().iterdir()}


def test_a_shipped_name_and_a_path_both_serve(tmp_path: Path) -> None:
    shipped = config_root() / "vehicles" / "orca.yaml"
    assert find_config("vehicles", "orca") == shipped
    assert find_config("vehicles", shipped) == shipped
    own = tmp_path / "orca"
    own.write_text("own: 1\n")
    assert find_config("vehicles", own) == own


@pytest.mark.parametrize("name", ["nothing", "", ".", "orca.yaml", "vehicles/orca", "x" * 300, "a\0b"])
def test_a_name_that_is_neither_lists_what_is_shipped(name: str) -> None:
    with pytest.raises(ConfigurationError, match=r"vehicles: '.*' is neither a file nor a shipped name \(.*orca.*\)"):
        find_config("vehicles", name)


def test_configuration_is_found_in_an_ament_prefix(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shared = tmp_path / "install" / "share" / "dynssm_ros" / "config"
    (shared / "vehicles").mkdir(parents=True)
    monkeypatch.setattr(configuration, "__file__", str(tmp_path / "elsewhere" / "dynssm_ros" / "configuration.py"))
    monkeypatch.setattr(configuration.sysconfig, "get_path", lambda _: str(tmp_path / "environment"))
    monkeypatch.setenv("AMENT_PREFIX_PATH", os.pathsep.join(["", str(tmp_path / "other"), str(tmp_path / "install")]))
    assert config_root() == shared


@pytest.mark.parametrize("file", ["/configuration.py", "/dynssm_ros/configuration.py"])
def test_an_installation_without_configuration_says_so(file: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(configuration, "__file__", file)
    monkeypatch.setattr(configuration.sysconfig, "get_path", lambda _: "/nowhere")
    monkeypatch.delenv("AMENT_PREFIX_PATH", raising=False)
    with pytest.raises(ConfigurationError, match="shipped configuration not found"):
        config_root()


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"a: [1", "not valid YAML"),
        (b"a: b: c", "not valid YAML"),
        (b"a: 2023-13-45", "not valid YAML"),
        (b"a: !!python/object/apply:os.getcwd []", "not valid YAML"),
        (b"a: 1\nb: 2\na: 3\n", "'a' is given twice"),
        (b"c: {d: 1, d: 2}\n", "'d' is given twice"),
        (b"[" * 2000, "not valid YAML"),
        (b"\x00", "not valid YAML"),
        (b"\xff\xfe\xff", "cannot be read"),
        (b"", "expected a mapping of fields, got NoneType"),
        (b"- 1\n- 2\n", "expected a mapping of fields, got list"),
        (b"just text", "expected a mapping of fields, got str"),
    ],
)
def test_what_is_not_a_mapping_in_yaml_is_refused_in_one_line(tmp_path: Path, content: bytes, said: str) -> None:
    file = tmp_path / "c.yaml"
    file.write_bytes(content)
    with pytest.raises(ConfigurationError) as caught:
        read_yaml(file)
    assert str(caught.value).startswith(f"{file}: ")
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["missing.yaml", "."])
def test_what_cannot_be_opened_is_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(ConfigurationError, match="cannot be read"):
        read_yaml(tmp_path / name)


def test_anchors_and_merges_still_work(tmp_path: Path) -> None:
    file = tmp_path / "c.yaml"
    file.write_text("base: &b {x: 1, y: 2}\nother: {<<: *b, y: 3}\n")
    assert read_yaml(file)["other"] == {"x": 1, "y": 3}


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ({"wheels": [{"radius": 1.0}, {}]}, "cart: wheels.1.radius: Field required"),
        ({"wheels": [{"radius": 0.0}] * 2}, "cart: wheels.0.radius: Input should be greater than 0 (got 0.0); 1 more"),
        ({"wheels": [{"radius": 1.0, "tyre": 2}] * 2}, "cart: wheels.0.tyre: Extra inputs are not permitted (got 2)"),
        (
            {"wheels": [{"radius": float("nan")}] * 2},
            "cart: wheels.0.radius: Input should be a finite number (got nan)",
        ),
        ({"wheels": [{"radius": 1.0}]}, "cart: a cart with fewer than two wheels falls over"),
        ({"wheels": [], 3: 1}, "cart: "),
        (
            {"wheels": [], "sizes": {"a": "x" * 99}},
            f"cart: sizes.a: Input should be a valid number, .* (got '{'x' * 56}",
        ),
    ],
)
def test_a_violation_names_source_field_and_value(content: dict[str, object], said: str) -> None:
    with pytest.raises(ConfigurationError) as caught:
        validate(Cart, content, "cart")
    beginning, _, end = said.partition(".*")
    assert str(caught.value).startswith(beginning)
    assert end in str(caught.value)
    assert "\n" not in str(caught.value)
    assert isinstance(caught.value, UserError)


def test_a_file_is_found_read_and_validated_in_one_go(tmp_path: Path) -> None:
    file = tmp_path / "cart.yaml"
    file.write_text("wheels: [{radius: 1.0}, {radius: 2, name: left}]\n")
    assert load(Cart, "vehicles", file) == Cart(wheels=(Wheel(radius=1.0), Wheel(radius=2.0, name="left")))
