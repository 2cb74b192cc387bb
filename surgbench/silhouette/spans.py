"""Compiled: from the contour of a state to the pixel spans that its silhouette covers, row by row.

No image is made: the overlap of a span with a reference mask is one difference in a per-row prefix sum.

A pixel is covered where its centre is: column ``c`` of row ``r`` belongs to a span that begins at the first ``c >= u``
of its left edge and ends before the first ``c >= u`` of its right edge, and an edge crosses row ``r`` when
``v_low <= r < v_high``. Crossings are computed from the upper to the lower end of an edge, so that two facets which
share an edge agree on it to the last bit.

A closed body has as many edges going up across a row as down. In most rows it has one of each, which are written
straight into the two halves of a span; only where there are more are its crossings collected, sorted and wound up. The
spans of several bodies are then merged, row by row. A body seen edge-on may end before it begins, by rounding: such a
span is empty.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from surgbench.compiled import compiled
from surgbench.geometry import FloatArray
from surgbench.silhouette.layout import Bodies, Indices, Mesh

# A packed span sorts by its first column.
COLUMN_BITS = 32
COLUMN_MASK = (1 << COLUMN_BITS) - 1


class Rows(NamedTuple):
    """Scratch, and after :func:`cover` the spans of every row, unsorted and overlapping.

    Spans lie in layers: span ``m`` of row ``r`` is ``spans[m * H + r]``, so that neighbouring rows are neighbours in
    memory. The last layer takes what has no room.
    """

    u: FloatArray  # (C,) upper end of each contour edge, ...
    v: FloatArray
    slope: FloatArray  # ... columns per row, ...
    first: NDArray[np.int32]  # ... first row, ...
    last: NDArray[np.int32]  # ... row before which it ends, ...
    begins: NDArray[np.int32]  # ... and 1 where the silhouette begins at it, 0 where it ends
    tally: NDArray[np.int32]  # (H,) crossings of the body in work
    slot: NDArray[np.int32]  # (H,) place of the next span's halves in ``columns``: 2 * (m * H + r)
    spans: NDArray[np.int64]  # (layers * H,) first column << COLUMN_BITS | column after the last
    columns: Indices  # (2 * layers * H,) the same memory by halves: end, begin
    merged: NDArray[np.int64]  # (layers,) spans of the row in work
    crossings: Indices  # (K,) numbers of edges, row by row
    offset: NDArray[np.int32]  # (H,) where a row's crossings lie


def rows_scratch(bodies: Bodies, mesh: Mesh, height: int, layers: int | None = None) -> Rows:
    """Room for the spans of any state; ``layers`` spans a row, a few more than bodies unless told."""
    layers = len(bodies.link) + 4 if layers is None else layers
    most = len(mesh.edge_start) + len(mesh.faces) + 1
    spans = np.zeros(layers * height, np.int64)
    u, v, slope = np.empty((3, most))
    first, last, begins = np.empty((3, most), np.int32)
    return Rows(
        u=u, v=v, slope=slope,
        first=first, last=last, begins=begins,
        tally=np.zeros(height, np.int32),
        slot=np.arange(0, 2 * height, 2, dtype=np.int32),
        spans=spans,
        # The lower half comes first in memory on every machine that numba supports.
        columns=spans.view(np.uint32),
        merged=np.empty(layers, np.int64),
        crossings=np.empty(8 * most, np.uint32),
        offset=np.empty(height, np.int32),
    )  # fmt: skip


@compiled
def _prepare(count: int, u0: Any, v0: Any, u1: Any, v1: Any, mirrored: bool, lines: int, rows: Any) -> Any:
    """Turn each edge downwards and find the rows it crosses."""
    height = float(lines)
    for n in range(count):
        down = v1[n] > v0[n]
        rows.first[n] = np.int32(np.ceil(min(max(min(v0[n], v1[n]), 0.0), height)))
        rows.last[n] = np.int32(np.ceil(min(max(max(v0[n], v1[n]), 0.0), height)))
        rows.slope[n] = (u1[n] - u0[n]) / (v1[n] - v0[n])
        rows.u[n] = u0[n] if down else u1[n]
        rows.v[n] = v0[n] if down else v1[n]
        rows.begins[n] = 0 if down != mirrored else 1


@compiled(inline="always")
def crossing(n: Any, row: int, rows: Any) -> Any:
    """Where edge n crosses a row, pixels."""
    return rows.u[n] + (row - rows.v[n]) * rows.slope[n]


@compiled(inline="always")
def column(u: float, width: float) -> Any:
    """First column whose pixel centre lies at or right of u, within [0, width]."""
    return np.uint32(min(max(np.ceil(u), 0.0), width))


@compiled
def _enter(first_edge: int, last_edge: int, top: int, bottom: int, width: float, numbers: bool, rows: Any) -> Any:
    """Write edges into their rows' next span; returns the rows touched so far."""
    columns, tally, slot = rows.columns, rows.tally, rows.slot
    for n in range(first_edge, last_edge):
        first, last = rows.first[n], rows.last[n]
        u, v, slope, half = rows.u[n], rows.v[n], rows.slope[n], rows.begins[n]
        if numbers:
            for row in range(first, last):
                columns[slot[row] + half] = n
                tally[row] += 1
        else:
            for row in range(first, last):
                columns[slot[row] + half] = np.uint32(min(max(np.ceil(u + (row - v) * slope), 0.0), width))
                tally[row] += 1
        top, bottom = min(top, first), max(bottom, last)
    return top, bottom


