"""A comparison as tables of text: who wins how often, every pair with its difference, and mean ranks.

Whoever shows a comparison (the terminal, Markdown, LaTeX, a page) sets :func:`comparison_tables`.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from surgbench.report.column import NO_VALUE, Column
from surgbench.report.fold import TABLE_WIDTH, Head, plain, print_folded
from surgbench.report.latex import booktabs
from surgbench.report.latex import escape as escape_latex
from surgbench.report.markdown import escape, markdown_table
from surgbench.report.paired_tests import SIGNIFICANT, Comparison, RowPair

if TYPE_CHECKING:
    from rich.console import Console

HEADING, MATRIX, PAIRS = "Compared by pairs", "Sequences won", "Differences"


@dataclass(frozen=True)
class TextTable:
    """A table that is ready to be set.

    Attributes:
        heading: Over it.
        note: How it is read; one line.
        columns: Headings of its columns.
        lines: Its cells, each line as long as ``columns``.
        text_columns: The first so many hold text; the others stand on the right.
    """

    heading: str
    note: str
    columns: tuple[str, ...]
    lines: tuple[tuple[str, ...], ...]
    text_columns: int


def comparison_tables(comparison: Comparison) -> tuple[TextTable, ...]:
    """The matrix of wins, and the list of pairs; none where there are less than two rows."""
    if not comparison.pairs:
        return ()
    return _matrix(comparison), _pairs(comparison)


def comparison_notes(comparison: Comparison) -> tuple[str, ...]:
    """What has to be known besides, one line each: ranks, too few sequences, rows that are not compared."""
    notes = []
    ranks = comparison.ranks
    if ranks is not None:
        apart = "are not" if ranks.p >= SIGNIFICANT else "are"
        notes.append(
            f"Over the {ranks.sequences} sequences that all rows have, the rows {apart} told apart as a whole "
            f"(Friedman, p {p_text(ranks.p)}); critical difference of mean ranks (Nemenyi, 5 %): "
            f"{ranks.critical_difference:.2f}."
        )
    if comparison.pairs and comparison.too_few:
        most = max(pair.sequences for pair in comparison.pairs)
        many = "1 pair" if len(comparison.pairs) == 1 else f"{len(comparison.pairs)} pairs"
        notes.append(f"{_sequences(most)} for {many} are too few for any difference to be significant.")
    if comparison.left_out:
        notes.append(f"Not compared: {'; '.join(comparison.left_out)}.")
    return tuple(notes)


def p_text(p: float | None) -> str:
    """A p as it is shown."""
    if p is None:
        return NO_VALUE
    return "< 0.001" if p < 0.001 else f"{p:.3f}"


def difference_text(column: Column, value: float | None) -> str:
    """A difference with its sign."""
    text = column.text(None if value is None else abs(value))
    return text if value is None else f"{'−' if value < 0 else '+'}{text}"


def heading(comparison: Comparison) -> str:
    """What is compared."""
    return f"{comparison.dataset}, {comparison.title}: {comparison.error.name}"


def table(comparisons: Iterable[Comparison], width: int = TABLE_WIDTH) -> str:
    """What a terminal shows, as plain text."""
    return plain(lambda console: print_comparisons(comparisons, console), width)


def print_comparisons(comparisons: Iterable[Comparison], console: Console) -> None:
    """Print wins, differences and ranks, folded where the console is narrow."""
    from rich.text import Text

    for one in comparisons:
        console.print(Text(heading(one), style="bold"))
        tables = comparison_tables(one)
        for shown in tables:
            head = [Head(name, is_text=place < shown.text_columns) for place, name in enumerate(shown.columns)]
            print_folded(shown.heading, head, shown.lines, console, kept=shown.text_columns)
            console.print(Text(shown.note))
        notes = comparison_notes(one) if tables else ("Less than two rows to compare.", *comparison_notes(one))
        for note in notes:
            console.print(Text(note))


def markdown(comparisons: Iterable[Comparison]) -> str:
    """A section for each comparison that has pairs."""
    parts = []
    for one in comparisons:
        tables = comparison_tables(one)
        if tables:
            parts.append(f"### {HEADING}: {escape(heading(one))}")
        for table in tables:
            lines = [[escape(cell) for cell in line] for line in (table.columns, *table.lines)]
            parts += [table.note, markdown_table(lines, table.text_columns)]
        parts += map(escape, comparison_notes(one) if tables else ())
    return "\n\n".join(parts) + "\n" if parts else ""


def latex(comparisons: Iterable[Comparison]) -> str:
    """Two ``table`` environments for each, for a preamble with the package ``booktabs``."""
    parts = ["% \\usepackage{booktabs}\n"]
    for one in comparisons:
        for table in comparison_tables(one):
            notes = comparison_notes(one) if table.heading == MATRIX else ()
            caption = " ".join([f"{heading(one)}.", table.note, *notes])
            name = f"{one.dataset} {one.title} {one.error.key} {table.heading}"
            letters = "l" * table.text_columns + "r" * (len(table.columns) - table.text_columns)
            head, *lines = ([escape_latex(cell) for cell in line] for line in (table.columns, *table.lines))
            parts.append(booktabs(caption, name, letters, [head], lines))
    return "\n".join(parts)


def _matrix(comparison: Comparison) -> TextTable:
    ranks, names = comparison.ranks, comparison.rows
    columns = ["", "row", *(["rank"] if ranks else []), *(str(place + 1) for place in range(len(names)))]
    lines = []
    for place, name in enumerate(names):
        cells = [str(place + 1), name, *([f"{ranks.mean[name]:.2f}"] if ranks else [])]
        cells += [NO_VALUE if other == name else _won(comparison.pair(name, other)) for other in names]
        lines.append(tuple(cells))
    note = (
        "In how many sequences a row's error is smaller : larger than that of the row of that number; * where the "
        f"difference is significant (Wilcoxon, Holm, {100 * SIGNIFICANT:.0f} %)."
    )
    return TextTable(MATRIX, note, tuple(columns), tuple(lines), 2)


def _won(pair: RowPair) -> str:
    return f"{pair.wins}:{pair.losses}{'*' if pair.significant else ''}" if pair.sequences else NO_VALUE


def _pairs(comparison: Comparison) -> TextTable:
    error = comparison.error
    unit = f" [{error.unit}]" if error.unit else ""
    found = (f"difference{unit}", f"95 % interval{unit}", "p", "p (Holm)", "won:lost:tied")
    columns = ("row", "against", *found)
    lines = tuple(
        (
            pair.row_a,
            pair.row_b,
            difference_text(error, pair.difference),
            NO_VALUE
            if pair.low is None
            else f"{difference_text(error, pair.low)} to {difference_text(error, pair.high)}",
            p_text(pair.p),
            p_text(pair.p_holm),
            f"{pair.wins}:{pair.losses}:{pair.ties}",
        )
        for pair in comparison.pairs
    )
    note = (
        f"Mean difference of the {error.name} on the same sequences (− is less than the other row's), its interval by "
        "bootstrap over sequences, p of Wilcoxon's signed ranks, also after Holm's correction for all pairs, and how "
        "many sequences were won, lost and tied."
    )
    return TextTable(PAIRS, note, columns, lines, 2)


def _sequences(number: int) -> str:
    return "1 sequence" if number == 1 else f"{number} sequences"
