"""Datasets and estimates in other people's formats: what is exported, who exports it, and where it ends up."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Protocol, runtime_checkable

from surgbench.dataset.base import Dataset
from surgbench.dataset.manifest import MANIFEST_NAME, MARKER_NAME
from surgbench.dataset.open import open_dataset
from surgbench.dataset.storage import new_folder
from surgbench.errors import DatasetError
from surgbench.records.format import Record
from surgbench.records.reader import read_runs


@dataclass(frozen=True)
class Material:
    """What is to be exported: a dataset, or the estimates of runs.

    Attributes:
        dataset: The dataset; ``None`` where estimates are exported.
        records: Runs with estimates, in a fixed order; empty where a dataset is exported.
        moved: Where the dataset of the runs is, if not where their records say.
        left_out: Runs without any estimate, one line each.
    """

    dataset: Dataset[Any] | None = None
    records: tuple[Record, ...] = ()
    moved: Path | None = None
    left_out: tuple[str, ...] = field(default=())


@runtime_checkable
class Exporter(Protocol):
    """Writes datasets, estimates or both in one format; its ``Config`` holds its options."""

    name: ClassVar[str]

    def count(self, material: Material) -> int:
        """How much work there is, in frames, and whether it can be done at all.

        Raises:
            SurgbenchError: The format has no place for this, or the material lacks what it needs; one line.
        """
        ...

    def write(self, material: Material, folder: Path, progress: Callable[[float], None]) -> None:
        """Write everything into a folder that is there and empty.

        Args:
            material: What to export.
            folder: Gets its final name when this returns: files must not hold it.
            progress: Takes the number of frames just done.

        Raises:
            SurgbenchError: As :meth:`count`, or something in the material is damaged.
        """
        ...


def read_material(source: Path, moved: Path | None = None) -> Material:
    """What lies at a path.

    Args:
        source: A dataset's folder, a record, or a folder of records.
        moved: Where the dataset of the runs is, if not where their records say.

    Raises:
        DatasetError: It is none of these, or none of the runs has an estimate.
    """
    if (source / MANIFEST_NAME).exists() or (source / MARKER_NAME).exists():
        if moved is not None:
            raise DatasetError(f"{source}: is a dataset; --dataset says where that of runs is")
        return Material(open_dataset(source))
    if not source.exists():
        raise DatasetError(f"{source}: no such file or folder; expected a dataset, a record, or a folder of records")
    records = read_runs([source])
    told = tuple(record for record in records if record.frames.index)
    silent = [record for record in records if not record.frames.index]
    left_out = tuple(f"{record.spec.row_id} {record.spec.unit}: {record.status}: {record.error}" for record in silent)
    if not told:
        raise DatasetError(f"{source}: no run has an estimate ({left_out[0]})")
    return Material(records=told, moved=moved, left_out=left_out)


def export(exporter: Exporter, material: Material, out: Path, progress: Callable[[float], None]) -> None:
    """Export into a folder that appears when all of it is there.

    Args:
        exporter: Of the format.
        material: What to export.
        out: New or empty.
        progress: Takes the number of frames just done.

    Raises:
        SurgbenchError: As :meth:`Exporter.write`, ``out`` holds something, or the disk is full.
    """
    with new_folder(out, "exporting") as scratch:
        exporter.write(material, scratch, progress)
