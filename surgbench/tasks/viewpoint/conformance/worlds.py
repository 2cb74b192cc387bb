"""Small worlds of the viewpoint task: a ring that circles, and ones where features, bases and starts are anything."""

from __future__ import annotations

import numpy as np

from surgbench.geometry import FloatArray, inverse_transform, rigid_transform, rotation_from_vector
from surgbench.viewpoint.camera_arm import CameraArm
from surgbench.viewpoint.placement import naive_pose
from surgbench.viewpoint.registration import Touches
from surgbench.viewpoint.trial import Trial, TrialTruth

DT_S = 0.0126
# Where the camera arm's remote centre is from the middle of the task, as on the robot.
REMOTE_CENTRE_M = np.array([0.165, -0.118, 0.22])
# Corners of the no-go zone, and a point on its top.
ZONE_M = 1e-3 * np.array([[-41, -38, 0], [41, -38, 0], [41, 38, 0], [-41, 38, 0], [0, 0, 49.4]])


def feature_poses(position_m: FloatArray, normal: FloatArray) -> FloatArray:
    """T_world_feature ``(T, 4, 4)`` of positions and normals ``(T, 3)``, which become the y axes."""
    y = normal / np.linalg.norm(normal, axis=-1, keepdims=True)
    x = np.cross(y, np.eye(3)[np.argmin(np.abs(y), axis=-1)])
    x /= np.linalg.norm(x, axis=-1, keepdims=True)
    return rigid_transform(np.stack([x, y, np.cross(x, y)], axis=-1), position_m)


def make_trial(poses: FloatArray, base: FloatArray | None = None, start: FloatArray | None = None) -> Trial:
    """A trial of what is measured without error, the arm at rest where it sees the first pose, as far as it can."""
    if base is None:
        base = rigid_transform(np.eye(3), REMOTE_CENTRE_M)
    touched = ZONE_M + np.array([0.0, 0.0, 0.02])
    touches = Touches(touched, (touched - base[:3, 3]) @ base[:3, :3])
    arm = CameraArm()
    if start is None:
        start = arm.clip(arm.inverse(inverse_transform(base) @ naive_pose(poses[0]), np.array([0, 0, 0, -2.8, 0, 0])))
    truth = TrialTruth(poses.copy(), base.copy(), np.zeros(len(poses), dtype=bool))
    return Trial(
        "world", DT_S, DT_S * np.arange(len(poses), dtype=np.float64), poses, base, touches, ZONE_M, start, truth
    )


def circling(steps: int, radius_m: float = 0.02, period_s: float = 12.0) -> Trial:
    """A ring that goes round in a circle above the zone's middle, seen from where no rule speaks against it."""
    angle = 2 * np.pi / period_s * np.arange(steps) * DT_S
    position = np.stack([radius_m * np.cos(angle), radius_m * np.sin(angle), np.full(steps, 0.03)], axis=-1)
    normal = np.stack([0.6 + 0.1 * np.sin(angle), -0.4 + 0.1 * np.cos(angle), np.full(steps, 0.7)], axis=-1)
    return make_trial(feature_poses(position, normal))


def random_trial(rng: np.random.Generator, steps: int) -> Trial:
    """Anything: a feature that jumps, far away or in the camera, any start within the limits, gaps."""
    arm = CameraArm()
    turn = rotation_from_vector(rng.normal(0, rng.choice([0.1, 2.0]), 3))
    base = rigid_transform(turn, REMOTE_CENTRE_M + rng.normal(0, 0.05, 3))
    start = rng.uniform(arm.lower, arm.upper)
    scale = rng.choice([0.02, 0.1, 1.0])
    position = np.cumsum(rng.normal(0, rng.choice([1e-4, 1e-3, 0.05]), (steps, 3)), axis=0) + rng.normal(0, scale, 3)
    if rng.random() < 0.1:  # the feature is in the camera
        position[:] = (base @ arm.forward(start))[:3, 3]
    normal = np.cumsum(rng.normal(0, rng.choice([0.01, 1.0]), (steps, 3)), axis=0) + rng.normal(0, 1, 3)
    if rng.random() < 0.1:
        normal[:] = [0, 0, rng.choice([-1, 1])]
    trial = make_trial(feature_poses(position, normal), base, start)
    trial.T_world_feature[rng.random(steps) < rng.choice([0.0, 0.3])] = np.nan
    return trial
