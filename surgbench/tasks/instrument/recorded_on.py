"""Runs that were made on a dataset."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

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
