"""Data: series of numbers, one sequence each."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np

from surgbench.config import read_yaml
from surgbench.dataset import tables
from surgbench.dataset.base import Dataset
from surgbench.dataset.manifest import FORMAT, FileEntry, Manifest, observations_path
from surgbench.dataset.writer import write_files
from surgbench.generation import GenerationPlan, GenerationRequest, Workers
from surgbench.geometry import FloatArray
from surgbench.randomness import generator

FRAMES = 10


class CountingManifest(Manifest):
    """Which series there are."""

    task: Literal["counting"] = "counting"
    series: tuple[str, ...]

    @property
    def counts(self) -> str:
        """How many."""
        return f"{len(self.series)} series"


@dataclass(frozen=True)
class Series:
    """What one run is about."""

    id: str

    @property
    def sequence(self) -> str:
        """The same."""
        return self.id

    def spec(self) -> dict[str, Any]:
        """Nothing besides."""
        return {}


class CountingDataset(Dataset[CountingManifest]):
    """Series on disk."""

    task: ClassVar[str] = "counting"

    def units(self, arms: str = "single") -> tuple[Series, ...]:
        """Each series."""
        return tuple(map(Series, self.manifest.series))

    def length(self, sequence: str) -> int:
        """All are of one length."""
        return FRAMES

    def values(self, sequence: str) -> FloatArray:
        """``(FRAMES,)`` numbers."""
        data = (self.path / observations_path(sequence)).read_bytes()
        return tables.decode_table(data, sequence, FRAMES, ["value"])["value"]


class Counting:
    """The generator."""

    name: ClassVar[str] = "counting"
    task: ClassVar[str] = "counting"

    def plan(self, preset: Path, request: GenerationRequest) -> GenerationPlan:
        """Two series unless told."""
        return Plan(str(read_yaml(preset, "preset")["name"]), request.sequences or 2)


@dataclass(frozen=True)
class Plan:
    """Series that begin anywhere and go up by one."""

    name: str
    series: int
    disk_bytes: int = 10_000

    @property
    def frames(self) -> int:
        """Numbers in all."""
        return self.series * FRAMES

    @property
    def counts(self) -> str:
        """How many series."""
        return f"{self.series} series"

    @property
    def marker(self) -> dict[str, Any]:
        """All that they depend on."""
        return {"format": FORMAT, "name": self.name, "series": self.series}

    @property
    def ids(self) -> tuple[str, ...]:
        """Names of the series."""
        return tuple(f"{index:03d}" for index in range(self.series))

    @property
    def paths(self) -> list[str]:
        """One file each."""
        return [observations_path(id_) for id_ in self.ids]

    def write(self, out: Path, workers: Workers, progress: Callable[[float], None]) -> Manifest:
        """Draw and write."""
        files: dict[str, FileEntry] = {}
        for id_ in self.ids:
            values = generator(series=id_).integers(100) + np.arange(FRAMES, dtype=float)
            files |= write_files(out, {observations_path(id_): tables.encode_table({"value": values})})
            progress(FRAMES)
        return CountingManifest(
            name=self.name,
            created_by="surgbench-toy",
            origin="generated",
            configuration={"name": self.name, "series": self.series},
            conventions={},
            series=self.ids,
            files=files,
        )
