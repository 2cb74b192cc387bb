"""Which tips a detector can see: those that neither the other arm nor an occluder hides."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from surgbench.camera import Camera
from surgbench.generators.occluders import InTheWay
from surgbench.geometry import FloatArray
from surgbench.instrument import Instrument
from surgbench.silhouette import VisibilityEvaluator

# A tip is seen where something of its arm is, so near to it.
NEAR_PX = 2


def seen_tips(states: FloatArray, instrument: Instrument, camera: Camera, in_the_way: InTheWay) -> NDArray[np.bool_]:
    """Which tips are not hidden, ``(frames, arms, 2)``; those outside the picture are.

    Args:
        states: ``(frames, arms, 9)``.
        instrument: Of all arms, and of a third tool.
        camera: With or without distortion.
        in_the_way: What else hides them.
    """
    frames, arms = states.shape[:2]
    pinhole = camera.pinhole
    alone, with_third = (VisibilityEvaluator([instrument] * count, pinhole) for count in (arms, arms + 1))
    tips = instrument.tips_cam(states)
    straight, shown = np.rint(pinhole.project(tips)), np.rint(camera.see(tips))
    inside = camera.contains(shown) & pinhole.contains(straight)
    seen = np.zeros(inside.shape, dtype=bool)
    for frame in range(frames):
        third = in_the_way.third_state(frame)
        if third is None:
            visible = alone.visible_masks(states[frame].ravel())
        else:
            visible = with_third.visible_masks(np.concatenate([states[frame].ravel(), third]))
        hidden = in_the_way.hidden(frame, camera)
        for arm, tip in np.argwhere(inside[frame]):
            column, row = straight[frame, arm, tip].astype(int)
            rows, columns = (slice(max(at - NEAR_PX, 0), at + NEAR_PX + 1) for at in (row, column))
            near = visible[arm, rows, columns]
            column, row = shown[frame, arm, tip].astype(int)
            seen[frame, arm, tip] = near.any() and not hidden[row, column]
    return seen
