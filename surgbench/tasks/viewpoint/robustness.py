"""How errors grow with what a trial is disturbed by: a table for a block's page, and curves. These need Matplotlib."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from surgbench.files import write_atomic
from surgbench.report.column import Column
from surgbench.report.markdown import markdown_table
from surgbench.report.row import Row
from surgbench.tasks.viewpoint.columns import AN, FD, P999, PF, PN, TRUE_VVA, VVA

if TYPE_CHECKING:
    from matplotlib.axes import Axes

ROBUSTNESS_PNG = "robustness.png"
# A curve for each: the level along it, what else makes the disturbance, the axis, and its unit in the level's.
FAMILIES: dict[str, tuple[tuple[str, ...], str, float]] = {
    "told_lag": ((), "lag told [true ones]", 1.0),
    "jitter_s": ((), "up to so late [ms]", 1e3),
    "dropouts": (("dropout_s",), "missing [%]", 1e2),
    "noise_m": (("noise_rad",), "noise [mm]", 1e3),
    "registration_error_m": ((), "base off [mm]", 1e3),
}
NOTHING = {"told_lag": 1.0}
ERRORS = {"vva_deg": "VVA [deg]", "fd_mm": "FD [mm]", "vva_true_deg": "true VVA [deg]"}
# Of these the controllers' are orders of magnitude apart; the third is the registration's first of all.
LOGARITHMIC = ("vva_deg", "fd_mm")
TABLE = (
    VVA,
    FD,
    PF,
    AN,
    PN,
    TRUE_VVA,
    Column("visibility_any_percent", "seen any", "%", 2),
    Column("no_go_samples", "in the zone"),
    Column("floor_samples", "below the floor"),
    Column("proximity_samples", "too near"),
    P999,
)
# Okabe and Ito's, apart for colour-blind eyes too.
COLOURS, MARKERS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "black"), "osD^vP"
DPI = 130


@dataclass(frozen=True)
class Level:
    """One row of a block.

    Attributes:
        controller: Whose.
        levels: Of its disturbance, :meth:`surgbench.viewpoint.disturbance.Disturbance.levels`.
        row: Its line of the leaderboard, of all samples.
    """

    controller: str
    levels: Mapping[str, float]
    row: Row


def curves(found: Sequence[Level], family: str) -> dict[str, list[tuple[float, Row]]]:
    """A disturbance's levels and rows of each controller, by level; the undisturbed row is where there is nothing.

    Args:
        found: Rows of a block.
        family: Of :data:`FAMILIES`.

    Returns:
        Controller to at least two points, in the order in which controllers come.
    """
    beside = FAMILIES[family][0]
    lines: dict[str, list[tuple[float, Row]]] = {}
    for one in found:
        if set(one.levels) <= {family, *beside}:
            level = one.levels.get(family, NOTHING.get(family, 0.0))
            lines.setdefault(one.controller, []).append((level, one.row))
    return {name: sorted(line, key=lambda point: point[0]) for name, line in lines.items() if len(line) > 1}


def draw_robustness(found: Sequence[Level], path: Path, title: str) -> bool:
    """Errors against levels: a column of panels for each disturbance, a line for each controller.

    Args:
        found: Rows of a block.
        path: PNG to write.
        title: Over the figure.

    Returns:
        Whether there was anything to draw.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    families = [family for family in FAMILIES if curves(found, family)]
    if not families:
        return False
    names = list(dict.fromkeys(one.controller for one in found))
    figure = Figure(figsize=(3.1 * len(families), 2.5 * len(ERRORS) + 0.7), layout="constrained")
    FigureCanvasAgg(figure)  # no display, no global state
    axes = figure.subplots(len(ERRORS), len(families), squeeze=False, sharex="col", sharey="row")
    for column, family in enumerate(families):
        for panel, (error, label) in zip(axes[:, column], ERRORS.items(), strict=True):
            _draw_lines(panel, curves(found, family), names, error, FAMILIES[family][2])
            if column == 0:
                panel.set_ylabel(label)
        axes[-1, column].set_xlabel(FAMILIES[family][1])
    for panel, error in zip(axes[:, 0], ERRORS, strict=True):
        if error not in LOGARITHMIC:
            panel.set_ylim(bottom=0)  # after all of its row are drawn: it ends their scaling
    handles = {line.get_label(): line for panel in axes.flat for line in panel.get_lines()}
    figure.legend(
        [handles[name] for name in names if name in handles], [name for name in names if name in handles],
        loc="outside upper center", ncols=len(names), frameon=False, title=title,
    )  # fmt: skip
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=DPI, metadata={"Software": None})
    write_atomic(path, buffer.getvalue())
    return True


def _draw_lines(
    panel: Axes, lines: Mapping[str, list[tuple[float, Row]]], names: Sequence[str], error: str, unit: float
) -> None:
    for name, line in lines.items():
        points = [(unit * level, row[error]) for level, row in line if row[error] is not None]
        at = names.index(name)
        marker, colour = MARKERS[at % len(MARKERS)], COLOURS[at % len(COLOURS)]
        panel.plot(*zip(*points, strict=True) if points else ((), ()), marker=marker, ms=4, color=colour, label=name)
    if error in LOGARITHMIC:
        panel.set_yscale("log")
    panel.grid(color="0.9", lw=0.6)
    panel.set_axisbelow(True)
    for side in ("top", "right"):
        panel.spines[side].set_visible(False)


def robustness_table(rows: Sequence[Row]) -> str:
    """Markdown: a line for each row, of all its samples.

    Args:
        rows: Of a block, one a row id.
    """
    lines = [["controller", "row id", "disturbed by", "samples", *(column.heading for column in TABLE)]]
    for row in rows:
        cells = [column.text(row[column.key]) for column in TABLE]
        lines.append([row["label"], f"`{row['row_id']}`", row["disturbance"] or "nothing", str(row["samples"]), *cells])
    return markdown_table(lines, text_columns=3)
