"""Which runs are to be drawn, what they are called, and the datasets that they were made on, as they are now."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

from surgbench.dataset.base import Dataset
from surgbench.dataset.open import open_as
from surgbench.errors import DatasetError, NotFoundError, unknown_name
from surgbench.records.format import Record
from surgbench.report.telling import telling_variants

D = TypeVar("D", bound=Dataset[Any])
R = TypeVar("R", bound=Record)


@dataclass(frozen=True)
class UnitRuns(Generic[D, R]):
    """One unit, and what ran on it.

    Attributes:
        name: Of files about it, without their endings.
        dataset: Its dataset.
        records: One per row and settings, the first repeat's.
    """

    name: str
    dataset: D
    records: tuple[R, ...]

    @property
    def frames(self) -> int:
        """Of the unit, as many as any of its runs was asked for."""
        return max(record.unit_frames for record in self.records)


def open_recorded(kind: type[D], records: Iterable[Record], moved: Path | None = None) -> dict[str, D]:
    """Open the datasets of some records.

    Args:
        kind: Of their task.
        records: Any of it.
        moved: Where the dataset is now, if not where the records say; then only that one is opened.

    Returns:
        Hash of each to the dataset.

    Raises:
        DatasetError: One is not there, or is another one than the records were made on.
    """
    first: dict[str, Record] = {}
    for record in records:
        first.setdefault(record.spec.dataset.sha256, record)
    if moved is not None:
        dataset = open_as(kind, moved)
        if first and dataset.hash not in first:
            names = ", ".join(f"'{record.spec.dataset.name}'" for record in first.values())
            raise DatasetError(f"{moved}: not the dataset that the records were made on ({names}; its hash differs)")
        return {dataset.hash: dataset}
    found = {}
    for sha256, record in first.items():
        path, name = record.dataset_path, record.spec.dataset.name
        if path is None or not Path(path).is_dir():
            raise DatasetError(f"dataset '{name}' is not at {path} any more; say where it is: --dataset PATH")
        found[sha256] = open_as(kind, path)
        if found[sha256].hash != sha256:
            raise DatasetError(f"{path}: changed since the records were made (its hash differs); --dataset OLD_PATH")
    return found


def choose_runs(
    kind: type[D], records: Sequence[R], units: Sequence[str], rows: Sequence[str], dataset_path: Path | None = None
) -> list[UnitRuns[D, R]]:
    """Which units to draw, of which dataset.

    Args:
        kind: Of their task.
        records: From :func:`surgbench.records.reader.read_records`.
        units: Unit ids; none for all.
        rows: Row ids; none for all.
        dataset_path: Where the dataset is now, if not where the records say.

    Returns:
        By name.

    Raises:
        NotFoundError: A unit or row that no record has.
        DatasetError: The dataset is not there, or is another one than the records were made on.
    """
    for word, asked, known in (
        ("unit", units, {record.spec.unit for record in records}),
        ("row", rows, {record.spec.row_id for record in records}),
    ):
        for name in asked:
            if name not in known:
                raise NotFoundError(unknown_name(word, name, known))
    chosen: dict[tuple[str, str], dict[tuple[str, str], R]] = {}
    for record in records:
        spec = record.spec
        if (units and spec.unit not in units) or (rows and spec.row_id not in rows):
            continue
        own = chosen.setdefault((spec.dataset.sha256, spec.unit), {})
        own.setdefault((spec.row_id, record.settings_hash), record)  # records come in order of their repeats
    datasets = open_recorded(kind, (one for own in chosen.values() for one in own.values()), dataset_path)
    found = []
    for (sha256, unit), own in chosen.items():
        if sha256 in datasets:
            name = unit if len(datasets) == 1 else f"{datasets[sha256].name}-{unit}"
            found.append(UnitRuns(name, datasets[sha256], tuple(own.values())))
    if not found:
        raise NotFoundError("no record is of the chosen unit and row together")
    return sorted(found, key=lambda one: one.name)


def titles(records: Sequence[Record]) -> list[str]:
    """What each of one unit's records is called: its row id, and what tells it from others of that id."""
    by_id: dict[str, list[Record]] = {}
    for record in records:
        by_id.setdefault(record.spec.row_id, []).append(record)
    names = []
    for record in records:
        name = record.spec.row_id
        if len(by_id[name]) > 1:
            name = f"{name} ({telling_variants(by_id[name])[record.settings_hash]})"
        names.append(name)
    return names
