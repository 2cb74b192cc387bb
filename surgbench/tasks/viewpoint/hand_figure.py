"""The article's Fig. 7 of simulated hands. Needs Matplotlib."""

from __future__ import annotations

import io
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from surgbench.files import write_atomic
from surgbench.report.figures import FIGURE_PNG
from surgbench.reproduce.published import Figure as PublishedFigure
from surgbench.tasks.viewpoint.hand_columns import MEASURES
from surgbench.tasks.viewpoint.hand_page import FIG7, condition

if TYPE_CHECKING:
    from surgbench.reproduce.results import Results
    from surgbench.reproduce.table import Definition

# Okabe and Ito's, apart for colour-blind eyes too.
COLOURS = {"endo": "#0072B2", "stat": "#E69F00", "aut": "#D55E00"}
DPI = 130


def draw_hands(definition: Definition, results: Results, folder: Path) -> list[str]:
    """One panel a measure: every person's mean over the wires, and the article's mean and deviation beside.

    Args:
        definition: With the published figures.
        results: Of the table.
        folder: Where it goes.

    Returns:
        The file's name.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    rows = [row for row in results.rows if row.get("hand") is not None]
    published = None if definition.published is None else definition.published.rows.get(FIG7)
    figure = Figure(figsize=(3.0 * len(MEASURES), 4.6), layout="constrained")
    FigureCanvasAgg(figure)  # no display, no global state
    panels = np.ravel(figure.subplots(1, len(MEASURES)))
    for panel, column in zip(panels, MEASURES, strict=True):
        for place, row in enumerate(rows):
            colour = COLOURS[condition(row)]
            own = [one for one in results.sequences if one["row_id"] == row["row_id"]]
            people = sorted({one["repeat"] for one in own})
            means = []
            for person in people:
                found = [one[column.key] for one in own if one["repeat"] == person and one[column.key] is not None]
                if found:
                    means.append(column.scale * float(np.mean(found)))
            spread = np.linspace(-0.15, 0.15, len(means)) if len(means) > 1 else np.zeros(len(means))
            panel.plot(place + spread, means, "o", color=colour, ms=4, alpha=0.75, mew=0)
            if means:
                panel.hlines(np.mean(means), place - 0.3, place + 0.3, color=colour, lw=2)
            value = None if published is None else published.data[condition(row)].get(column.key)
            if isinstance(value, PublishedFigure) and not row["steady"]:
                mean, std = column.scale * value.mean, column.scale * value.std
                panel.errorbar(place + 0.38, mean, std, color="0.55", fmt="D", ms=4, capsize=3, lw=1)
        panel.set_title(f"{column.name} [{column.unit}]" if column.unit else column.name, fontsize=10)
        panel.set_xticks(range(len(rows)), [row["label"] for row in rows], rotation=40, ha="right", fontsize=8)
        panel.set_xlim(-0.6, len(rows) - 0.3)
        panel.set_ylim(bottom=0)
        panel.grid(axis="y", color="0.9", lw=0.6)
        panel.set_axisbelow(True)
        for side in ("top", "right"):
            panel.spines[side].set_visible(False)
    figure.suptitle(
        "dots: simulated people, means over wires; bars: their mean; grey: six people of the article, mean ± deviation",
        fontsize=9,
    )
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=DPI, metadata={"Software": None})
    write_atomic(folder / FIGURE_PNG, buffer.getvalue())
    return [FIGURE_PNG]
