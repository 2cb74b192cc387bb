"""Dimensions of a body and the poses of all masks together: a bundle adjustment of contours.

Every contour point of the present body in its present pose has an observed edge some pixels off along its normal
(:mod:`surgbench.trackers.registration.edges`). Unknown are the state of each mask, and common to all the factors of the
dimensions and by how much masks are too large. One step of robust Gauss-Newton solves for all of them; the states are
eliminated mask by mask (Schur's complement).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from surgbench.camera import Camera
from surgbench.contract import Mask
from surgbench.geometry import FloatArray
from surgbench.silhouette import Reference, SilhouetteEvaluator
from surgbench.state import JOINTS, STATE_SCALE, STATE_SIZE, clip_joints
from surgbench.trackers.fitting.dimensions import Dimensions
from surgbench.trackers.registration.edges import find_edges, median_size, normal_equations

REACH_PX = 14
SPACING_PX = 1
NARROWEST_PX, NARROWING = 1.0, 0.7  # of the robust width
EDGE_PX = 0.5  # standard deviation of an edge
ALIKE_PX = 8.0  # of contour along which edges are off alike: so many pixels tell as much as one
OFFSET_PX = 0.3  # standard deviation of what is common to all edges of all masks
POSE_SCALES = 100.0  # natural steps: next to nothing is known of a pose before
READING_RAD = 0.03  # of a joint reading
LONGEST = 4.0  # natural steps of a state in one go
LEAST_FACTOR, MOST_FACTOR = 0.6, 1.6


@dataclass(frozen=True)
class Adjusted:
    """What came of it.

    Attributes:
        factors: ``(m,)`` of the dimensions.
        deviations: ``(m,)`` their standard deviations, the poses' doubt included.
        states: ``(n, 9)``.
        offset_px: By how much masks are too large.
        errors: ``(n,)`` 1 - IoU of each mask.
    """

    factors: FloatArray
    deviations: FloatArray
    states: FloatArray
    offset_px: float
    errors: FloatArray


def adjust(
    dimensions: Dimensions,
    camera: Camera,
    masks: Sequence[Mask],
    states: FloatArray,
    prior: FloatArray,
    factors: FloatArray,
    joints: FloatArray | None = None,
    iterations: int = 25,
    progress: Callable[[int], None] = lambda done: None,
) -> Adjusted:
    """Fit dimensions and poses together.

    Args:
        dimensions: Of the instrument.
        camera: That saw the masks.
        masks: n of ``(H, W)`` bool.
        states: ``(n, 9)`` to begin with.
        prior: ``(m,)`` standard deviations of the factors about where they begin; 0 of one that is known.
        factors: ``(m,)`` to begin with.
        joints: ``(n, 3)`` readings, NaN where there is none.
        iterations: Steps.
        progress: Called after each.
    """
    m = len(dimensions)
    states, factors, offset = np.array(states), np.array(factors), 0.0
    begin, free = factors.copy(), prior > 0
    scale = np.concatenate([STATE_SCALE, np.where(free, prior, 1.0)])
    limits = dimensions.instrument.search_limits
    width: list[float | None] = [None] * len(masks)
    shared = np.zeros((m + 1, m + 1))
    for done in range(iterations):
        built = dimensions.build(factors)
        evaluator = SilhouetteEvaluator([built], camera)
        shared, pull = np.diag([*np.where(free, 1.0, 1e12), 1.0 / OFFSET_PX**2]), np.zeros(m + 1)
        pull[:m] = np.where(free, (begin - factors) / scale[STATE_SIZE:], 0.0)
        pull[m] = -offset / OFFSET_PX**2
        kept: list[FloatArray | None] = []
        for k, mask in enumerate(masks):
            contour = evaluator.contour_points(states[k], SPACING_PX)
            if not len(contour.arm):
                kept.append(None)
                continue
            grown = dimensions.jacobian(contour, states[k], factors, camera, built)
            off = find_edges(contour, mask, REACH_PX) - offset
            if np.isnan(off).all():
                kept.append(None)
                continue
            last = width[k] or max(3.0 * median_size(off), 2.0 * NARROWEST_PX)
            width[k] = max(NARROWING * last, NARROWEST_PX)
            both = contour._replace(
                jacobian=np.concatenate([contour.jacobian, grown], axis=1),
                lengths_px=contour.lengths_px / (EDGE_PX**2 * ALIKE_PX),
            )
            A, b = normal_equations(off, both, scale, last)
            own, rest = slice(0, STATE_SIZE), slice(STATE_SIZE, None)
            H, g = A[own, own] + np.eye(STATE_SIZE) / POSE_SCALES**2, b[own].copy()
            if joints is not None:
                read = np.isfinite(joints[k])
                weight = np.where(read, (STATE_SCALE[JOINTS] / READING_RAD) ** 2, 0.0)
                H[JOINTS, JOINTS] += np.diag(weight)
                away = np.where(read, joints[k] - states[k][JOINTS], 0.0)
                g[JOINTS] += weight * away / STATE_SCALE[JOINTS]
            solved = np.asarray(np.linalg.solve(H, np.column_stack([A[own, rest], g])), dtype=np.float64)
            shared += A[rest, rest] - A[rest, own] @ solved[:, :-1]
            pull += b[rest] - A[rest, own] @ solved[:, -1]
            kept.append(solved)
        step = np.linalg.solve(shared, pull)
        factors = np.clip(factors + step[:m] * scale[STATE_SIZE:] * free, LEAST_FACTOR, MOST_FACTOR)
        offset += float(step[m])
        for k, own_part in enumerate(kept):
            if own_part is None:
                continue
            move = own_part[:, -1] - own_part[:, :-1] @ step
            move *= min(1.0, LONGEST / max(float(np.abs(move).max()), LONGEST))
            states[k] = clip_joints(states[k] + move * STATE_SCALE, limits)
        progress(done + 1)
    deviations = np.sqrt(np.diag(np.linalg.inv(shared)))[:m] * np.where(free, scale[STATE_SIZE:], 0.0)
    return Adjusted(factors, deviations, states, offset, errors_of(dimensions, factors, camera, masks, states))


def errors_of(
    dimensions: Dimensions, factors: FloatArray, camera: Camera, masks: Sequence[Mask], states: FloatArray
) -> FloatArray:
    """``(n,)``: 1 - IoU of each mask with the silhouette of the body of some factors in its state."""
    evaluator = SilhouetteEvaluator([dimensions.build(factors)], camera)
    found = []
    for mask, state in zip(masks, states, strict=True):
        reference = Reference(mask)
        found.append(1.0 - float(evaluator.score(state[None], reference).iou(reference)[0]))
    return np.array(found)
