"""The datasets that runs were made on, as they are now."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

from surgbench.dataset.open import open_as
from surgbench.errors import DatasetError
from surgbench.records.reader import read_records
from surgbench.tasks.instrument.dataset import InstrumentDataset, InstrumentUnit
from surgbench.tasks.instrument.records import InstrumentRecord


def records_on(dataset: InstrumentDataset, runs: Iterable[Path]) -> Iterator[tuple[InstrumentRecord, InstrumentUnit]]:
    """Runs on single arms of a dataset, each with the unit that it is about; all others are passed over.

    Args:
        dataset: As it was when they were made.
        runs: Folders of records.
    """
    units = {unit.id: unit for unit in dataset.units()}
    for record in read_records(runs):
        if isinstance(record, InstrumentRecord) and record.spec.dataset.sha256 == dataset.hash:
            unit = units.get(record.spec.unit)
            if unit is not None:
                yield record, unit


def open_recorded(records: Iterable[InstrumentRecord], moved: Path | None = None) -> dict[str, InstrumentDataset]:
    """Open the datasets of some records.

    Args:
        records: Any.
        moved: Where the dataset is now, if not where the records say; then only that one is opened.

    Returns:
        Hash of each to the dataset.

    Raises:
        DatasetError: One is not there, or is another one than the records were made on.
    """
    first: dict[str, InstrumentRecord] = {}
    for record in records:
        first.setdefault(record.spec.dataset.sha256, record)
    if moved is not None:
        dataset = open_as(InstrumentDataset, moved)
        if first and dataset.hash not in first:
            names = ", ".join(f"'{record.spec.dataset.name}'" for record in first.values())
            raise DatasetError(f"{moved}: not the dataset that the records were made on ({names}; its hash differs)")
        return {dataset.hash: dataset}
    found = {}
    for sha256, record in first.items():
        path, name = record.dataset_path, record.spec.dataset.name
        if path is None or not Path(path).is_dir():
            raise DatasetError(f"dataset '{name}' is not at {path} any more; say where it is: --dataset PATH")
        found[sha256] = open_as(InstrumentDataset, path)
        if found[sha256].hash != sha256:
            raise DatasetError(f"{path}: changed since the records were made (its hash differs); --dataset OLD_PATH")
    return found
