"""Errors that a user can act on.

Everything that is wrong with what a user gave us - a bag, a signal map, a vehicle, a model - is raised as a
:class:`UserError` whose message is one line: what, where, the value, and what was expected. The command line prints
that line and exits with 1; the node refuses the parameter with it.
"""

from __future__ import annotations


class UserError(Exception):
    """Base of every error whose cause lies in the user's input; its text is one complete line."""


class ConfigurationError(UserError):
    """A YAML file (vehicle, signal map, model, artifact) is missing, malformed or out of bounds."""


class SettingError(ConfigurationError):
    """Settings that do not fit each other or the data.

    Attributes:
        names: fields of settings that the text names; the command line shows them as its options.
    """

    def __init__(self, text: str, *names: str) -> None:
        super().__init__(text)
        self.names = names


class BagError(UserError):
    """A bag cannot be read, or its messages are not what the signal map expects."""


class RecordingError(UserError):
    """A recording is not what the command needs (columns, rate, length)."""


class DataWarning(UserWarning):
    """What was given looks wrong, or part of it cannot be used here; the text is one complete line."""


class ArtifactError(UserError):
    """A model folder is incomplete, of a newer version, damaged, or does not fit."""


class ProcessDiedError(UserError):
    """Processes that work beside this one were killed, again and again."""