@compiled
def _advance(tally: Any, slot: Any, step: Any, end: Any) -> Any:
    """Count the spans that are complete; true if some row has more crossings than one span's."""
    more = np.int32(0)
    for r in range(tally.shape[0]):
        slot[r] += step if (tally[r] == 2) & (slot[r] < end) else np.int32(0)
        more |= tally[r] > 2
    return more != 0


@compiled
def _wind(
    b: int, top: int, bottom: int, step: int, end: int, width: float, numbers: bool, contour: Any, rows: Any
) -> Any:
    """Spans of body b in those of its rows which have more than two crossings."""
    tally, offset, crossings = rows.tally, rows.offset, rows.crossings
    row = top
    while row < bottom:
        # As many rows at once as there is room for; a single row always has.
        stop, room = row, crossings.shape[0]
        while stop < bottom and (tally[stop] <= 2 or tally[stop] <= room):
            offset[stop] = crossings.shape[0] - room
            room -= tally[stop] if tally[stop] > 2 else 0
            stop += 1
        for part in range(2):
            starts = contour.start if part == 0 else contour.closing
            for n in range(starts[b], starts[b + 1]):
                first, last = np.int64(rows.first[n]), np.int64(rows.last[n])
                for r in range(max(row, int(first)), min(stop, int(last))):
                    if tally[r] > 2:
                        crossings[offset[r]] = n
                        offset[r] += 1
        for r in range(row, stop):
            if tally[r] <= 2:
                continue
            line = crossings[offset[r] - tally[r] : offset[r]]
            winding = 0
            for k in range(line.shape[0]):
                # The next from the left.
                for m in range(k + 1, line.shape[0]):
                    if crossing(line[m], r, rows) < crossing(line[k], r, rows):
                        line[k], line[m] = line[m], line[k]
                before = winding
                winding += 1 if rows.begins[line[k]] else -1
                if before == 0 or winding == 0:
                    value = np.uint32(line[k]) if numbers else column(crossing(line[k], r, rows), width)
                    rows.columns[rows.slot[r] + (1 if before == 0 else 0)] = value
                    if winding == 0 and rows.slot[r] < end:
                        rows.slot[r] += step
        row = stop


@compiled
def cover(
    edges: int, bodies: Any, contour: Any, rows: Any, width: int, height: int, across: bool, numbers: bool
) -> Any:
    """Fill the spans of the traced contour.

    Args:
        edges: How many edges the contour has.
        bodies: The parts.
        contour: Their contours.
        rows: Filled with the spans.
        width: Of the image.
        height: Of the image.
        across: Whether the columns of the image take the place of its rows.
        numbers: Whether spans consist of the numbers of the edges that bound them, instead of their columns.

    Returns:
        The first row and the row after the last.
    """
    if across:
        width, height = height, width
        _prepare(edges, contour.v0, contour.u0, contour.v1, contour.u1, True, height, rows)
    else:
        _prepare(edges, contour.u0, contour.v0, contour.u1, contour.v1, False, height, rows)
    step = np.int32(2 * height)
    end = np.int32(rows.columns.shape[0] - 2 * height)
    limit = float(width)
    top, bottom = height, 0
    for b in range(bodies.link.shape[0]):
        a, z = _enter(contour.start[b], contour.start[b + 1], height, 0, limit, numbers, rows)
        a, z = _enter(contour.closing[b], contour.closing[b + 1], a, z, limit, numbers, rows)
        if a >= z:
            continue
        if _advance(rows.tally[a:z], rows.slot[a:z], step, end):
            _wind(b, a, z, step, end, limit, numbers, contour, rows)
        rows.tally[a:z] = 0
        top, bottom = min(top, a), max(bottom, z)
    return top, bottom


