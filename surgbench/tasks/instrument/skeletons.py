"""The candidates of each iteration as skeletons, as in Fig. 1 of Hu et al. 2026."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from surgbench.camera import Camera
from surgbench.contract import Mask
from surgbench.geometry import FloatArray
from surgbench.instrument import Instrument
from surgbench.report.drawing import (
    Colour,
    Picture,
    below,
    beside,
    draw_segments,
    grey,
    heading,
    scaled,
)
from surgbench.state import split_arms

BEST_COLOUR: Colour = (255, 255, 255)
NEAR_M = 1e-3
_DIMMED = 0.55
_TEXT_PX = 13


def project_bones(camera: Camera, instruments: Sequence[Instrument], state: FloatArray) -> FloatArray:
    """Bones of one state as seen by the camera.

    Args:
        camera: The view.
        instruments: One per arm.
        state: ``(9 * arms,)``.

    Returns:
        ``(B, 2, 2)`` pixels; bones behind the camera are left out, those that reach behind it cut at its near plane.
    """
    bones = [instrument.skeleton_cam(arm) for instrument, arm in zip(instruments, split_arms(state), strict=True)]
    segments = np.concatenate(bones)
    near = segments[..., 2] < NEAR_M
    segments, near = segments[~near.all(axis=1)], near[~near.all(axis=1)]
    for segment, is_near in zip(segments, near, strict=True):
        if is_near.any():
            behind, ahead = (0, 1) if is_near[0] else (1, 0)
            share = (NEAR_M - segment[behind, 2]) / (segment[ahead, 2] - segment[behind, 2])
            segment[behind] += share * (segment[ahead] - segment[behind])
    return camera.project(segments)


def rank_colours(count: int) -> list[Colour]:
    """Colours of candidates from the best (yellow) to the worst (violet)."""
    shades = np.linspace(255, 60, count).round().astype(np.uint8)[:, None]
    mapped = cv2.applyColorMap(shades, cv2.COLORMAP_PLASMA)
    return [(int(red), int(green), int(blue)) for blue, green, red in mapped[:, 0, :]]


def draw_samples(
    camera: Camera,
    instruments: Sequence[Instrument],
    image_or_mask: Picture | Mask,
    trace_states: list[FloatArray],
    top: int = 55,
    panel_width: int = 480,
) -> Picture:
    """The best candidates of each iteration as skeletons, one column per iteration.

    Args:
        camera: The view.
        instruments: One per arm.
        image_or_mask: ``(H, W, 3)`` uint8 RGB image, or ``(H, W)`` bool mask.
        trace_states: Per iteration ``(n, 9 * arms)`` candidates, best first.
        top: How many of each to draw; the best is white and thicker, then from yellow to violet.
        panel_width: Width of a column, pixels.

    Returns:
        The picture, headed ``Iter 1``, ``Iter 2``, ….
    """
    if image_or_mask.ndim == 2:
        picture = grey(image_or_mask.astype(bool))
    else:
        picture = (image_or_mask * _DIMMED).astype(np.uint8)
    scale = panel_width / camera.width
    ground = scaled(picture, scale)
    columns = []
    for iteration, states in enumerate(trace_states, start=1):
        panel = ground.copy()
        shown = states[:top]
        colours = rank_colours(len(shown))
        for rank in reversed(range(len(shown))):
            pixels = (project_bones(camera, instruments, shown[rank]) + 0.5) * scale - 0.5
            draw_segments(panel, pixels, BEST_COLOUR if rank == 0 else colours[rank], 2 if rank == 0 else 1)
        columns.append(below([heading(f"Iter {iteration}", panel.shape[1], _TEXT_PX), panel]))
    return beside(columns, gap=4)
