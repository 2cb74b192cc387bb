"""How much of the ring the stereo camera sees: what lies in the picture and is covered by nothing that holds it.

Sight lines from an eye to points all around the ring are held against the same triangles that are photographed: the
grasp object with its tags, the stem, and the jaws, wrist and shaft of the instrument. The ring does not cover itself,
and the wire, its board and other tools are not there.
"""

from __future__ import annotations

from functools import cache

import numpy as np

from surgbench.geometry import FloatArray, inverse_transform
from surgbench.viewpoint.optics.grasp_object import RING_RADIUS_M, TUBE_RADIUS_M, Subject, grasp_object, holder
from surgbench.viewpoint.optics.rays import mark_free
from surgbench.viewpoint.optics.stereo import StereoCamera
from surgbench.viewpoint.optics.triangles import Triangles, lay_out

# Points around the ring that are looked at.
POINTS = 24
# The ring counts as seen where at least so much of it is.
SEEN_SHARE = 0.5
# Samples at a time, for what the points of all of them take.
_AT_ONCE = 4096


def ring_points_m() -> FloatArray:
    """``(POINTS, 3)`` of the circle in the middle of the ring's tube, in the feature's frame."""
    angle = 2 * np.pi * np.arange(POINTS) / POINTS
    return RING_RADIUS_M * np.stack([np.cos(angle), np.zeros(POINTS), np.sin(angle)], axis=1)


@cache
def covering() -> Triangles:
    """What may cover the ring, in the feature's frame."""
    held = grasp_object()
    return lay_out(Subject(held.panels, (*held.solids, *holder())))


def ring_shares(cameras: StereoCamera, T_world_camera: FloatArray, T_world_feature: FloatArray) -> FloatArray:
    """Which share of the ring is in each picture and covered by nothing.

    Args:
        cameras: Left and right.
        T_world_camera: ``(T, 4, 4)`` the controlled point.
        T_world_feature: ``(T, 4, 4)``; NaN where it is not known.

    Returns:
        ``(T, 2)`` of the left and the right eye, 0 to 1; NaN where the feature is not known.
    """
    points, shares = ring_points_m(), np.full((len(T_world_camera), 2), np.nan)
    known = np.flatnonzero(np.isfinite(T_world_feature).all(axis=(1, 2)))
    for start in range(0, len(known), _AT_ONCE):
        some = known[start : start + _AT_ONCE]
        T_feature_camera = inverse_transform(T_world_feature[some]) @ T_world_camera[some]
        eyes = (cameras.left, cameras.T_camera_left), (cameras.right, cameras.T_camera_right)
        for eye, (camera, T_camera_eye) in enumerate(eyes):
            T_feature_eye = T_feature_camera @ T_camera_eye
            back = inverse_transform(T_feature_eye)
            seen = camera.see(points @ np.swapaxes(back[:, :3, :3], 1, 2) + back[:, None, :3, 3])
            free = np.empty((len(some), POINTS), dtype=np.bool_)
            mark_free(np.ascontiguousarray(T_feature_eye[:, :3, 3]), points, TUBE_RADIUS_M, covering(), free)
            shares[some, eye] = (free & camera.contains(seen)).mean(axis=1)
    return shares
