"""Settings of the verbs: each option is one field of one class, with unit, range, default and help.

A function of the API takes its inputs by position and the fields of its class as keywords; the command line makes its
options from the same fields.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from functools import wraps
from typing import Annotated, Any

from pydantic import BeforeValidator, Field, ValidationError
from typing_extensions import Self

from dynssm_ros.configuration import StrictModel, describe
from dynssm_ros.errors import SettingError
from dynssm_ros.parallel import Backend, Result, Workers
from dynssm_ros.signals.signal_map import Commands
from dynssm_ros.vehicle.effects import parse_effect


def setting(
    default: Any, description: str, *, option: str = "", otherwise: str = "", milliseconds: bool = False, **limits: Any
) -> Any:
    """A field of a settings class.

    Args:
        default: value if not given.
        description: what it is, with its unit; the help text of the option.
        option: name of the option, if not that of the field.
        otherwise: what holds if not given, in words.
        milliseconds: the option is in ms where the field is in s.
        limits: ``ge``, ``gt``, ``le``, ``lt``.
    """
    shown: dict[str, Any] = {"option": option, "otherwise": otherwise, "milliseconds": milliseconds}
    return Field(default, description=description, json_schema_extra=shown, **limits)


class VerbSettings(StrictModel):
    """Base of all settings."""

    @classmethod
    def of(cls, given: Mapping[str, Any]) -> Self:
        """The settings of keywords.

        Raises:
            SettingError: no such keyword, or a value out of its range.
        """
        for name in given:
            if name not in cls.model_fields:
                raise SettingError(f"no setting '{name}'; expected one of {', '.join(cls.model_fields)}")
        try:
            return cls.model_validate(dict(given))
        except ValidationError as error:
            raise SettingError(describe(error), str(error.errors()[0]["loc"][0])) from error


class CommandsSettings(VerbSettings):
    """The protocol of the command inputs."""

    commands: Commands | None = setting(
        None, "Source of the command inputs; the signal map's or recording's own if not given."
    )


class StrictSettings(VerbSettings):
    """What becomes of signals that cannot be right together."""

    strict: bool = setting(False, "Signals that contradict each other are errors instead of warnings.")


class WorkerSettings(VerbSettings):
    """Where independent pieces of work are done."""

    jobs: int | None = setting(None, "Pieces of work at a time; all that a cluster has if not given, else one.", ge=1)
    backend: Backend = setting("processes", "Where they are done: processes here, or a Ray or Dask cluster.")
    address: str | None = setting(
        None,
        "Of the cluster: Ray's auto or ray://HOST:10001, Dask's tcp://HOST:8786.",
        otherwise="one is started here, for as long as the work takes",
    )

    @property
    def workers(self) -> Workers:
        """These workers."""
        return Workers(self.jobs, self.backend, self.address)


def _three_numbers(given: Any) -> Any:
    try:
        v_x, v_y, omega = (float(part) for part in (given.split(",") if isinstance(given, str) else given))
    except (TypeError, ValueError) as error:
        raise ValueError("expected three numbers, as in 0.02,0.01,0.002") from error
    if not all(0 <= std < float("inf") for std in (v_x, v_y, omega)):
        raise ValueError("expected finite numbers of at least 0")
    return v_x, v_y, omega


def _effects(given: Any) -> Any:
    if isinstance(given, Mapping):
        return given
    return dict(map(parse_effect, [given] if isinstance(given, str) else given or ()))


StandardDeviations = Annotated[tuple[float, float, float], BeforeValidator(_three_numbers)]
"""Of three channels; the text ``0.02,0.01,0.002`` serves too."""
Effects = Annotated[dict[str, dict[str, float]], BeforeValidator(_effects)]
"""Parameters by effect; texts ``NAME:k=v,...`` serve too."""
PLANT_HELP = "euler: one step per T_s, as in the published data; rk4: steps of 1 ms; double_track: four wheels."
# fields of several classes
EFFECTS = setting({}, "Physics that no model knows of; repeatable.", option="--effect")
HOLDOUT = setting(
    None,
    "Leave the last fraction of each recording out, for an evaluation on it.",
    otherwise="what the vehicle file left out of the same recording, else 0",
    ge=0.0,
    le=0.9,
)
EPOCHS = setting(None, "Epochs of each stage, instead of the model file's.", ge=1)
MIN_SPEED = setting(
    None, "Leave out stretches below this speed (m/s).", otherwise="the vehicle file's minimum_speed", ge=0.0
)
NOISE = setting((0.0, 0.0, 0.0), "Standard deviations of the measured v_x,v_y,omega (m/s, m/s, rad/s).")


def keywords(schema: type[VerbSettings]) -> Callable[[Callable[..., Result]], Callable[..., Result]]:
    """Lets a function that takes ``settings`` take the fields of ``schema`` as keywords as well.

    ``inspect.signature`` and ``help`` show the fields. A keyword beside ``settings`` goes before it.
    """

    def decorated(function: Callable[..., Result]) -> Callable[..., Result]:
        own = inspect.signature(function)
        inputs = [parameter for parameter in own.parameters.values() if parameter.name != "settings"]

        @wraps(function)
        def call(*given: Any, settings: VerbSettings | None = None, **named: Any) -> Result:
            mine = {name: named.pop(name) for name in list(named) if name in own.parameters}
            known = {} if settings is None else {name: getattr(settings, name) for name in settings.model_fields_set}
            return function(*given, settings=schema.of(known | named), **mine)

        fields = [
            inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=field.default, annotation=field.annotation)
            for name, field in schema.model_fields.items()
        ]
        whole = own.parameters["settings"].replace(default=None)
        call.__signature__ = own.replace(parameters=[*inputs, *fields, whole])  # type: ignore[attr-defined]
        described = "\n".join(f"    {name}: {field.description}" for name, field in schema.model_fields.items())
        before, args, after = inspect.cleandoc(function.__doc__ or "").partition("\nArgs:\n")
        given, blank, rest = after.partition("\n\n")
        call.__doc__ = f"{before}{args}{given}\n{described}{blank}{rest}"
        return call

    return decorated
