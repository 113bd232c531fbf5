"""Options of a command, made from the fields of its settings class."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import wraps
from pathlib import Path
from typing import Annotated, Any, Literal, get_args, get_origin, get_type_hints

import typer
from pydantic.fields import FieldInfo

from dynssm_ros.api.settings import VerbSettings
from dynssm_ros.errors import ConfigurationError, SettingError

RecordingsArgument = Annotated[
    list[Path],
    typer.Argument(help="Recordings of one car, or folders of a season or of a part of it.", metavar="R.parquet..."),
]
VehicleOption = Annotated[
    str, typer.Option("--vehicle", help="Vehicle: name of a shipped one (orca, av21, ...) or a file.")
]
SignalsOption = Annotated[str, typer.Option("--signals", help="Signal map: name of a shipped one or a file.")]
ModelFileOption = Annotated[
    str, typer.Option("--model", help="Model: name of a shipped one (dynssm, rls, ridge, ...) or a file.")
]
CourseOption = Annotated[
    str,
    typer.Option("--track", help="Track: oval, road_course, club, club_b, or a file x_m,y_m,w_tr_right_m,w_tr_left_m."),
]
JsonOption = Annotated[Path | None, typer.Option("--json", help="Also write the result as JSON.", dir_okay=False)]


def with_settings(schema: type[VerbSettings]) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Gives a command an option for each field of ``schema``, and their values as its parameter ``settings``."""

    def decorated(command: Callable[..., None]) -> Callable[..., None]:
        hints = get_type_hints(command, include_extras=True)
        own = [
            each.replace(annotation=hints[each.name], kind=inspect.Parameter.KEYWORD_ONLY)
            for each in inspect.signature(command).parameters.values()
            if each.name != "settings"
        ]
        names = sorted(schema.model_fields, key=lambda name: name not in schema.__annotations__)  # shared ones last
        fields = [_parameter(name, schema.model_fields[name]) for name in names]

        @wraps(command)
        def run(**given: Any) -> None:
            chosen = {name: given.pop(name) for name in schema.model_fields}
            for name, field in schema.model_fields.items():
                if _shown(field)["milliseconds"]:
                    chosen[name] /= 1e3
            with as_options(schema):
                command(**given, settings=schema.of({k: value for k, value in chosen.items() if value is not None}))

        del run.__wrapped__
        parameters = [*own, *fields]
        run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
        run.__annotations__ = {each.name: each.annotation for each in parameters}
        return run

    return decorated


@contextmanager
def as_options(schema: type[VerbSettings]) -> Iterator[None]:
    """Errors that name settings name the options instead."""
    try:
        yield
    except SettingError as error:
        text = str(error)
        for name in error.names:
            field = schema.model_fields.get(name)
            text = re.sub(rf"(?<![\w-]){name}(?!\w)", option_of(name, field).split("/")[0], text, count=1)
        raise ConfigurationError(text) from error


def option_of(name: str, field: FieldInfo | None = None) -> str:
    """The option of a field, ``--on/--off`` for some that are true or false."""
    given = "" if field is None else _shown(field)["option"]
    return given or f"--{name.replace('_', '-')}"


def _shown(field: FieldInfo) -> dict[str, Any]:
    extra = field.json_schema_extra
    assert isinstance(extra, dict)  # fields are made by `setting`
    return extra


def _parameter(name: str, field: FieldInfo) -> inspect.Parameter:
    """The parameter from which typer makes the option of a field."""
    shown = _shown(field)
    kind, default = _kind(field)
    help_text = field.description or ""
    if shown["milliseconds"]:
        help_text, default = help_text.replace("(s)", "(ms)"), 1e3 * default
    option = typer.Option(
        option_of(name, field),
        help=help_text,
        show_default=shown["otherwise"] or True,
        min=_limit(field, "ge"),
        max=_limit(field, "le"),
        metavar="NAME[:k=v,...]" if shown["option"] == "--effect" else None,
    )
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=Annotated[kind, option])


def _limit(field: FieldInfo, name: Literal["ge", "le"]) -> float | None:
    """The least or largest value of a field, as pydantic keeps it."""
    return next((getattr(each, name) for each in field.metadata if hasattr(each, name)), None)


def _kind(field: FieldInfo) -> tuple[Any, Any]:
    """Type and default of an option: the field's, but text for what a text serves for."""
    kind, default = field.annotation, field.default
    if get_origin(kind) is dict or (get_origin(kind) is tuple and get_args(kind)[-1] is Ellipsis):
        return list[str] | None, None
    if get_origin(kind) is tuple:
        return str, ",".join(f"{value:g}" for value in default)
    if kind is Any:
        return str | None, default
    return kind, default
