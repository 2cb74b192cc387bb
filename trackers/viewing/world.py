"""What stays the same over a trial, in the frame of the arm's base, as the compiled functions take it."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from surgbench.geometry import FloatArray
from surgbench.viewpoint.contract import ViewpointScene

LOWER, UPPER, VELOCITY, ACCELERATION = range(4)


class World(NamedTuple):
    """The arm and the rules; everything in the frame of the arm's base.

    Attributes:
        arm: ``(3,)`` of the kinematics.
        reach_m: From tool to camera.
        limits: ``(4, 6)`` lower and upper joint limits, largest velocities and accelerations.
        inner: ``(2, 6)`` joint limits of fitted goals: near the wrist's own, roll and wrist must turn fast for little.
        up: ``(3,)``.
        side: ``(3,)`` the preferred side, or zero where there is none.
        floor: ``(4,)`` normal and offset.
        faces: ``(n, 4)`` inward normals and offsets of the zone.
        proximity_m: Smallest distance to the feature.
        distance_m: The wanted one.
        margin_m: Kept by goals from floor, zone and the smallest distance.
        guard_m: Kept by every step, less than that.
        sine: ``(4,)``: of the angles kept from the side's plane, above the feature, and of the camera's y axis from the
            wrong side; and the cosine of the cap below the pole.
        cone: ``(2,)`` tangents of the angles kept from the tool's axis, in the ring's plane and towards its normal; 0
            for none.
        dt_s: Period.
        lag_s: Of the joints.
        starts: ``(n, 3)`` unit vectors from the feature, all over the side on which the camera may be: where fits
            begin, and ways round go through.
    """

    arm: FloatArray
    reach_m: float
    limits: FloatArray
    inner: FloatArray
    up: FloatArray
    side: FloatArray
    floor: FloatArray
    faces: FloatArray
    proximity_m: float
    distance_m: float
    margin_m: float
    guard_m: float
    sine: FloatArray
    cone: FloatArray
    dt_s: float
    lag_s: float
    starts: FloatArray


# Directions on the whole sphere, of which those within the rules are kept.
DIRECTIONS = 96


def make_world(
    scene: ViewpointScene,
    *,
    margin_m: float,
    guard_m: float,
    pole_rad: float,
    side_rad: float,
    above_rad: float,
    cone_rad: FloatArray,
    wrist_rad: float,
) -> World:
    """The rules of a scene, brought into the arm's frame.

    Args:
        scene: The trial's constants.
        margin_m: As :attr:`World.margin_m`.
        guard_m: As :attr:`World.guard_m`.
        pole_rad: Angle kept from the vertical through the feature.
        side_rad: Angle kept from the side's plane.
        above_rad: Angle by which the camera stays above the feature's level where there is a preferred side: looking
            up, its y axis points to the wrong side.
        cone_rad: ``(2,)`` angles kept from the tool's axis, in the ring's plane and towards its normal.
        wrist_rad: Angle that fitted goals keep from the wrist's limits.
    """
    arm = scene.arm
    rotation, base = scene.T_world_base[:3, :3], scene.T_world_base[:3, 3]
    zone, floor = scene.workspace.zone.faces, scene.workspace.floor
    side = np.array(scene.workspace.preferred_side, dtype=np.float64)
    sided = bool(side.any())
    directions = evenly(DIRECTIONS)
    inside = (directions[:, 2] < math.cos(pole_rad)) & (directions[:, 2] > (0.05 if sided else -0.7))
    directions = directions[inside & ((directions @ side > math.sin(side_rad)) | (not sided))]
    # A plane n . p = o of the world is (R' n) . q = o - n . t in the arm's frame.
    spare = np.minimum(wrist_rad * np.array([0.0, 0.0, 0.0, 0.0, 1.0, 1.0]), (arm.upper - arm.lower) / 4)
    return World(
        arm=arm.packed,
        reach_m=float(arm.camera_m),
        limits=np.array([arm.lower, arm.upper, arm.velocity, arm.acceleration]),
        inner=np.array([arm.lower + spare, arm.upper - spare]),
        up=np.ascontiguousarray(rotation.T @ np.array([0.0, 0.0, 1.0])),
        side=np.ascontiguousarray(rotation.T @ side),
        floor=np.append(rotation.T @ floor[:3], floor[3] - floor[:3] @ base),
        faces=np.column_stack([zone[:, :3] @ rotation, zone[:, 3] - zone[:, :3] @ base]),
        proximity_m=float(scene.workspace.proximity_m),
        distance_m=float(scene.distance_m),
        margin_m=margin_m,
        guard_m=guard_m,
        sine=np.array([
            math.sin(side_rad), math.sin(above_rad) if sided else -1.0, math.sin(above_rad) / 2, math.cos(pole_rad),
        ]),
        cone=np.tan(np.asarray(cone_rad, dtype=np.float64)),
        dt_s=float(scene.dt_s),
        lag_s=float(scene.servo_lag_s),
        starts=np.ascontiguousarray(directions @ rotation),
    )  # fmt: skip


def evenly(count: int) -> FloatArray:
    """``(count, 3)`` unit vectors spread evenly over the sphere, by golden angles."""
    height = 1.0 - (2.0 * np.arange(count) + 1.0) / count
    angle = np.pi * (3.0 - np.sqrt(5.0)) * np.arange(count)
    level = np.sqrt(1.0 - height**2)
    return np.stack([level * np.cos(angle), level * np.sin(angle), height], axis=1)
