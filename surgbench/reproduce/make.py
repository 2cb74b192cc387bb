"""A table from nothing to files: the work, the results, the page, the figure."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from pathlib import Path

from surgbench.errors import DatasetError, SurgbenchError
from surgbench.files import write_atomic
from surgbench.report.figures import FIGURE_PNG, check_matplotlib
from surgbench.report.frame import csv_text, to_frame
from surgbench.reproduce.again import merged, narrowed
from surgbench.reproduce.datasets import MakeDataset, Watcher
from surgbench.reproduce.derive import derive
from surgbench.reproduce.files import (
    LEADERBOARD_CSV,
    LEADERBOARD_MD,
    RECORDS_JSON,
    SEQUENCES_CSV,
    json_text,
    read_results,
)
from surgbench.reproduce.results import Results
from surgbench.reproduce.table import Definition
from surgbench.reproduce.work import do_work
from surgbench.task import find_task


def table_folder(definition: Definition, out: Path, quick: bool) -> Path:
    """Where a table's files go below ``out``."""
    return out / (f"{definition.name}-quick" if quick else definition.name)


def reproduce(
    definition: Definition,
    out: Path,
    data: Path,
    jobs: int,
    quick: bool,
    make: MakeDataset,
    watcher: Watcher,
    only: Collection[str] = (),
) -> tuple[Results, list[str]]:
    """Make a table: datasets, runs, CSV, Markdown, fingerprints, figure. The same call again goes on where it stopped.

    Args:
        definition: The table.
        out: The table's folder is made in here.
        data: Folder of datasets.
        jobs: Worker processes.
        quick: Only the small share.
        make: Makes datasets.
        watcher: Is told what is going on.
        only: Rows of a finished table that alone are run again; the others stay as they stand in its files, and so
            does what is drawn of estimates.

    Returns:
        The results, and a line for each run that failed.

    Raises:
        SurgbenchError: Something cannot be written, or a dataset or record is at fault.
    """
    if only:
        return _rerun(definition, table_folder(definition, out, quick), data, jobs, make, watcher, only)
    with_pictures = definition.table.has_pictures and not quick
    if with_pictures:
        try:
            check_matplotlib()
        except SurgbenchError as error:  # said before the work, and no reason not to do it
            watcher.say(f"{FIGURE_PNG} and other pictures will be left out: {error}")
            with_pictures = False
    folder = table_folder(definition, out, quick)
    blocks, failures = do_work(definition, folder, data, jobs, quick, make, watcher)
    results = derive(definition, blocks, folder, quick, watcher)
    sheet = find_task(definition.table.task).sheet
    drawn = sheet.draw(definition, blocks, results, folder) if with_pictures else []
    results.about["figure"] = FIGURE_PNG in drawn
    further = [name for name in drawn if name != FIGURE_PNG]
    if further:
        results.about["pictures"] = further
    _write_all(definition, results, folder)
    return results, failures


def _rerun(
    definition: Definition,
    folder: Path,
    data: Path,
    jobs: int,
    make: MakeDataset,
    watcher: Watcher,
    only: Collection[str],
) -> tuple[Results, list[str]]:
    before = read_results(folder)  # first: what is not whole cannot be mended this way
    part = replace(definition, table=narrowed(definition.table, only))
    blocks, failures = do_work(part, folder, data, jobs, False, make, watcher)
    results = merged(definition, before, derive(part, blocks, folder, False, watcher))
    if definition.table.has_pictures:
        watcher.say(f"{folder}: pictures stay as they are; only a run of the whole table draws them")
    _write_all(definition, results, folder)
    return results, failures


def _write_all(definition: Definition, results: Results, folder: Path) -> None:
    sheet = find_task(definition.table.task).sheet
    texts = {
        LEADERBOARD_CSV: csv_text(to_frame(results.rows, sheet.leaderboard(results.rows))),
        SEQUENCES_CSV: csv_text(to_frame(results.sequences, sheet.sequences(results.sequences))),
        RECORDS_JSON: json_text(results.about),
        LEADERBOARD_MD: sheet.page(definition, results),
    }
    for name, text in texts.items():
        _write(folder / name, text)


def render(definition: Definition, folder: Path) -> Path:
    """Write ``leaderboard.md`` again from the other files, after a change of the table's words.

    Raises:
        SurgbenchError: The files are not there or damaged, lack a row, or it cannot be written.
    """
    results = read_results(folder)
    there = {row["row_id"] for row in results.rows}
    missing = [row.id for _, row in definition.table.rows() if row.id not in there]
    if missing:
        raise DatasetError(
            f"{folder / LEADERBOARD_CSV}: has no row '{missing[0]}' of the table; run it (--row {missing[0]})"
        )
    _write(folder / LEADERBOARD_MD, find_task(definition.table.task).sheet.page(definition, results))
    return folder / LEADERBOARD_MD


def _write(path: Path, text: str) -> None:
    try:
        write_atomic(path, text.encode())
    except OSError as error:
        raise SurgbenchError(f"{path}: cannot be written ({error.strerror})") from None
