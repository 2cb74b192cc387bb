"""Rows as tables for a paper: LaTeX with booktabs, the best value of a column in bold, the second underlined."""

from __future__ import annotations

import re
from collections.abc import Sequence

from surgbench.config import one_line
from surgbench.report.column import STATUS, VARIANT, Column
from surgbench.report.leaderboard import Ranking, groups, reason, set_columns, unsound, variant_tells
from surgbench.report.row import Row
from surgbench.task import find_task

# Whatever a name holds is shown, and never read as a command.
_ESCAPED = {
    "\\": r"\textbackslash{}", "{": r"\{", "}": r"\}", "$": r"\$", "&": r"\&", "#": r"\#", "%": r"\%", "_": r"\_",
    "^": r"\textasciicircum{}", "~": r"\textasciitilde{}", "<": r"\textless{}", ">": r"\textgreater{}",
    "|": r"\textbar{}", "–": "--", "—": "---", "−": r"$-$", "±": r"$\pm$", "×": r"$\times$", "°": r"$^\circ$",
    "µ": r"$\mu$", "μ": r"$\mu$", "≤": r"$\leq$", "≥": r"$\geq$", "…": r"\ldots{}",
}  # fmt: skip
_SPECIAL = re.compile("|".join(map(re.escape, _ESCAPED)))


def escape(text: str) -> str:
    """A text as it may stand in a cell, in one line, without characters that LaTeX cannot set."""
    return _SPECIAL.sub(lambda found: _ESCAPED[found[0]], " ".join(one_line(text).split()))


def latex(rows: Sequence[Row]) -> str:
    """One ``table`` environment per dataset and number of arms, for a preamble with the package ``booktabs``.

    Args:
        rows: From :func:`surgbench.report.rows.derive_rows`.
    """
    parts = ["% \\usepackage{booktabs}; best in bold, second best underlined, floors and failed runs not ranked\n"]
    for title, group in groups([row for row in rows if find_task(row["task"]).on_page(row)]):
        parts.append(_table(title, group))
    return "\n".join(parts)


def _table(title: str, rows: list[Row]) -> str:
    telling = variant_tells(rows)
    columns, ranking = (
        [column for column in set_columns(rows) if telling or column is not VARIANT],
        Ranking(rows),
    )
    failed = unsound(rows)
    if failed:
        columns.append(STATUS)
    letters = "".join("l" if column.decimals is None else "r" for column in columns)
    names = [escape(column.name) for column in columns]
    units = [f"[{escape(column.unit)}]" if column.unit else "" for column in columns]
    lines = [[_cell(column, row, ranking) for column in columns] for row in rows]
    return booktabs(title, title, letters, [names, units], lines, [reason(row) for row in failed])


def booktabs(
    caption: str,
    name: str,
    letters: str,
    head: Sequence[Sequence[str]],
    lines: Sequence[Sequence[str]],
    remarks: Sequence[str] = (),
) -> str:
    """A ``table`` environment.

    Args:
        caption: Plain text.
        name: Plain text that its label is made of.
        letters: How each column stands, ``lr``.
        head: Lines over the rule, of cells that are LaTeX already.
        lines: Lines below it.
        remarks: Plain text; comments in the source.
    """
    label = re.sub(r"[^a-z0-9]+", "-", name.lower()).strip("-")
    return "\n".join(
        [
            r"\begin{table}",
            r"  \centering",
            rf"  \caption{{{escape(caption)}}}",
            rf"  \label{{tab:{label}}}",
            rf"  \begin{{tabular}}{{{letters}}}",
            r"    \toprule",
            *(rf"    {' & '.join(cells)} \\" for cells in head),
            r"    \midrule",
            *(rf"    {' & '.join(cells)} \\" for cells in lines),
            r"    \bottomrule",
            r"  \end{tabular}",
            *(f"  % {escape(remark)}" for remark in remarks),
            r"\end{table}",
            "",
        ]
    )


def _cell(column: Column, row: Row, ranking: Ranking) -> str:
    text = escape(column.cell(row))
    return {1: rf"\textbf{{{text}}}", 2: rf"\underline{{{text}}}"}.get(ranking.place(column, row) or 0, text)
