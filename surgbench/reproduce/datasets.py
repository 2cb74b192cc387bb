"""The datasets behind a table: where they lie, and how they come to be."""

from __future__ import annotations

from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from surgbench.dataset.base import Dataset
from surgbench.dataset.open import open_dataset
from surgbench.reproduce.table import DatasetRequest, ImportRequest


@dataclass(frozen=True)
class PartRequest:
    """Some sequences of a dataset, and of them the first frames.

    Attributes:
        sequences: Ids.
        frames: At most so many of each.
    """

    sequences: tuple[str, ...]
    frames: int


class Bar(Protocol):
    """Shows how far work has come."""

    def __call__(self, amount: float) -> None:
        """So much more of the total has been done."""

    def stage(self, description: str, fraction: float) -> None:
        """A part of the work that the total does not count has come to ``fraction``; 1 ends it."""


class Watcher(Protocol):
    """Who is told what is going on."""

    def say(self, line: str) -> None:
        """One line for the user."""

    def progress(self, description: str, total: float) -> AbstractContextManager[Bar]:
        """Work that is about to begin."""


class MakeDataset(Protocol):
    """Generates a dataset, or finishes one that was interrupted. The engine knows no generator, so it is handed in."""

    def __call__(self, request: DatasetRequest | ImportRequest, part: PartRequest | None, out: Path, jobs: int) -> None:
        """Have the dataset whole in ``out`` afterwards, or a part of one that is generated."""


def provide(
    request: DatasetRequest | ImportRequest,
    part: PartRequest | None,
    data: Path,
    jobs: int,
    make: MakeDataset,
) -> Dataset[Any]:
    """A dataset, made first where it is not there.

    Args:
        request: What it is.
        part: What of it is needed, if it is generated: recordings are read whole. ``None``: all.
        data: Folder of datasets.
        jobs: Worker processes.
        make: Makes it.
    """
    folder = request.folder
    if isinstance(request, ImportRequest):
        part = None
    if part is not None:
        folder += f"-part-{'-'.join(part.sequences)}-{part.frames}"
    make(request, part, data / folder, jobs)
    return open_dataset(data / folder)