@compiled
def _sum(
    top: int, bottom: int, width: int, height: int, slot: Any, spans: Any, merged: Any, prefix: Any, counts: Any
) -> Any:
    boxed = counts.shape[0] > 2
    covered, inside, furthest = np.int64(0), np.int64(0), np.int64(0)
    left, right, first_row, last_row = np.int64(width), np.int64(0), np.int64(height), np.int64(-1)
    for row in range(top, bottom):
        stop = np.int64(slot[row])
        slot[row] = 2 * row
        furthest = max(furthest, stop)
        begin, end = spans[row] >> COLUMN_BITS, spans[row] & COLUMN_MASK
        before = covered
        if stop > 2 * (height + row):  # more than one span
            count = 0
            for place in range(row, stop // 2, height):
                span = spans[place]
                j = count
                while j > 0 and merged[j - 1] > span:
                    merged[j] = merged[j - 1]
                    j -= 1
                merged[j] = span
                count += 1
            begin, end = merged[0] >> COLUMN_BITS, merged[0] & COLUMN_MASK
            for m in range(1, count):
                next_begin, next_end = merged[m] >> COLUMN_BITS, merged[m] & COLUMN_MASK
                if next_begin > end or end <= begin:
                    end = max(end, begin)
                    covered += end - begin
                    inside += np.int64(prefix[row, end]) - np.int64(prefix[row, begin])
                    if boxed and end > begin:
                        left, right = min(left, begin), max(right, end)
                    begin, end = next_begin, next_end
                else:
                    end = max(end, next_end)
        elif stop == 2 * row:  # none
            continue
        end = max(end, begin)
        covered += end - begin
        inside += np.int64(prefix[row, end]) - np.int64(prefix[row, begin])
        if boxed and end > begin:
            left, right = min(left, begin), max(right, end)
        if boxed and covered > before:
            first_row, last_row = min(first_row, np.int64(row)), np.int64(row)
    counts[0], counts[1] = covered, inside
    if boxed:
        counts[2], counts[3], counts[4], counts[5] = left, first_row, right, last_row + 1
    if boxed and covered == 0:
        counts[2:] = 0
    return furthest // (2 * height)


@compiled
def total(top: int, bottom: int, width: int, height: int, rows: Any, prefix: Any, counts: Any) -> Any:
    """Add up what the spans cover, and clear them.

    Args:
        top: First row filled.
        bottom: The row after the last.
        width: Of the image.
        height: Of the image.
        rows: The spans.
        prefix: ``(H, W + 1)`` integers: sum of an image's row before each column.
        counts: ``(2,)`` or ``(6,)``, filled: pixels covered, the sum of the image over them, and their bounding box.

    Returns:
        The layers that were needed.
    """
    return _sum(top, bottom, width, height, rows.slot, rows.spans, rows.merged, prefix, counts)


@compiled
def paint(top: int, bottom: int, height: int, rows: Any, image: Any) -> Any:
    """Set the pixels covered in ``image (H, W)`` bool; returns the layers that were needed; clears the rows."""
    furthest = np.int64(0)
    for row in range(top, bottom):
        stop = np.int64(rows.slot[row])
        furthest = max(furthest, stop)
        for place in range(row, stop // 2, height):
            image[row, rows.spans[place] >> COLUMN_BITS : rows.spans[place] & COLUMN_MASK] = True
        rows.slot[row] = 2 * row
    return furthest // (2 * height)


@compiled
def add_up(image: Any, prefix: Any) -> Any:
    """Fill ``prefix (H, W + 1)`` with the sum of each row of ``image (H, W)`` before each column; returns the total."""
    everything = np.int64(0)
    for row in range(image.shape[0]):
        total = np.int64(0)
        prefix[row, 0] = 0
        for col in range(image.shape[1]):
            total += np.int64(image[row, col])
            prefix[row, col + 1] = total
        everything += total
    return everything
