"""Entry point of ``dynssm``: registers the subcommands and turns user errors into one line and exit status 1."""

from __future__ import annotations

import ctypes
import os
import sys
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, cast

import typer
from rich.markup import escape

from dynssm_ros import __version__
from dynssm_ros.cli.calibrate import calibrate
from dynssm_ros.cli.console import errors, warn
from dynssm_ros.cli.diagnose import diagnose
from dynssm_ros.cli.evaluate import evaluate
from dynssm_ros.cli.export import export
from dynssm_ros.cli.extract import extract
from dynssm_ros.cli.inspect import inspect
from dynssm_ros.cli.learn import learn
from dynssm_ros.cli.race import race
from dynssm_ros.cli.replay import replay
from dynssm_ros.cli.residuals import residuals
from dynssm_ros.cli.season import season
from dynssm_ros.cli.simulate import simulate
from dynssm_ros.cli.sweep import sweep
from dynssm_ros.cli.train import train
from dynssm_ros.cli.vehicle import vehicle
from dynssm_ros.errors import DataWarning, UserError
from dynssm_ros.extras import load_plugins
from dynssm_ros.files import protecting, require_no_input

app = typer.Typer(
    name="dynssm",
    help="Learn a race car's dynamics from rosbags, predict live on ROS 2, and see what the model gets wrong.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
# click's base of all usage errors, wherever typer keeps its click
_UsageProblem = cast("type[Exception]", typer.BadParameter.__mro__[2])

for command in (
    learn,
    inspect,
    vehicle,
    simulate,
    extract,
    calibrate,
    train,
    sweep,
    evaluate,
    replay,
    residuals,
    diagnose,
    season,
    race,
    export,
):
    app.command()(command)


_OUTPUTS = ("--out", "--bag", "--json", "--online-state")
_NAMES = ("--vehicle", "--like", "--signals", "--track", "--line", "--car")
"""Options that take a file or a name; a folder that is called like a name is not read."""
_M_MMAP_THRESHOLD, _LARGE = -3, 1_000_000  # an option of mallopt(3), and from how many bytes on an array is large


def _print_version(value: bool) -> None:
    if value:
        print(f"dynssm {__version__}")
        raise typer.Exit


@app.callback()
def _options(
    version: bool = typer.Option(False, "--version", callback=_print_version, is_eager=True),
    force: bool = typer.Option(
        False, "--force", help="Replace what others wrote, but never an input; may stand anywhere."
    ),
) -> None:
    """Options before the subcommand."""


def main() -> None:
    """Runs the command line; whatever is wrong with what the user gave is one line and exit status 1."""
    arguments = [word for word in sys.argv[1:] if word != "--force"]
    _give_memory_back()
    try:
        load_plugins()
        inputs, outputs = paths(arguments)
        with _warning_in_lines(), protecting(inputs, force=len(arguments) < len(sys.argv) - 1):
            for output in outputs:
                require_no_input(output)
            status = app(arguments, standalone_mode=False)
    except UserError as error:
        _fail(str(error))
    except OSError as error:  # of a path that is forbidden or too long, or a disk that fails
        _fail(f"{error.filename}: {error.strerror}" if error.filename else str(error))
    except _UsageProblem as error:
        words = cast("Any", error).format_message()
        if words:  # without a subcommand the help is shown, and that is no error
            _fail(words)
    except (KeyboardInterrupt, typer.Abort):
        sys.exit(130)
    else:
        sys.exit(status if isinstance(status, int) else 0)


def _give_memory_back() -> None:
    """Has large arrays given back to the system as soon as they are freed; glibc keeps them once some were freed."""
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:  # other C libraries have none
        mallopt(_M_MMAP_THRESHOLD, _LARGE)


def paths(arguments: Sequence[str]) -> tuple[list[Path], list[Path]]:
    """What a command reads, which is all arguments that are paths of something there but for those of outputs; and these.

    Raises:
        UserError: an argument is not UTF-8.
    """
    inputs, outputs, option = list[Path](), list[Path](), ""
    names = (*_NAMES, "--model") if arguments[:1] in (["train"], ["sweep"], ["learn"]) else _NAMES
    for word in arguments:
        if any("\ud800" <= letter <= "\udfff" for letter in word):
            raise UserError(f"argument {word!a}: expected UTF-8")  # as which reports and recordings note it
        name, is_option, value = word.partition("=") if word.startswith("--") else ("", "", word)
        if name and not is_option:
            option = name
            continue
        if (name or option) in _OUTPUTS:
            outputs.append(Path(value))
        elif value and os.path.lexists(value) and not ((name or option) in names and os.path.isdir(value)):
            inputs.append(Path(value))
        option = ""
    return inputs, outputs


@contextmanager
def _warning_in_lines() -> Iterator[None]:
    """A :class:`DataWarning` is a line each on stderr, every time; other warnings stay as they are."""
    with warnings.catch_warnings():
        others = warnings.showwarning

        def show(message: Warning | str, category: type[Warning], *where: Any, **more: Any) -> None:
            if issubclass(category, DataWarning):
                warn(str(message))
            else:
                others(message, category, *where, **more)

        warnings.simplefilter("always", DataWarning)
        warnings.showwarning = show
        yield


def _fail(words: str) -> None:
    line = " ".join(words.split())
    errors.print(f"[red]error:[/red] {escape(line)}", soft_wrap=True, highlight=False)
    sys.exit(1)


if __name__ == "__main__":
    main()
