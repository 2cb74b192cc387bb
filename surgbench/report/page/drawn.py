"""What the page's script draws: accuracy against latency, and errors over time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from surgbench.report.column import Column
from surgbench.report.page.boards import Group
from surgbench.report.page.content import clipped
from surgbench.report.page.curves import (
    LATENCY,
    Curves,
    point,
    points_for,
    share_of,
    thinned,
    units_shown,
    values_of,
)
from surgbench.report.page.moments import Choice, Drawing, choose, described, row_name

MOST_DECIMALS = 6


def drawn(all_curves: Sequence[Curves], drawings: Sequence[Drawing]) -> dict[str, Any]:
    """What the script reads, as JSON has it.

    Args:
        all_curves: Of all tables.
        drawings: Runs whose moments have pictures; their units are shown whatever there is room for.
    """
    share = share_of(all_curves)
    points = points_for(all_curves)
    pictured = {(one.curves.group.number, one.unit) for one in drawings}
    return {"points": points, "boards": [_board(curves, share, points, pictured) for curves in all_curves]}


def _board(curves: Curves, share: float, points: int, pictured: set[tuple[int, str]]) -> dict[str, Any]:
    group = curves.group
    spread = units_shown(curves, share)
    units = [one for one in curves.units if one in spread or (group.number, one) in pictured]
    return {
        "title": clipped(group.title),
        "rows": [
            {"name": row_name(curves, place), "anchor": group.anchors[place], "place": place} for place in group.whole
        ],
        "scatter": _scatter(group),
        "measures": [_measure(column) for column in curves.measures],
        "units": [clipped(unit) for unit in units],
        "unitsOfAll": len(curves.units),
        "runs": [
            {"row": place, "unit": number, **_run(curves, place, unit, points)}
            for number, unit in enumerate(units)
            for place in group.whole
            if (place, unit) in curves.runs
        ],
    }


def _measure(column: Column) -> dict[str, Any]:
    decimals = 3 if column.decimals is None else min(column.decimals, MOST_DECIMALS)
    return {"name": column.name, "unit": column.unit, "decimals": decimals}


def _run(curves: Curves, place: int, unit: str, points: int) -> dict[str, Any]:
    record = curves.runs[place, unit]
    index = record.frames.index
    lines: list[Mapping[str, Any] | None] = []
    for column in curves.measures:
        values = values_of(record, column)
        kept = thinned(values, points)
        if len(kept):
            x, y = [index[at] for at in kept], [point(values[at]) for at in kept]
            lines.append({"x": x, "y": y, "mean": point(float(np.nanmean(values)))})
        else:
            lines.append(None)
    moments: list[dict[str, Any]] = []
    if curves.measures:
        values = values_of(record, curves.measures[0])
        drawing = Drawing(curves, place, unit, ())
        moments = [_moment(drawing, choice, curves) for choice in choose(values)]
    return {"lines": lines, "moments": moments}


def _moment(drawing: Drawing, choice: Choice, curves: Curves) -> dict[str, Any]:
    moment = described(drawing, choice)
    here: list[float | None] = []
    for column in curves.measures:
        values = values_of(drawing.record, column)
        there = choice.place < len(values) and np.isfinite(values[choice.place])
        here.append(point(float(values[choice.place])) if there else None)
    text = moment.value
    return {"kind": moment.kind, "frame": moment.frame, "text": text, "values": here, "picture": moment.anchor}


def _scatter(group: Group) -> dict[str, Any]:
    """Of each sound row its median latency and its errors."""
    errors = [column for column in group.task.shown if column.best and column.key != LATENCY]
    rows = [group.rows[place] for place in group.whole]
    known = [column for column in errors if any(_finite(row.get(column.key)) for row in rows)]
    points = [
        {
            "row": place,
            "x": point(group.rows[place][LATENCY]),
            "y": [
                point(value * column.scale) if _finite(value := group.rows[place].get(column.key)) else None
                for column in known
            ],
            "floor": bool(group.rows[place].get("floor")),
        }
        for place in group.whole
        if group.rows[place]["status"] == "ok" and _finite(group.rows[place].get(LATENCY)) and group.rows[place][LATENCY] > 0
    ]
    return {"measures": [_measure(column) for column in known], "points": points}


def _finite(value: Any) -> bool:
    return isinstance(value, int | float) and bool(np.isfinite(value))
