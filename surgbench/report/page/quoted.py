"""Published figures beside ours: tables of their own, for their data and machines are others."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from surgbench.errors import SurgbenchError
from surgbench.report.column import NO_VALUE, Column
from surgbench.report.page.content import Board, Cell, Head, Line
from surgbench.reproduce.published import Figure, Published, load_published
from surgbench.task import Task

QUOTED = "quoted"


def quoted_boards(names: Iterable[str], tasks: Sequence[Task]) -> list[Board]:
    """A table for each of a source's tables and datasets.

    Args:
        names: Of files in ``configs/published/``, or files.
        tasks: That the page is about; how they show a column, figures are shown.

    Raises:
        NotFoundError: No such file.
        ConfigError: It is wrong; one line.
    """
    columns = _columns(tasks)
    sources = enumerate(map(load_published, names))
    return [one for number, source in sources for one in _of_source(source, columns, number)]


def _columns(tasks: Sequence[Task]) -> dict[str, Column]:
    found: dict[str, Column] = {}
    for task in tasks:
        try:
            measures = task.sheet.measures
        except SurgbenchError:  # it has no reproduced tables
            measures = ()
        for column in (*measures, *task.shown):
            found.setdefault(column.key, column)
    return found


def _of_source(source: Published, columns: dict[str, Column], number: int) -> list[Board]:
    tables: dict[tuple[str, str], list[str]] = {}
    for key, row in source.rows.items():
        for dataset in row.data:
            tables.setdefault((row.table, dataset), []).append(key)
    boards: list[Board] = []
    for (table, dataset), keys in tables.items():
        used = [key for key in source.units if any(key in source.rows[one].data[dataset] for one in keys)]
        own = [columns.get(key, Column(key, key, source.units[key], 3)) for key in used]
        heads = (Head("row", is_text=True), *(Head(column.name, column.unit) for column in own))
        anchor = f"quoted-{number}-{len(boards)}"
        lines = tuple(
            Line(
                f"{anchor}-{place}",
                source.rows[key].label,
                tuple(_cell(column, source.rows[key].data[dataset].get(column.key)) for column in own),
                QUOTED,
                badges=(QUOTED,),
            )
            for place, key in enumerate(keys)
        )
        note = f"Quoted from {source.source}; times on {source.machine}. Other data than above: not ranked."
        boards.append(Board(anchor, f"{source.short}, {table}, {dataset}", heads, lines, note))
    return boards


def _cell(column: Column, value: float | Figure | None) -> Cell:
    if value is None:
        return Cell(NO_VALUE)
    mean, spread = (value.mean, value.std) if isinstance(value, Figure) else (value, None)
    return Cell(column.with_spread(mean, spread), mean)
