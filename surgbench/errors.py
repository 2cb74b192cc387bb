"""The errors a user can cause, each one line that names what is wrong and what would be right."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


class SurgbenchError(Exception):
    """Bad input or a refused operation; the command line prints it as one line and exits with 2."""


class DatasetError(SurgbenchError):
    """A dataset, recording or record on disk is missing something, altered, or of the wrong shape."""


class ConfigError(SurgbenchError):
    """A configuration file or option has an unknown key or a value of the wrong type."""


class NotFoundError(SurgbenchError):
    """A name that no preset, tracker, initialiser, filter or instrument has."""


def unknown_name(kind: str, name: str, valid: Iterable[str]) -> str:
    """One line for an unknown name, with the nearest valid one.

    Args:
        kind: What the name should have been, for example ``"tracker"``.
        name: What was asked for.
        valid: All names that would have done.

    Returns:
        ``unknown tracker 'cmeas'; did you mean 'cmaes'? (valid: cmaes, hybrid)``
    """
    names = sorted(valid)
    close = difflib.get_close_matches(name, names, n=1, cutoff=0.5)
    hint = f"; did you mean '{close[0]}'?" if close else ""
    return f"unknown {kind} '{name}'{hint} (valid: {', '.join(names) or 'none'})"


class PluginError(SurgbenchError):
    """A plug-in raised while another one was at work; one line that names it."""


class InvalidAnswerError(Exception):
    """A plug-in returned something that is no state."""
