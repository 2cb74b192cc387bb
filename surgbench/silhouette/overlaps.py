"""Compiled: what two arms hide of each other, counted from the spans of both without an image.

Where spans of both arms overlap, tiles of the picture tell which is in front: the planes of the facets say between
which depths each arm's surface lies in a tile. Pixel by pixel is looked only at tiles that this does not settle.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from surgbench.compiled import compiled
from surgbench.geometry import FloatArray
from surgbench.silhouette.contour import Contour, contour_scratch, trace
from surgbench.silhouette.depths import is_aside, nearest_surface, place_body
from surgbench.silhouette.layout import Bodies, Indices, Lens, Links, Mesh
from surgbench.silhouette.nearness import TILE_PX, bound_nearness, reach
from surgbench.silhouette.spans import COLUMN_BITS, COLUMN_MASK, Rows, cover, rows_scratch, total

# Bounds of inverse depths that are no farther apart tell no order, relative: planes of facets are not exact.
UNSURE = 1e-4


class Arm(NamedTuple):
    """One arm, as :func:`surgbench.silhouette.layout.assemble` lays it out."""

    links: Links
    bodies: Bodies
    mesh: Mesh


class ArmScratch(NamedTuple):
    """Scratch of one arm, and after :func:`_count_alone` its spans."""

    contour: Contour
    rows: Rows
    stop: NDArray[np.int32]  # (H,) where a row's spans end, as ``rows.slot``
    points: FloatArray  # (V, 3) metres
    seen: FloatArray  # (V, 3) pixels, and inverse depth
    near: Indices  # (F, 3) faces that may reach into where the arms overlap
    depth: FloatArray  # (H, W) metres


class PairScratch(NamedTuple):
    """Scratch of both arms together."""

    overlap: NDArray[np.int32]  # (K, 3) row, first column and column after the last of spans that both cover
    bounds: FloatArray  # (2, rows, columns, 2) of the tiles
    order: NDArray[np.int8]  # (rows, columns) the arm behind in each tile; -1 where that is not told, 2 with pixels
    wanted: NDArray[np.bool_]  # (H, W) pixels in question, else false
    hidden: NDArray[np.int64]  # (2, 2) of one state: two threads may take the same one
    room: NDArray[np.int32]  # (H, W)
    corners: FloatArray  # (4, 3)


def arm_scratch(arm: Arm, lens: Lens, layers: int | None) -> ArmScratch:
    """Room for any state of an arm, with so many spans a row."""
    return ArmScratch(
        contour=contour_scratch(arm.links, arm.bodies, arm.mesh),
        rows=rows_scratch(arm.bodies, arm.mesh, lens.height, layers),
        stop=np.zeros(lens.height, np.int32),
        points=np.empty((len(arm.mesh.x), 3)),
        seen=np.empty((len(arm.mesh.x), 3)),
        near=np.empty((len(arm.mesh.faces), 3), np.uint32),
        depth=np.empty((lens.height, lens.width)),
    )


def pair_scratch(lens: Lens, layers: int) -> PairScratch:
    """Room for any pair of states, with so many spans a row of both arms together."""
    tiles = -(-lens.height // TILE_PX), -(-lens.width // TILE_PX)
    return PairScratch(
        overlap=np.empty((layers * lens.height, 3), np.int32),
        bounds=np.empty((2, *tiles, 2)),
        order=np.empty(tiles, np.int8),
        wanted=np.zeros((lens.height, lens.width), dtype=bool),
        hidden=np.zeros((2, 2), np.int64),
        room=np.empty((lens.height, lens.width), np.int32),
        corners=np.empty((4, 3)),
    )


@compiled
def score_pairs(
    states: Any, arms: Any, lens: Any, scratch: Any, pair: Any, prefixes: Any, counts: Any, hidden: Any, taken: Any,
    share: int, shares: int,
) -> Any:  # fmt: skip
    """What each of two arms covers of each state, and what the other hides of it.

    Threads share a batch as in :func:`surgbench.silhouette.kernel.score`.

    Args:
        states: ``(N, 18)`` float64.
        arms: Two.
        lens: The camera.
        scratch: Of each arm, of this thread.
        pair: Scratch of this thread.
        prefixes: Of each arm ``(H, W + 1)`` integers: sum of its mask's row before each column.
        counts: ``(2, 6, N)`` int64, filled with each arm's pixels, those in its mask, and their bounding box.
        hidden: ``(2, 2, N)`` int64, filled with each arm's pixels that the other hides, and those in its mask.
        taken: ``(N,)`` bool, set where a thread is at work on a state.
        share: Number of this thread.
        shares: Number of threads.

    Returns:
        As :func:`surgbench.silhouette.kernel.score`.
    """
    number = states.shape[0]
    layers = 0
    for k in range(shares):
        block = (share + k) % shares
        first, last = number * block // shares, number * (block + 1) // shares
        for m in range(last - first):
            s = first + m if k == 0 else last - 1 - m
            if taken[s]:
                continue
            taken[s] = True
            pair.hidden[:] = 0
            for a in range(2):
                own = states[s, 9 * a : 9 * (a + 1)]
                layers = max(layers, _count_alone(own, arms[a], lens, scratch[a], prefixes[a], counts[a, :, s]))
            one, other = counts[0, 2:, s], counts[1, 2:, s]
            # Of the rectangle in which both are.
            box = max(one[1], other[1]), min(one[3], other[3]), max(one[0], other[0]), min(one[2], other[2])
            if box[0] < box[1] and box[2] < box[3]:
                found, box = _find_overlap(box, lens.height, scratch, pair.overlap)
                if found > 0:
                    _take_off(pair.overlap[:found], box, arms, lens, scratch, pair, prefixes, pair.hidden)
            for a in range(2):
                hidden[a, 0, s], hidden[a, 1, s] = pair.hidden[a, 0], pair.hidden[a, 1]
    return layers


@compiled
def _count_alone(state: Any, arm: Any, lens: Any, scratch: Any, prefix: Any, counts: Any) -> Any:
    """Count what an arm covers, and leave its spans where they are; returns the layers that were needed."""
    contour, rows, stop = scratch.contour, scratch.rows, scratch.stop
    edges = trace(state, arm.links, arm.bodies, arm.mesh, lens, contour)
    top, bottom = cover(edges, arm.bodies, contour, rows, lens.width, lens.height, False, False)
    for row in range(top, bottom):
        stop[row] = rows.slot[row]
    return total(top, bottom, lens.width, lens.height, rows, prefix, counts)


@compiled
def _merge(row: int, height: int, scratch: Any) -> Any:
    """Put a row's spans into ``rows.merged``, from left to right and apart; returns how many there are."""
    spans, merged = scratch.rows.spans, scratch.rows.merged
    count = 0
    for place in range(row, scratch.stop[row] // 2, height):
        span = spans[place]
        if span >> COLUMN_BITS >= span & COLUMN_MASK:
            continue
        j = count
        while j > 0 and merged[j - 1] > span:
            merged[j] = merged[j - 1]
            j -= 1
        merged[j] = span
        count += 1
    kept = min(count, 1)
    for m in range(1, count):
        end = merged[kept - 1] & COLUMN_MASK
        if merged[m] >> COLUMN_BITS <= end:
            merged[kept - 1] += max(merged[m] & COLUMN_MASK, end) - end
        else:
            merged[kept] = merged[m]
            kept += 1
    return kept


@compiled
def _find_overlap(box: Any, height: int, scratch: Any, overlap: Any) -> Any:
    """Find the spans that both arms cover within a box; returns how many, and the box that holds them."""
    left, right = scratch[0].rows.merged, scratch[1].rows.merged
    found = 0
    top, bottom, low, high = box[1], box[0], box[3], box[2]
    for row in range(box[0], box[1]):
        ours = _merge(row, height, scratch[0])
        theirs = _merge(row, height, scratch[1]) if ours > 0 else 0
        i, j = 0, 0
        while i < ours and j < theirs:
            begin = max(left[i] >> COLUMN_BITS, right[j] >> COLUMN_BITS)
            one, other = left[i] & COLUMN_MASK, right[j] & COLUMN_MASK
            end = min(one, other)
            if begin < end:
                overlap[found, 0], overlap[found, 1], overlap[found, 2] = row, begin, end
                found += 1
                top, bottom = min(top, row), max(bottom, row + 1)
                low, high = min(low, begin), max(high, end)
            if one < other:
                i += 1
            else:
                j += 1
    return found, (top, bottom, low, high)


@compiled
def _take_off(
    overlap: Any, box: Any, arms: Any, lens: Any, scratch: Any, pair: Any, prefixes: Any, hidden: Any
) -> None:
    """Add up which arm's pixels are hidden where both are."""
    rows, columns = -(-(box[1] - box[0]) // TILE_PX), -(-(box[3] - box[2]) // TILE_PX)
    bounds, order = pair.bounds[:, :rows, :columns], pair.order[:rows, :columns]
    for a in range(2):
        own = scratch[a]
        bound_nearness(arms[a], lens, box, own.contour, own.points, own.seen, pair.corners, bounds[a])
    _tell_order(bounds, order)
    if not _count_told(overlap, box, order, prefixes, hidden, pair.wanted):
        return
    first, first_cut = _gather(arms[0], lens, box, scratch[0])
    second, second_cut = _gather(arms[1], lens, box, scratch[1])
    ours, theirs = scratch[0].near[:first], scratch[1].near[:second]
    for row in range(rows):
        for column in range(columns):
            if order[row, column] < 2:
                continue
            v, u = box[0] + row * TILE_PX, box[2] + column * TILE_PX
            tile = v, min(v + TILE_PX, box[1]), u, min(u + TILE_PX, box[3])
            for a in range(2):
                near, cut = (ours, first_cut) if a == 0 else (theirs, second_cut)
                points, seen, depth = scratch[a].points, scratch[a].seen, scratch[a].depth
                nearest_surface(points, seen, near, cut, lens, pair.wanted, tile, pair.room, pair.corners, depth)
            _count_pixels(tile, scratch[0].depth, scratch[1].depth, pair.wanted, prefixes, hidden)


@compiled
def _gather(arm: Any, lens: Any, box: Any, scratch: Any) -> Any:
    """Place the bodies that may reach into a box, and collect those of their faces that may.

    Returns:
        How many faces there are in ``scratch.near``, and whether the near plane cuts a body.
    """
    bodies, mesh, contour = arm.bodies, arm.mesh, scratch.contour
    points, seen, near = scratch.points, scratch.seen, scratch.near
    found, cut = 0, False
    for b in range(bodies.link.shape[0]):
        first, last = bodies.vertex_first[b], bodies.vertex_last[b]
        reaches, aside = reach(contour.u[first:last], contour.v[first:last], contour.depth[first:last], lens, box)
        cut |= reaches
        if aside and not reaches:
            continue
        place_body(b, contour.pose, bodies, mesh, lens, points, seen)
        for f in range(bodies.face_start[b], bodies.face_start[b + 1]):
            if not is_aside(points, seen, mesh.faces[f], lens, box):
                for k in range(3):
                    near[found, k] = mesh.faces[f, k]
                found += 1
    return found, cut


@compiled
def _tell_order(bounds: Any, order: Any) -> None:
    """Which arm is behind in each tile; -1 where the bounds tell no order."""
    for row in range(order.shape[0]):
        for column in range(order.shape[1]):
            first, second = bounds[0, row, column], bounds[1, row, column]
            behind = 1
            if second[0] > first[1] * (1 + UNSURE):
                behind = 0
            elif not first[0] > second[1] * (1 + UNSURE):
                behind = -1
            order[row, column] = behind


@compiled
def _count_told(overlap: Any, box: Any, order: Any, prefixes: Any, hidden: Any, wanted: Any) -> Any:
    """Add up the spans of tiles with an order, and mark the pixels of the others; returns whether there are such."""
    open_tiles = False
    for n in range(overlap.shape[0]):
        row, begin, end = overlap[n, 0], overlap[n, 1], overlap[n, 2]
        across = order[(row - box[0]) // TILE_PX]
        while begin < end:
            column = (begin - box[2]) // TILE_PX
            stop = min(end, box[2] + (column + 1) * TILE_PX)
            behind = across[column]
            if 0 <= behind < 2:
                hidden[behind, 0] += stop - begin
                hidden[behind, 1] += np.int64(prefixes[behind][row, stop]) - np.int64(prefixes[behind][row, begin])
            else:
                open_tiles = True
                across[column] = 2
                wanted[row, begin:stop] = True
            begin = stop
    return open_tiles


@compiled
def _count_pixels(tile: Any, first: Any, second: Any, wanted: Any, prefixes: Any, hidden: Any) -> None:
    """Add up the pixels of a tile by their depths, and unmark them. Of arms at the same depth the first is seen."""
    for row in range(tile[0], tile[1]):
        for column in range(tile[2], tile[3]):
            if wanted[row, column]:
                wanted[row, column] = False
                behind = 0 if second[row, column] < first[row, column] else 1
                prefix = prefixes[behind]
                hidden[behind, 0] += 1
                hidden[behind, 1] += np.int64(prefix[row, column + 1]) - np.int64(prefix[row, column])
