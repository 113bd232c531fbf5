"""The Python API: its examples run as written, importing it costs nothing, and each option is declared once."""

from __future__ import annotations

import doctest
import importlib
import inspect
import os
import subprocess
import sys
from pathlib import Path

import pytest
from pydantic import ValidationError
from typer.main import get_command

import dynssm_ros
from dynssm_ros import api
from dynssm_ros.api.settings import VerbSettings
from dynssm_ros.cli.main import app
from dynssm_ros.cli.options import option_of
from dynssm_ros.errors import SettingError

FINDER = doctest.DocTestFinder(exclude_empty=True)
EXAMPLES = {
    name: test
    for name in api.__all__
    for test in FINDER.find(getattr(api, name), name, module=False, globs=dict(vars(api)))
    if test.examples
}
COMMANDS = get_command(app).commands  # type: ignore[attr-defined]
COMMAND_OF = {"new_vehicle": "vehicle", "review_season": "season", "extract_season": "extract"}
SCHEMAS: dict[str, type[VerbSettings]] = {
    name: getattr(importlib.import_module(function.__module__), function.__wrapped__.__annotations__["settings"])
    for name, function in ((name, getattr(api, name)) for name in api.__all__)
    if "settings" in inspect.signature(function).parameters
}


@pytest.mark.parametrize("name", sorted(EXAMPLES))
def test_the_example_of_a_function_runs(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    failures = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS).run(EXAMPLES[name], clear_globs=False)
    assert failures.failed == 0


def test_every_public_function_has_an_example() -> None:
    assert {*api.__all__} == {*EXAMPLES}
    assert {*api.__all__} - {"inspect"} <= {*dynssm_ros.__all__}


def test_the_names_are_there_and_importing_the_package_loads_nothing_heavy() -> None:
    assert {
        "Recording",
        "load_vehicle",
        "load_model",
        "extract",
        "calibrate",
        "train",
        "evaluate",
        "diagnose",
        "race",
    } <= {*dynssm_ros.__all__}
    script = "import sys, dynssm_ros; print(sorted({'numpy', 'torch', 'scipy', 'casadi', 'rclpy'} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True, env=os.environ)
    assert done.stdout.strip() == "[]"
    with pytest.raises(AttributeError, match="no attribute 'magic'"):
        _ = dynssm_ros.magic


def test_all_commands_but_inspect_have_settings() -> None:
    assert {*COMMANDS} - {COMMAND_OF.get(name, name) for name in SCHEMAS} == {"inspect"}


@pytest.mark.parametrize("name", sorted(SCHEMAS))
def test_an_option_is_a_field_and_a_keyword(name: str) -> None:
    schema, function = SCHEMAS[name], getattr(api, name)
    options = {each.name: each for each in COMMANDS[COMMAND_OF.get(name, name)].params}
    parameters = inspect.signature(function).parameters
    for field, about in schema.model_fields.items():
        assert about.description, f"{name}: {field} has no help"
        assert option_of(field, about).split("/")[0] in options[field].opts, f"{name}: {field} is no option"
        assert parameters[field].kind is inspect.Parameter.KEYWORD_ONLY, f"{name}: {field} is no keyword"
    with pytest.raises(SettingError, match="no setting 'horizont'; expected one of"):
        function(*["x"] * sum(each.default is each.empty for each in parameters.values()), horizont=1.0)
    with pytest.raises(ValidationError, match="frozen"):
        setattr(schema(), next(iter(schema.model_fields)), None)


def test_what_a_setting_may_be_is_checked_and_named_as_it_was_given(
    dynssm, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SettingError, match=r"^holdout: .*less than or equal to 0.9"):
        api.calibrate("laps.parquet", "orca", holdout=2.0)
    status, _, err = dynssm(
        "calibrate", "laps.parquet", "--vehicle", "orca", "--out", tmp_path / "x.yaml", "--holdout", 2
    )
    assert status == 1
    assert "--holdout" in err
    assert len(err.strip().splitlines()) == 1


@pytest.mark.parametrize("noise", [(-1.0, 0.0, 0.0), "0,nan,0", (0.1, 0.1), 0.1])
def test_noise_is_three_finite_numbers_as_text_and_as_numbers(noise: object) -> None:
    with pytest.raises(SettingError, match=r"^noise: expected (three|finite) numbers"):
        api.simulate("orca", "club", noise=noise)


@pytest.mark.parametrize(
    "effects", ["drag:coefficient=0.001", ["drag:coefficient=0.001"], {"drag": {"coefficient": 0.001}}]
)
def test_effects_are_named_by_texts_and_by_values(effects: object) -> None:
    assert SCHEMAS["simulate"].of({"effects": effects}).effects == {"drag": {"coefficient": 0.001}}
