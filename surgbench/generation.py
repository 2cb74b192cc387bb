"""What a generator is asked for, and the plan that it answers with."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from surgbench.dataset.manifest import Manifest


@dataclass(frozen=True)
class GenerationRequest:
    """What is put over a preset; ``None`` leaves a value as the preset has it.

    Attributes:
        sequences: Pairs of trajectories, or trials.
        frames: Frames, or samples, of each.
        seed: Of everything random in it.
        corruption: Level of the masks' corruption, where there are masks.
        part: Ids of sequences, and how many frames of each, where no more is needed.
    """

    sequences: int | None = None
    frames: int | None = None
    seed: int | None = None
    corruption: str | None = None
    part: tuple[tuple[str, ...], int] | None = None


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

    def write(self, out: Path, jobs: int, progress: Callable[[float], None]) -> Manifest:
        """Write everything but the manifest into the folder; what is there whole stays.

        :class:`surgbench.dataset.writer.DatasetWriter` knows what is, and what the manifest is to say of the files.

        Args:
            out: The folder.
            jobs: Worker processes.
            progress: Takes the number of frames or samples just done.
        """
        ...
