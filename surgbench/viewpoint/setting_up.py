"""Setting a camera arm up: where it sees a feature from, where it rests first, and how its base is best turned."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from surgbench.geometry import FloatArray, inverse_transform, rigid_transform, rotation_from_vector
from surgbench.viewpoint.camera_arm import INSERTION, PITCH, ROLL, YAW, CameraArm
from surgbench.viewpoint.placement import UP, look_at, naive_pose, violations
from surgbench.viewpoint.workspace import Workspace

# Places tried for the arm at rest: around the feature, at these shares of the wanted distance.
DIRECTIONS = 1500
DISTANCES = (1.0, 1.15, 0.85, 1.3, 1.5)
# What is as bad as each other: out of the view, out of the level, off the distance, off the geometrically best place.
ANGLE_RAD, DISTANCE_M, PLACE_M = np.radians(1.0), 0.005, 0.05
# No further start is tried then: a degree out of the view is half as bad again.
GOOD_ENOUGH = 0.33
# Rolls that a search begins with, over their limits.
ROLLS = 4
# A feature is seen where the camera looks no farther past it, from no farther than so many times the wanted distance.
SEEN_RAD, SEEN_TIMES = np.radians(5.0), 2.0
# Samples of a trial that are looked at, and turns of the base about the vertical that are tried.
LOOKED_AT, TURNS = 8, 16
# At so many features joints are looked at.
STRAINED = 200
# A joint at its limit is as bad as this many degrees out of the view.
LIMIT_WEIGHT = 10.0


@dataclass(frozen=True, eq=False)
class View:
    """How an arm can look at a feature.

    Attributes:
        joints: ``(6,)``, within the limits.
        angle_rad: Between the optical axis and the way to the feature.
        distance_m: From the camera to the feature.
        cost: Half the sum of squares of how bad it is.
    """

    joints: FloatArray
    angle_rad: float
    distance_m: float
    cost: float

    def shows(self, distance_m: float) -> bool:
        """Whether the feature is seen, from about as far as wanted."""
        return self.angle_rad <= SEEN_RAD and self.distance_m <= SEEN_TIMES * distance_m


def aim(arm: CameraArm, T_world_base: FloatArray, T_world_feature: FloatArray, distance_m: float) -> View:
    """The best view of a feature that an arm has, whatever the rules say: bounded least squares from several starts.

    Args:
        arm: The arm, of which joints may be locked.
        T_world_base: ``(4, 4)``.
        T_world_feature: ``(4, 4)``; the normal is its y axis.
        distance_m: Wanted from camera to feature.
    """
    into_base = inverse_transform(T_world_base)
    feature, up = (into_base @ T_world_feature)[:3, 3], into_base[:3, :3] @ UP
    wanted = into_base @ naive_pose(T_world_feature, distance_m)
    free = np.flatnonzero(~arm.locked)

    def whole(values: FloatArray) -> FloatArray:
        joints = arm.lower.copy()
        joints[free] = values
        return joints

    def residuals(values: FloatArray) -> FloatArray:
        pose = arm.forward(whole(values))
        towards = feature - pose[:3, 3]
        length = max(float(np.linalg.norm(towards)), 1e-9)
        return np.concatenate([
            (pose[:3, 2] - towards / length) / ANGLE_RAD,
            # Level, and not upside down.
            [pose[:3, 0] @ up / ANGLE_RAD, min(pose[:3, 1] @ up, 0.0) / ANGLE_RAD],
            [(length - distance_m) / DISTANCE_M],
            (pose[:3, 3] - wanted[:3, 3]) / PLACE_M,
        ])  # fmt: skip

    bounds = (arm.lower[free], arm.upper[free])
    inset = 1e-6 * (bounds[1] - bounds[0])
    best, cost = arm.inverse(wanted)[free], np.inf
    if arm.within_limits(whole(best)) and not arm.locked.any():
        cost = 0.0
    for start in _starts(arm, feature, distance_m, wanted):
        if cost < GOOD_ENOUGH:
            break
        begin = np.clip(start[free], bounds[0] + inset, bounds[1] - inset)
        found = least_squares(residuals, begin, bounds=bounds, max_nfev=30, x_scale="jac")
        if found.cost < cost:
            best, cost = np.asarray(found.x), float(found.cost)
    joints = arm.clip(whole(best))
    pose = arm.forward(joints)
    towards = feature - pose[:3, 3]
    angle = np.arctan2(np.linalg.norm(np.cross(pose[:3, 2], towards)), pose[:3, 2] @ towards)
    return View(joints, float(angle), float(np.linalg.norm(towards)), cost)


def _starts(arm: CameraArm, feature: FloatArray, distance_m: float, wanted: FloatArray) -> list[FloatArray]:
    """Joints ``(6,)`` to search from: those of the best pose, and the shaft pointed at the feature in some rolls."""
    straight = arm.middle.copy()
    away = max(float(np.linalg.norm(feature)), 1e-9)
    wrist_m = max(away - distance_m - arm.camera_m - arm.wrist_length_m, 0.01)
    straight[[YAW, PITCH, INSERTION]] = arm.manipulator.reach(feature / away * wrist_m)
    shares = (np.arange(ROLLS) + 0.5) / ROLLS
    rolls = arm.lower[ROLL] + shares * (arm.upper[ROLL] - arm.lower[ROLL])
    return [arm.inverse(wanted), *(np.where(np.arange(6) == ROLL, roll, straight) for roll in rolls)]


def unseen(arm: CameraArm, T_world_base: FloatArray, T_world_feature: FloatArray, distance_m: float) -> str | None:
    """What is wrong where an arm sees a trial's feature at none of the samples looked at; ``None`` where it does.

    Args:
        arm: The arm.
        T_world_base: ``(4, 4)`` as registered.
        T_world_feature: ``(T, 4, 4)``; NaN where it was not measured.
        distance_m: Wanted from camera to feature.
    """
    measured = np.flatnonzero(np.isfinite(T_world_feature).all(axis=(1, 2)))
    if not len(measured):
        return None
    nearest = np.inf
    for index in measured[np.unique(np.linspace(0, len(measured) - 1, LOOKED_AT).astype(int))]:
        pose = T_world_feature[index]
        if aim(arm, T_world_base, pose, distance_m).shows(distance_m):
            return None
        nearest = min(nearest, float(np.linalg.norm(pose[:3, 3] - T_world_base[:3, 3])))
    return (
        f"camera arm '{arm.name}' can look at the feature nowhere from within {SEEN_TIMES * distance_m:g} m: its "
        f"remote centre is {nearest:.3g} m away; check the base, the arm's offsets and its limits"
    )


def turned_base(arm: CameraArm, T_world_base: FloatArray, T_world_feature: FloatArray, distance_m: float) -> FloatArray:
    """A base turned about the vertical through its remote centre, so that the arm works amid its limits.

    Args:
        arm: The arm.
        T_world_base: ``(4, 4)``.
        T_world_feature: ``(n, 4, 4)`` features that it is to see.
        distance_m: Wanted from camera to feature.
    """
    best, least = T_world_base, np.inf
    for turn in range(TURNS):
        spin = rotation_from_vector(2 * np.pi * turn / TURNS * UP)
        base = rigid_transform(spin @ T_world_base[:3, :3], T_world_base[:3, 3])
        badness = _strain(arm, base, T_world_feature, distance_m)
        if badness < least * (1 - 1e-6):
            best, least = base, badness
    return best


def _strain(arm: CameraArm, T_world_base: FloatArray, T_world_feature: FloatArray, distance_m: float) -> float:
    """How far from the middle of their limits an arm's joints are, the worst of them, over features; squares, mean.

    Of an arm with locked joints it is the same at its best view of the feature in the middle, and how bad that is.
    """
    half = np.where(arm.locked, 1.0, (arm.upper - arm.lower) / 2)
    if arm.locked.any():
        view = aim(arm, T_world_base, T_world_feature[len(T_world_feature) // 2], distance_m)
        away = np.abs((view.joints - arm.middle) / half)[~arm.locked].max()
        return float(view.cost + 0.5 * (LIMIT_WEIGHT * away) ** 2)
    some = T_world_feature[:: -(-len(T_world_feature) // STRAINED)]
    joints = arm.inverse(inverse_transform(T_world_base) @ naive_pose(some, distance_m))
    return float((np.abs((joints - arm.middle) / half).max(axis=1) ** 2).mean())


def rest(
    T_world_feature: FloatArray, distance_m: float, workspace: Workspace, arm: CameraArm, T_world_base: FloatArray
) -> FloatArray | None:
    """Joints ``(6,)`` of an arm that looks at the feature from the geometrically best place that is allowed.

    Args:
        T_world_feature: ``(4, 4)``.
        distance_m: Wanted.
        workspace: Rules.
        arm: The camera arm.
        T_world_base: ``(4, 4)`` as registered.

    Returns:
        ``None`` if there is no such place.
    """
    if arm.locked.any():
        return _rest_in_line(T_world_feature, distance_m, workspace, arm, T_world_base)
    feature, normal = T_world_feature[:3, 3], T_world_feature[:3, 1]
    # Spread evenly over the sphere, by golden angles; the best direction first, then those near to it.
    height = 1.0 - (2.0 * np.arange(DIRECTIONS) + 1.0) / DIRECTIONS
    angle = np.pi * (3.0 - np.sqrt(5.0)) * np.arange(DIRECTIONS)
    level = np.sqrt(1.0 - height**2)
    directions = np.stack([level * np.cos(angle), level * np.sin(angle), height], axis=1)
    directions = directions[np.argsort(-directions @ normal, kind="stable")]
    for share in DISTANCES:
        poses = look_at(feature + share * distance_m * directions, feature)
        if share == 1.0:
            poses = np.concatenate([naive_pose(T_world_feature, distance_m)[None], poses])
        found = violations(poses, np.broadcast_to(feature, (len(poses), 3)), workspace, arm, T_world_base)
        if not found.any.all():
            return arm.clip(arm.inverse(inverse_transform(T_world_base) @ poses[int(np.argmin(found.any))]))
    return None


def _rest_in_line(
    T_world_feature: FloatArray, distance_m: float, workspace: Workspace, arm: CameraArm, T_world_base: FloatArray
) -> FloatArray | None:
    """The same of an arm with locked joints, which has but one line of places to look at a feature from."""
    for share in DISTANCES:
        view = aim(arm, T_world_base, T_world_feature, share * distance_m)
        pose = T_world_base @ arm.forward(view.joints)
        rules = violations(pose, T_world_feature[:3, 3], workspace, arm, T_world_base)
        broken = rules.no_go | rules.floor | rules.orientation | np.asarray(view.distance_m < workspace.proximity_m)
        if view.shows(distance_m) and not broken:
            return view.joints
    return None
