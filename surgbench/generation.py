"""What a generator is asked for, and the plan that it answers with."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from surgbench.config import parse_value
from surgbench.dataset.manifest import Manifest
from surgbench.errors import ConfigError


@dataclass(frozen=True)
class GenerationRequest:
    """What is put over a preset; ``None`` leaves a value as the preset has it.

    Attributes:
        sequences: Pairs of trajectories, or trials.
        frames: Frames, or samples, of each.
        seed: Of everything random in it.
        corruption: Level of the masks' corruption, where there are masks.
        part: Ids of sequences, and how many frames of each, where no more is needed.
        set: Keys of the preset with their values, as ``{"occluders.tissue": 0.4}``: they go over the file's, and what
            is given above over them.
    """

    sequences: int | None = None
    frames: int | None = None
    seed: int | None = None
    corruption: str | None = None
    part: tuple[tuple[str, ...], int] | None = None
    set: Mapping[str, Any] = field(default_factory=dict)


class Workers(Protocol):
    """Who does the work of a generation: processes of this machine, or of a cluster's.

    Attributes:
        jobs: How many tasks are done at a time.
        elsewhere: They are done on other machines.
    """

    @property
    def jobs(self) -> int: ...  # noqa: D102

    @property
    def elsewhere(self) -> bool: ...  # noqa: D102

    def do(
        self,
        tasks: Iterable[Any],
        do: Callable[[Any], int],
        start: Callable[..., None],
        arguments: tuple[Any, ...],
        progress: Callable[[float], None],
    ) -> None:
        """Do tasks. All that is handed over is pickled; files are where they are here.

        Args:
            tasks: In order; few are drawn ahead of the work.
            do: Does one, in a worker; returns what ``progress`` is to take.
            start: Prepares a worker: takes ``arguments`` and a shared ``ctypes.c_bool``; once that is true, no new work
                is to begin.
            arguments: For ``start``.
            progress: Takes how much was just done.
        """
        ...


class GenerationPlan(Protocol):
    """What a generation will make."""

    @property
    def name(self) -> str:
        """The dataset's."""
        ...

    @property
    def counts(self) -> str:
        """How much there will be, a few words."""
        ...

    @property
    def frames(self) -> int:
        """Frames over all sequences, or samples over all trials."""
        ...

    @property
    def marker(self) -> dict[str, Any]:
        """Effective configuration as it is kept in the folder until the dataset is complete."""
        ...

    @property
    def paths(self) -> list[str]:
        """Every file but the manifest."""
        ...

    @property
    def disk_bytes(self) -> int:
        """Disk that the whole dataset takes, an upper estimate."""
        ...

    def write(self, out: Path, workers: Workers, progress: Callable[[float], None]) -> Manifest:
        """Write everything but the manifest into the folder; what is there whole stays.

        :class:`surgbench.dataset.writer.DatasetWriter` knows what is, and what the manifest is to say of the files.

        Args:
            out: The folder.
            workers: Do what can be done at a time.
            progress: Takes the number of frames or samples just done.
        """
        ...


def parse_settings(texts: Sequence[str]) -> dict[str, Any]:
    """Keys and values of texts ``KEY=VALUE``; values are YAML.

    Raises:
        ConfigError: A text is none, or a key is given twice; one line.

    Example:
        >>> from surgbench.generation import parse_settings
        >>> parse_settings(["occluders.tissue=0.4", "corruption=strong"])
        {'occluders.tissue': 0.4, 'corruption': 'strong'}
    """
    settings: dict[str, Any] = {}
    for text in texts:
        key, equals, value = text.partition("=")
        key = key.strip()
        if not equals or not all(key.split(".")):
            raise ConfigError(f"--set {text}: must be KEY=VALUE, for example occluders.tissue=0.4")
        if key in settings:
            raise ConfigError(f"--set {text}: '{key}' is given twice")
        try:
            settings[key] = parse_value(value)
        except ValueError:
            raise ConfigError(f"--set {text}: '{value}' is not a value") from None
    return settings


def with_settings(content: Mapping[str, Any], settings: Mapping[str, Any]) -> dict[str, Any]:
    """A preset's content with settings put over it; sections that it has not are begun.

    The dataset's name tells what was set, unless that is the name.

    Args:
        content: Of the whole preset, defaults included.
        settings: Keys, with dots between those of sections, and values.

    Raises:
        ConfigError: A key leads into what is no section; one line.
    """
    changed: dict[str, Any] = json.loads(json.dumps(content))
    for key, value in settings.items():
        *sections, last = key.split(".")
        here = changed
        for section in sections:
            if here.get(section) is None:
                here[section] = {}
            here = here[section]
            if not isinstance(here, dict):
                raise ConfigError(f"--set {key}: '{section}' has no keys")
        # A copy: a key that comes later may lead into it.
        here[last] = json.loads(json.dumps(value))
    if "name" not in settings:
        changed["name"] = f"{changed['name']}{settings_suffix(settings)}"
    return changed


def settings_suffix(settings: Mapping[str, Any]) -> str:
    """What is added to the name of a dataset, and of its folder, for settings put over its preset.

    Example:
        >>> from surgbench.generation import settings_suffix
        >>> settings_suffix({"occluders.tissue": 0.4, "instances.swap_frames": [1, 5]})
        '-occluders.tissue-0.4-instances.swap_frames-1_5'
    """
    texts = (value if isinstance(value, str) else json.dumps(value) for value in settings.values())
    values = (re.sub(r"[^A-Za-z0-9_.-]+", "_", text).strip("_") for text in texts)
    return "".join(f"-{key}-{value}" for key, value in zip(settings, values, strict=True))
