"""What an arm's cables do to its readings: ahead of a moving joint by a constant, which a lag must not be mistaken for.

Friction stretches the cable between encoder and joint in the direction of motion, hardly more for a fast motion than
for a slow one. A lag is off in proportion to the speed. Where both are fitted, each takes its own.
"""

from __future__ import annotations

import numpy as np
from scipy.signal import savgol_filter

from surgbench.geometry import FloatArray
from surgbench.instrument.arm import ARM_JOINTS, CLASSIC_400006

# A joint faster than this has its cables nearly fully stretched.
KNEE = np.array([0.02, 0.02, 0.002, 0.02])  # rad/s, m/s for the insertion
# What a stretch is expected to be.
USUAL = np.array([0.005, 0.005, 0.001, 0.005])  # rad, m for the insertion
# Readings are smoothed by parabolas over so many frames before velocities are taken of them.
SMOOTHED_FRAMES = 7
# A shaft that passes further from the base's origin than this does not turn about it.
REMOTE_CENTRE_M = 0.001


def stretch_motions(times_s: FloatArray, poses: FloatArray) -> FloatArray:
    """How an arm's wrist moves as the cable of each joint is stretched, in the direction in which that joint moves.

    Joints are yaw, pitch, insertion and roll about a fixed remote centre, which need no dimensions of the arm.

    Args:
        times_s: ``(n,)`` seconds, increasing.
        poses: ``(n, 4, 4)`` T_base_wrist as read, none missing.

    Returns:
        ``(n, 6, 4)``: rotation vector and position in the base's frame, per radian or metre of each joint's stretch;
        0 of an arm that does not turn about its base's origin.
    """
    beside = np.cross(poses[:, :3, 3], poses[:, :3, 2])
    if len(poses) < SMOOTHED_FRAMES or np.median(np.linalg.norm(beside, axis=1)) > REMOTE_CENTRE_M:
        return np.zeros((len(poses), 6, ARM_JOINTS))
    # The dimensions only move the insertion's zero, which is far from a half turn.
    joints = np.unwrap(CLASSIC_400006.inverse(poses), axis=0)
    # Of readings that may be missing or unevenly apart: per reading, over seconds per reading.
    moved, passed = (savgol_filter(one, SMOOTHED_FRAMES, 2, deriv=1, axis=0) for one in (joints, times_s))
    velocity = moved / passed[:, None]
    tension = velocity / np.hypot(velocity, KNEE)
    jacobian = CLASSIC_400006.jacobian(joints)
    return np.asarray(np.concatenate([jacobian[:, 3:], jacobian[:, :3]], axis=1) * tension[:, None, :])
