"""Where a camera on an arm goes that a viewpoint controller moves: the simulator, without a table or a no-go zone."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from surgbench.geometry import FloatArray, inverse_transform, rigid_transform
from surgbench.registry import create, find
from surgbench.viewpoint.camera_arm import CameraArm
from surgbench.viewpoint.contract import ViewpointScene
from surgbench.viewpoint.placement import naive_pose
from surgbench.viewpoint.registration import Touches
from surgbench.viewpoint.simulator import SERVO_LAG_S, Simulation
from surgbench.viewpoint.trial import Trial
from surgbench.viewpoint.workspace import NoGoZone, Workspace

# Of the control loop; AutoCam's rate, 79.4 Hz.
PERIOD_S = 0.0126
# How long the feature stands still before the first frame, so that the camera has come to where it wants to be.
SETTLING_S = 3.0
# From the feature's mean to the camera arm's remote centre, in the world: mean over AutoCam's logs.
REMOTE_CENTRE_M = np.array([0.165, -0.118, 0.190])
# A roll in the middle of its range from which a typical pose of such an arm is not a turn away.
TYPICAL_JOINTS = np.array([-0.6, -0.5, 0.1, -2.8, -0.3, 0.2])
# The controller that brings the camera to where every controller starts.
SET_UP_BY = "gaze"
# A box far below: there is nothing that the camera must avoid.
ZONE_M = np.array([[-1, -1, -9], [1, -1, -9], [1, 1, -9], [-1, 1, -9], [0, 0, -8]], dtype=np.float64)


def held_camera_path(
    controller: str, T_world_feature: FloatArray, dt_s: float, distance_m: float, rng: np.random.Generator
) -> FloatArray:
    """The poses of a camera that a controller moves after a feature.

    The arm starts where it sees the mean feature best, whatever the controller, and has some seconds before the first
    frame.

    Args:
        controller: Name of a viewpoint controller.
        T_world_feature: ``(T, 4, 4)``; the normal is its y axis.
        dt_s: Seconds between frames.
        distance_m: d_t.
        rng: The controller's.

    Returns:
        ``(T, 4, 4)`` T_world_camera at the frames.
    """
    frames: FloatArray = dt_s * np.arange(len(T_world_feature), dtype=np.float64)
    steps = int(np.ceil((SETTLING_S + frames[-1]) / PERIOD_S)) + 1
    times: FloatArray = PERIOD_S * np.arange(steps, dtype=np.float64) - SETTLING_S
    feature = _at(T_world_feature, frames, np.clip(times, 0.0, frames[-1]))
    mean = feature[:, :3, 3].mean(axis=0)
    base = rigid_transform(np.eye(3), mean + REMOTE_CENTRE_M)
    arm = CameraArm()
    normal = feature[:, :3, 1].mean(axis=0)
    middle = np.eye(4)
    middle[:3, 1], middle[:3, 3] = normal / np.linalg.norm(normal), mean
    zone = ZONE_M + mean
    scene = ViewpointScene(arm, base, Workspace(NoGoZone(zone)), distance_m, PERIOD_S, SERVO_LAG_S)
    none = Touches(np.empty((0, 3)), np.empty((0, 3)))

    def course(name: str, times_s: FloatArray, poses: FloatArray, start: FloatArray) -> FloatArray:
        trial = Trial("camera", PERIOD_S, times_s - times_s[0], poses, base, none, zone, start)
        return Simulation(create(find("tracker", name), {}), trial, scene, rng).run().joints

    # Set up as someone would who looks at the picture: from anywhere near to the best place for the mean feature.
    start = arm.clip(arm.inverse(inverse_transform(base) @ naive_pose(middle, distance_m), TYPICAL_JOINTS))
    still = np.repeat(middle[None], int(SETTLING_S / PERIOD_S), axis=0)
    start = arm.clip(course(SET_UP_BY, PERIOD_S * np.arange(len(still), dtype=np.float64), still, start)[-1])
    return _at(base @ arm.forward(course(controller, times, feature, start)[:-1]), times, frames)


def _at(poses: FloatArray, times_s: FloatArray, wanted_s: FloatArray) -> FloatArray:
    """Poses between those of given times: straight lines, and turns about one axis at an even rate."""
    if len(poses) == 1:
        return np.repeat(poses, len(wanted_s), axis=0)
    rotation = Slerp(times_s, Rotation.from_matrix(poses[:, :3, :3]))(wanted_s).as_matrix()
    position = np.stack([np.interp(wanted_s, times_s, poses[:, k, 3]) for k in range(3)], axis=1)
    return rigid_transform(rotation, position)
