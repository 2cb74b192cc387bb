"""A table's results from the records of finished work."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

from surgbench.errors import DatasetError
from surgbench.files import canonical_json
from surgbench.records.format import Record
from surgbench.records.reader import read_record
from surgbench.report.row import Row
from surgbench.report.rows import derive_rows
from surgbench.reproduce.datasets import Bar, Watcher
from surgbench.reproduce.files import FORMAT
from surgbench.reproduce.fingerprint import head, record_sha256
from surgbench.reproduce.over_sequences import spread_over_sequences
from surgbench.reproduce.paired import with_differences
from surgbench.reproduce.results import RECORDS, TIMING, BlockWork, Results
from surgbench.reproduce.table import Definition
from surgbench.suite.settings import Job
from surgbench.task import find_task


def derive(definition: Definition, blocks: Sequence[BlockWork], out: Path, quick: bool, watcher: Watcher) -> Results:
    """Results from the records of finished work.

    Args:
        definition: The table.
        blocks: From :func:`surgbench.reproduce.work.do_work`.
        out: The table's own folder.
        quick: Whether it was a quick run.
        watcher: Is told how far it has come.

    Raises:
        DatasetError: A record is damaged or missing.
    """
    jobs = sum(len(one.jobs) + len(one.timing) for work in blocks for one in work.rows)
    with watcher.progress("Reading records", jobs) as bar:
        return _derive(definition, blocks, out, quick, bar)


def _derive(definition: Definition, blocks: Sequence[BlockWork], out: Path, quick: bool, bar: Bar) -> Results:
    frames = definition.table.check.frames
    sheet = find_task(definition.table.task).sheet
    rows: list[Row] = []
    sequences: list[Row] = []
    records: dict[str, Any] = {}
    made_in: dict[str, dict[str, Any]] = {}
    timed_in: dict[str, dict[str, Any]] = {}
    datasets: dict[str, Any] = {}
    for work in blocks:
        folder = work.block.dataset.folder
        datasets[folder] = datasets.get(folder) or {
            "name": work.dataset.name,
            "sha256": work.dataset.hash,
            **sheet.describe(work.dataset, frames),
        }
        for one in work.rows:
            read = []
            for record, content in _read(out / RECORDS, one.jobs, bar):
                read.append(record)
                sequences.append(sheet.sequence_row(work.block.name, work.dataset, record))
                key = f"{one.row.id}/{record.spec.unit}/r{record.spec.repeat}"
                records[key] = {
                    "status": record.status,
                    "frames": len(record.frames.index),
                    "sha256": record_sha256(content),
                    "head": head(content, frames, sheet),
                }
                _count(made_in, content)
            timing = [record for record, content in _read(out / TIMING, one.timing, bar) if _count(timed_in, content)]
            timed = {_part(row): row for row in derive_rows(timing)} if timing else {}
            spread = spread_over_sequences(definition.table.over_sequences, read, timing or read)
            for row in derive_rows(read):
                latencies = {column: timed[_part(row)][column] for column in sheet.latencies if _part(row) in timed}
                rows.append({**row, "block": work.block.name, "label": one.row.label, **latencies, **spread})
    about = {
        "format": FORMAT,
        "table": definition.name,
        "task": definition.table.task,
        "table_sha256": definition.sha256,
        "quick": quick,
        "first_frames": frames,
        "datasets": datasets,
        "environments": list(made_in.values()),
        "timing_environments": list(timed_in.values()),
        "records": records,
    }
    return Results(with_differences(definition.table, rows, sequences, sheet), sequences, about)


def _read(folder: Path, jobs: Iterable[Job], bar: Bar) -> Iterator[tuple[Record, dict[str, Any]]]:
    """One at a time: a whole table's records do not fit into memory comfortably."""
    for job in jobs:
        path = folder / job.path
        record = read_record(path)
        if record is None:
            raise DatasetError(f"{path}: not a record; delete it and run again")
        yield record, json.loads(path.read_text(encoding="utf-8"))
        bar(1)


def _count(environments: dict[str, dict[str, Any]], record: dict[str, Any]) -> bool:
    environment = record["environment"]
    entry = environments.setdefault(canonical_json(environment), {**environment, "records": 0})
    entry["records"] += 1
    return True


def _part(row: Row) -> tuple[Any, ...]:
    """Which of a row id's rows it is."""
    return tuple(row.get(column) for column in find_task(row["task"]).parts)
