"""Compiled entry points: batches of states to pixel counts, and one state to its mask."""

from __future__ import annotations

from typing import Any

from surgbench.silhouette import spans
from surgbench.silhouette.compiled import compiled
from surgbench.silhouette.contour import trace
from surgbench.silhouette.spans import cover, total


@compiled
def score(
    states: Any,
    links: Any,
    bodies: Any,
    mesh: Any,
    lens: Any,
    contour: Any,
    rows: Any,
    prefix: Any,
    counts: Any,
    taken: Any,
    share: int,
    shares: int,
) -> Any:
    """Area of each state's silhouette and the sum of an image over it.

    Several threads call this at once, each with its own scratch and share. A thread works through its own share, then
    from the end backwards through what is left of the others'. Should two threads take the same state, both write the
    same numbers: no lock is needed, and the result does not depend on how many threads there are.

    Args:
        states: ``(N, 9 * arms)`` float64.
        links: The chains of all arms.
        bodies: Their parts.
        mesh: The meshes of all links.
        lens: The camera.
        contour: Scratch of this thread.
        rows: Scratch of this thread.
        prefix: ``(H, W + 1)`` integers: sum of the image's row before each column.
        counts: ``(2, N)`` int64, filled with the pixels covered and the sums.
        taken: ``(N,)`` bool, set where a thread is at work on a state.
        share: Number of this thread.
        shares: Number of threads.

    Returns:
        Most spans that a row has had; where that is more than there is room for, the counts are wrong.
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
            edges = trace(states[s], links, bodies, mesh, lens, contour)
            top, bottom = cover(edges, bodies, lens, contour, rows)
            counts[0, s], counts[1, s], needed = total(top, bottom, lens.height, rows, prefix)
            layers = max(layers, needed)
    return layers


@compiled
def paint(state: Any, links: Any, bodies: Any, mesh: Any, lens: Any, contour: Any, rows: Any, image: Any) -> Any:
    """Set the pixels of one state's silhouette in ``image (H, W)`` bool; returns as :func:`score`."""
    edges = trace(state, links, bodies, mesh, lens, contour)
    top, bottom = cover(edges, bodies, lens, contour, rows)
    return spans.paint(top, bottom, lens.height, rows, image)
