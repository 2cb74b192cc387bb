"""What every dataset offers, whatever its task."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar, Generic, Literal, Protocol, TypeVar

from surgbench.dataset.manifest import Manifest

M = TypeVar("M", bound=Manifest)


class Unit(Protocol):
    """What one run of a tracker is about."""

    @property
    def id(self) -> str:
        """Names its record."""
        ...

    @property
    def sequence(self) -> str:
        """The sequence that it is, or is a part of."""
        ...

    def spec(self) -> dict[str, Any]:
        """What a record's specification says of it beside these two."""
        ...


class Dataset(ABC, Generic[M]):
    """A dataset on disk; :func:`surgbench.dataset.open.open_dataset` opens one.

    Attributes:
        task: What its trackers do.
        path: Its folder.
        manifest: What ``dataset.json`` says.
        hash: SHA-256 of ``dataset.json``, which holds the hash of every other file.
    """

    task: ClassVar[str]

    def __init__(self, path: Path, manifest: M, hash_: str) -> None:
        self.path = path
        self.manifest = manifest
        self.hash = hash_

    @property
    def name(self) -> str:
        """The preset's or recording's name."""
        return self.manifest.name

    @abstractmethod
    def units(self, arms: Literal["single", "dual"] = "single") -> Sequence[Unit]:
        """What trackers run on, in order.

        Args:
            arms: Each arm alone, or pairs, where the task has arms.

        Raises:
            DatasetError: Nothing in the dataset can be run that way.
        """

    @abstractmethod
    def length(self, sequence: str) -> int:
        """Number of frames, or steps, of a sequence.

        Raises:
            DatasetError: There is none of this name.
        """
