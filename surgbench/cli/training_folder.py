"""What all trainings have in common: their files, what is put over those, and the folder that a model is made in."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, TypeVar

from surgbench.config import Section, locate, parse_model, read_yaml
from surgbench.errors import ConfigError, SurgbenchError
from surgbench.extras import not_installed
from surgbench.files import PARTIAL_SUFFIX, write_atomic
from surgbench.trackers.learning.course import LOG, STATE
from surgbench.trackers.learning.curve import draw_curve
from surgbench.trackers.learning.weights import WEIGHTS

CONFIG = "config.json"
ACCURACY = "accuracy.json"
CURVE = "curve.png"

File = TypeVar("File", bound=Section)


def load_file(model: type[File], reference: str, changes: Mapping[str, Any]) -> File:
    """A training file by name or path, with the command line's options over it.

    Args:
        model: What such a file holds.
        reference: Name or path.
        changes: Keys, with a dot between a section's and its own, and values; ``None`` leaves the file's.

    Raises:
        NotFoundError: No such file.
        ConfigError: An unknown key or a wrong value; one line.
    """
    path = locate("training", "training file", reference)
    content = read_yaml(path, "training")
    parse_model(model, content, str(path))
    changed: dict[str, Any] = dict(content)
    for key, value in changes.items():
        section, _, own = key.rpartition(".")
        if value is not None and section:
            if not isinstance(changed.get(section), dict | None):
                raise ConfigError(f"command line: '{section}' has no keys")
            changed[section] = {**(changed.get(section) or {}), own: value}
        elif value is not None:
            changed[own] = value
    return parse_model(model, changed, "command line")


def refuse_other_content(out: Path, more: Iterable[str] = ()) -> None:
    """Raise where a folder holds what no training has written; what a killed one has left half written is removed.

    Args:
        out: The folder.
        more: Names of what such a training writes beside the usual.

    Raises:
        SurgbenchError: It holds something else; one line.
    """
    own = {WEIGHTS, CONFIG, ACCURACY, CURVE, LOG, STATE, *more}
    names = sorted(path.name for path in out.iterdir()) if out.is_dir() else []
    strangers = [name for name in names if name not in own and not name.endswith(PARTIAL_SUFFIX)]
    if strangers:
        raise SurgbenchError(f"{out}: holds something else ('{strangers[0]}'); --out needs a new or empty folder")
    for name in names:
        if name.endswith(PARTIAL_SUFFIX) and any(name.startswith(f"{one}.") for one in own):
            (out / name).unlink()


def write_settings(out: Path, settings: Mapping[str, Any]) -> None:
    """Write what a model is trained with, unless there is a model of other settings.

    Raises:
        SurgbenchError: There is one; one line.
    """
    config = as_json(settings)
    if (out / WEIGHTS).exists() and not ((out / CONFIG).exists() and (out / CONFIG).read_bytes() == config):
        raise SurgbenchError(f"{out}: holds a model of other settings; give another folder, or remove it")
    write_atomic(out / CONFIG, config)


def write_accuracy(out: Path, accuracy: Mapping[str, Any]) -> None:
    """Write what a model's accuracy was found to be."""
    write_atomic(out / ACCURACY, as_json(accuracy))


def write_curve(
    out: Path, say: Callable[[str], None], measures: Iterable[str], what: str, *panels: Mapping[str, str]
) -> None:
    """Draw the log, as :func:`surgbench.trackers.learning.curve.draw_curve` does, or say that it cannot be drawn."""
    if not draw_curve(out / LOG, out / CURVE, measures, what, *panels):
        say(f"{out / CURVE}: left out, for {not_installed(['matplotlib'])}")


def as_json(content: Mapping[str, Any]) -> bytes:
    """As it is written to a model's folder."""
    return (json.dumps(content, indent=1) + "\n").encode()
