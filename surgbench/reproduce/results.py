"""A table's results: rows, per-sequence rows and fingerprints, derived from records, written and read back."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from surgbench.errors import DatasetError
from surgbench.files import canonical_json
from surgbench.report.records import AnyRecord, read_record
from surgbench.report.rows import Row, derive_rows
from surgbench.reproduce.fingerprint import head, record_sha256
from surgbench.reproduce.sheet import sheet_of
from surgbench.reproduce.table import Definition
from surgbench.reproduce.work import RECORDS, TIMING, BlockWork
from surgbench.suite.plan import Job

FORMAT = "surgbench-reproduction-1"
LEADERBOARD_CSV, LEADERBOARD_MD = "leaderboard.csv", "leaderboard.md"
SEQUENCES_CSV, RECORDS_JSON = "sequences.csv", "records.json"


@dataclass(frozen=True)
class Results:
    """What is known of a table.

    Attributes:
        rows: With the columns of the task's :class:`~surgbench.reproduce.sheet.Sheet`, in the table's order.
        sequences: Likewise: each row's arms, pairs or trials.
        about: Datasets, environments, and per record what is kept of it: the content of ``records.json``.
    """

    rows: list[Row]
    sequences: list[Row]
    about: dict[str, Any]


def derive(definition: Definition, blocks: Sequence[BlockWork], out: Path, quick: bool) -> Results:
    """Results from the records of finished work.

    Args:
        definition: The table.
        blocks: From :func:`surgbench.reproduce.work.do_work`.
        out: The table's own folder.
        quick: Whether it was a quick run.

    Raises:
        DatasetError: A record is damaged or missing.
    """
    frames = definition.table.check.frames
    sheet = sheet_of(definition.table.task)
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
            for record, content in _read(out / RECORDS, one.jobs):
                read.append(record)
                sequences.append(sheet.sequence_row(work.block.name, work.dataset, record))
                key = f"{one.row.id}/{record.spec.unit}/r{record.spec.repeat}"
                records[key] = {
                    "status": record.status,
                    "frames": len(record.frames.index),
                    "sha256": record_sha256(content),
                    "head": head(content, frames),
                }
                _count(made_in, content)
            timing = [record for record, content in _read(out / TIMING, one.timing) if _count(timed_in, content)]
            timed = {_part(row): row for row in derive_rows(timing)} if timing else {}
            for row in derive_rows(read):
                latencies = {column: timed[_part(row)][column] for column in sheet.latencies if _part(row) in timed}
                rows.append({**row, "block": work.block.name, "label": one.row.label, **latencies})
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
    return Results(rows, sequences, about)


def _read(folder: Path, jobs: Iterable[Job]) -> Iterator[tuple[AnyRecord, dict[str, Any]]]:
    """One at a time: a whole table's records do not fit into memory comfortably."""
    for job in jobs:
        path = folder / job.path
        record = read_record(path)
        if record is None:
            raise DatasetError(f"{path}: not a record; delete it and run again")
        yield record, json.loads(path.read_text(encoding="utf-8"))


def _count(environments: dict[str, dict[str, Any]], record: dict[str, Any]) -> bool:
    environment = record["environment"]
    entry = environments.setdefault(canonical_json(environment), {**environment, "records": 0})
    entry["records"] += 1
    return True


def _part(row: Row) -> tuple[Any, ...]:
    """Which of a row id's rows it is."""
    return tuple(row.get(key) for key in ("subset", "camera", "pixels"))


def csv_text(rows: Sequence[Row], columns: Sequence[str]) -> str:
    """CSV with every digit; empty cells for missing values."""
    out = io.StringIO()
    writer = csv.DictWriter(out, columns, lineterminator="\n", extrasaction="ignore")
    writer.writeheader()
    writer.writerows(rows)
    return out.getvalue()


def json_text(about: dict[str, Any]) -> str:
    """``records.json``: a line for each record, so that two can be compared with ``diff``."""
    rest = {key: value for key, value in about.items() if key != "records"}
    head_text = json.dumps(rest, indent=1, sort_keys=True, allow_nan=False)
    lines = ",\n".join(f"  {json.dumps(key)}: {canonical_json(value)}" for key, value in about["records"].items())
    return f'{head_text[:-2]},\n "records": {{\n{lines}\n }}\n}}\n'


def read_results(folder: Path) -> Results:
    """Results as they were written.

    Raises:
        DatasetError: A file is missing or is not what it should be; one line.
    """
    path = folder / RECORDS_JSON
    try:
        about = json.loads(path.read_text(encoding="utf-8"))
        if about["format"] != FORMAT or not isinstance(about["records"], dict):
            raise ValueError(f"not of the format {FORMAT}")
        path = folder / LEADERBOARD_CSV
        sheet = sheet_of(about.get("task", "instrument"))
        rows = _read_csv(path, sheet.leaderboard, sheet.text)
        path = folder / SEQUENCES_CSV
        return Results(rows, _read_csv(path, sheet.sequences, sheet.text), about)
    except FileNotFoundError:
        raise DatasetError(f"{path}: missing; a reproduced table is a folder with this file") from None
    except OSError as error:
        raise DatasetError(f"{path}: cannot be read ({error.strerror})") from None
    except (ValueError, KeyError, TypeError) as error:
        raise DatasetError(f"{path}: damaged ({error})") from None


def _read_csv(path: Path, columns: Sequence[str], text: frozenset[str]) -> list[Row]:
    lines = csv.DictReader(io.StringIO(path.read_text(encoding="utf-8")))
    if tuple(lines.fieldnames or ()) != tuple(columns):
        raise ValueError("other columns than this version of surgbench writes")
    return [{key: cell or None if key in text else _value(cell) for key, cell in line.items()} for line in lines]


def _value(cell: str) -> Any:
    if cell == "":
        return None
    if cell in ("True", "False"):
        return cell == "True"
    try:
        return int(cell)
    except ValueError:
        return float(cell)
