"""What the page's script draws: accuracy against latency, and errors over time."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from surgbench.geometry import FloatArray
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
    measured = [values_of(record, column) for column in curves.measures]
    lines = [_line(record.frames.index, values, points) for values in measured]
    drawing = Drawing(curves, place, unit, ())
    choices = choose(measured[0]) if measured else []
    return {"lines": lines, "moments": [_moment(drawing, choice, measured) for choice in choices]}


def _line(index: Sequence[int], values: FloatArray, points: int) -> dict[str, Any] | None:
    kept = thinned(values, points)
    if not len(kept):
        return None
    x, y = [index[place] for place in kept], [point(float(values[place])) for place in kept]
    return {"x": x, "y": y, "mean": point(float(np.nanmean(values)))}


def _moment(drawing: Drawing, choice: Choice, measured: Sequence[FloatArray]) -> dict[str, Any]:
    moment = described(drawing, choice)
    here = [values[choice.place] if choice.place < len(values) else np.nan for values in measured]
    return {
        "kind": moment.kind,
        "frame": moment.frame,
        "text": moment.value,
        "values": [point(float(value)) if np.isfinite(value) else None for value in here],
        "picture": moment.anchor,
    }


def _scatter(group: Group) -> dict[str, Any]:
    """Of each sound row its median latency and its errors."""
    sound = [place for place in group.whole if group.rows[place]["status"] == "ok"]
    timed = [place for place in sound if (_value(group.rows[place].get(LATENCY)) or 0.0) > 0.0]
    errors = [
        column
        for column in group.task.shown
        if column.best
        and column.key != LATENCY
        and any(_value(group.rows[place].get(column.key)) is not None for place in timed)
    ]
    points = [
        {
            "row": place,
            "x": _value(row[LATENCY]),
            "y": [_value(row.get(column.key), column.scale) for column in errors],
            "floor": bool(row.get("floor")),
        }
        for place in timed
        for row in [group.rows[place]]
    ]
    return {"measures": [_measure(column) for column in errors], "points": points}


def _value(value: Any, scale: float = 1.0) -> float | None:
    """A number as a picture needs it; ``None`` for anything else."""
    if not isinstance(value, int | float) or not np.isfinite(value * scale):
        return None
    return point(value * scale)
