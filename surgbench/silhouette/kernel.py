"""Compiled entry points: batches of states to pixel counts, and one state to its mask."""

from __future__ import annotations

from typing import Any

from surgbench.compiled import compiled
from surgbench.silhouette import spans
from surgbench.silhouette.boundary import (
    find_boundary,
    find_row_crossings,
    jacobians,
    map_links,
    pull_back,
    sum_wrenches,
)
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
        counts: ``(2, N)`` or ``(6, N)`` int64, filled with the pixels covered, the sums and the bounding boxes.
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
            top, bottom = cover(edges, bodies, contour, rows, lens.width, lens.height, False, False)
            needed = total(top, bottom, lens.width, lens.height, rows, prefix, counts[:, s])
            layers = max(layers, needed)
    return layers


@compiled
def paint(state: Any, links: Any, bodies: Any, mesh: Any, lens: Any, contour: Any, rows: Any, image: Any) -> Any:
    """Set the pixels of one state's silhouette in ``image (H, W)`` bool; returns as :func:`score`."""
    edges = trace(state, links, bodies, mesh, lens, contour)
    top, bottom = cover(edges, bodies, contour, rows, lens.width, lens.height, False, False)
    return spans.paint(top, bottom, lens.height, rows, image)


@compiled
def gradient(
    states: Any, links: Any, bodies: Any, mesh: Any, lens: Any, contour: Any, boundary: Any, mask: Any, gradients: Any
) -> Any:
    """Gradients of area and overlap, ``(2, N, 9 * arms)``; returns as :func:`score`."""
    layers = 0
    for s in range(states.shape[0]):
        edges = trace(states[s], links, bodies, mesh, lens, contour)
        if edges == 0:
            gradients[:, s] = 0.0
            continue
        row_found, found, needed = find_boundary(edges, 1, bodies, lens, contour, boundary)
        layers = max(layers, needed)
        sum_wrenches(row_found, found, bodies, mesh, lens, contour, mask, boundary)
        map_links(states[s], links, contour.pose, boundary.maps)
        for part in range(2):
            pull_back(links, boundary.maps, boundary.wrench[part], gradients[part, s])
    return layers


@compiled
def contour_points(
    state: Any, spacing: int, links: Any, bodies: Any, mesh: Any, lens: Any, contour: Any, boundary: Any,
    points: Any, normals: Any, lengths: Any, arms: Any, own_links: Any, rates: Any,
) -> Any:  # fmt: skip
    """Sample the visible contour of one state with normals and Jacobians.

    Returns:
        The number of samples (if there is no room for so many, none is filled), and as :func:`score`.
    """
    edges = trace(state, links, bodies, mesh, lens, contour)
    row_found, found, layers = find_boundary(edges, spacing, bodies, lens, contour, boundary)
    if found <= lengths.shape[0]:
        jacobians(
            row_found, found, spacing, state, links, mesh, lens, contour, boundary,
            points, normals, lengths, arms, own_links, rates,
        )  # fmt: skip
    return found, layers


@compiled
def row_crossings(state: Any, links: Any, bodies: Any, mesh: Any, lens: Any, contour: Any, boundary: Any) -> Any:
    """Find where the visible contour of one state crosses rows; returns as :func:`contour_points`."""
    edges = trace(state, links, bodies, mesh, lens, contour)
    return find_row_crossings(edges, bodies, lens, contour, boundary)
