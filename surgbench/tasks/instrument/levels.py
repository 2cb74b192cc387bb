"""Errors over the level of what makes a dataset hard: a panel for each kind, a line for each row. Needs Matplotlib.

A block of a table says at which level of which kinds it stands; rows with the same label in several blocks make a line.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from surgbench.files import write_atomic
from surgbench.report.column import Column
from surgbench.report.row import Row
from surgbench.reproduce.table import Block, Table
from surgbench.tasks.instrument.columns import RECOVERY, SWAPS, TIPS
from surgbench.tasks.instrument.figure import COLOURS

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LEVELS_PNG = "levels.png"
MEASURES: tuple[Column, ...] = (TIPS, SWAPS, RECOVERY)
LINES = tuple(zip((*COLOURS, "#009E73", "#000000"), "os^DvP*", strict=True))
TICKS = (1.0, 3.0)  # of each decade of the errors that are labelled

# Of a kind and a label: levels and, for each, a row.
Curve = list[tuple[float, Row]]


def curves(blocks: Sequence[Block], rows: Sequence[Row]) -> dict[str, dict[str, Curve]]:
    """Kind of difficulty to label to its levels, increasing, each with the row there.

    Args:
        blocks: Of the table.
        rows: Of its leaderboard; those that were not run are left out.
    """
    found: dict[str, dict[str, Curve]] = {}
    for block in blocks:
        for kind, level in block.levels.items():
            for row in rows:
                if row["block"] == block.name and row["frames"]:
                    found.setdefault(kind, {}).setdefault(row["label"], []).append((level, row))
    for by_label in found.values():
        for curve in by_label.values():
            curve.sort(key=lambda one: one[0])
    return found


def draw_levels(table: Table, rows: Sequence[Row], path: Path) -> bool:
    """Draw all curves; ``False`` where there are none."""
    found = curves(table.blocks, rows)
    if not found:
        return False
    buffer = io.BytesIO()
    _figure(found).savefig(buffer, format="png", dpi=130, metadata={"Software": None})
    write_atomic(path, buffer.getvalue())
    return True


def _figure(found: dict[str, dict[str, Curve]]) -> Figure:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    labels = list(dict.fromkeys(label for by_label in found.values() for label in by_label))
    measures = [measure for measure in MEASURES if _is_known(measure, found)]
    figure = Figure(figsize=(3.0 * len(found) + 1.0, 2.6 * len(measures) + 1.0), layout="constrained")
    FigureCanvasAgg(figure)  # no display, no global state
    grid: Any = figure.subplots(len(measures), len(found), sharex="col", sharey="row", squeeze=False)
    for line, measure in enumerate(measures):
        for column, (kind, by_label) in enumerate(found.items()):
            panel = grid[line, column]
            for place, label in enumerate(labels):
                points = [
                    (level, row[measure.key] * measure.scale)
                    for level, row in by_label.get(label, [])
                    if row.get(measure.key) is not None
                ]
                colour, marker = LINES[place % len(LINES)]
                if points:
                    panel.plot(*zip(*points, strict=True), label=label, color=colour, marker=marker, lw=1.3, ms=4)
            panel.grid(color="0.9", lw=0.6)
            panel.set_axisbelow(True)
            for side in ("top", "right"):
                panel.spines[side].set_visible(False)
            if line == len(measures) - 1:
                panel.set_xlabel(kind.replace("_", " "))
        grid[line, 0].set_ylabel(measure.heading)
        if measure is TIPS:
            grid[line, 0].set_yscale("log")
            axis = grid[line, 0].yaxis
            axis.set_major_locator(LogLocator(subs=TICKS))
            axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
            axis.set_minor_formatter(NullFormatter())
        else:
            grid[line, 0].set_ylim(bottom=0.0)
    handles, names = grid[0, 0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside upper center", ncols=min(3, len(names)), frameon=False)
    return figure


def _is_known(measure: Column, found: dict[str, dict[str, Curve]]) -> bool:
    return any(
        row.get(measure.key) is not None
        for by_label in found.values()
        for curve in by_label.values()
        for _, row in curve
    )
