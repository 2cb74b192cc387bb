"""Whether a broken rule could have been avoided: a proof that it could not, or a pose that would have kept it.

From the state that the arm was in some steps earlier (set point, its velocity, measured joints) every joint can be
anywhere in an interval: its acceleration, velocity and limits are its own. So what the arm can reach is a box of
joints, and a rule at a sample asks for the largest value that a function of the camera's pose takes in that box.
Whether it can be large enough is decided by branch and bound. With the box's middle c, half its widths r, and the
camera's place p,

    p(q) = p(c) + J (q - c) + e,    |e| <= 1/2 [W^2 (l + d) + 2 W (r_3 + w l) + w^2 l],

where W and w are the sums of the half widths of yaw and pitch, and of roll and wrist, d the largest depth of the wrist
below the remote centre, and l the length from there to the camera: every derivative of a chain of turns is a cross
product with a unit vector. The linear part is at its largest in a corner of the box. A box that stays below what is
needed even so is dropped, one whose middle or best corner reaches it is the answer, any other is halved.

What is not proven: that a motion which keeps the rule at this sample keeps all rules at all samples on the way, so that
a sample that is *not* called unavoidable may have been so; and nothing about what was done before that state. An arm
that is driven at the zone at full speed breaks its rule unavoidably in the end: ask for a longer horizon, too. The
feature's future is taken as known: a controller does not know it. A set point's velocity is known from its differences
up to half a step's acceleration, by which the box is wider than what was possible.
"""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from surgbench.compiled import compiled
from surgbench.errors import ConfigError, unknown_name
from surgbench.geometry import FloatArray
from surgbench.viewpoint.contract import ViewpointScene
from surgbench.viewpoint.kinematics import forward, jacobian
from surgbench.viewpoint.simulator import Course
from surgbench.viewpoint.trial import Trial

PLACE_RULES = ("no_go", "floor", "proximity")
Of = Literal["joints", "setpoints"]
# Broken by less than this does not count.
TOLERANCE_M = 5e-4
# Boxes looked at before the question is left open, and the most that wait at a time.
BOXES, WAITING = 200_000, 512
POSSIBLE, IMPOSSIBLE, OPEN = range(3)


def broken_m(camera_m: FloatArray, feature_m: FloatArray, scene: ViewpointScene) -> dict[str, FloatArray]:
    """By how much cameras break the rules of place, all at one moment.

    Args:
        camera_m: ``(..., 3)`` in the world.
        feature_m: ``(..., 3)``; NaN where it is not known, and so is the distance to it.
        scene: The rules.

    Returns:
        By name as in :data:`PLACE_RULES`, ``(...)`` metres, negative where a rule is kept.
    """
    workspace = scene.workspace
    near = workspace.proximity_m - np.linalg.norm(camera_m - feature_m, axis=-1)
    depths = (workspace.zone.depth(camera_m), workspace.below_floor(camera_m), np.asarray(near))
    return dict(zip(PLACE_RULES, depths, strict=True))


def lag_steps(scene: ViewpointScene) -> int:
    """The joints' lag in whole steps, at least one: what is commanded later than that shows too late."""
    return max(1, math.ceil(scene.servo_lag_s / scene.dt_s - 1e-9))


def reach(course: Course, scene: ViewpointScene, sample: int, steps: int, of: Of = "joints") -> FloatArray:
    """Which joints the arm could have had at a sample, whatever it had been told in the steps before it.

    Args:
        course: What happened.
        scene: The arm's limits, the period and the lag.
        sample: From 0, where the arm rests at its start.
        steps: So many before it; no more than there were.
        of: The measured joints, or their set points.

    Returns:
        ``(2, 6)`` lowest and highest.
    """
    arm, dt_s = scene.arm, scene.dt_s
    begin = max(sample - steps, 0)
    fastest, harder = np.array(arm.velocity), np.array(arm.acceleration) * dt_s
    lag = scene.servo_lag_s / dt_s
    decay = math.exp(-1 / lag) if lag > 0 else 0.0
    before = course.setpoints[max(begin - 1, 0)]
    found = np.empty((2, 6))
    for row, sign in enumerate((-1.0, 1.0)):
        setpoint, joints = course.setpoints[begin], course.joints[begin]
        velocity = (setpoint - before) / dt_s + (sign * harder / 2 if begin else 0.0)
        for _ in range(sample - begin):
            velocity = np.clip(velocity + sign * harder, -fastest, fastest)
            after = np.clip(setpoint + velocity * dt_s, arm.lower, arm.upper)
            trail = (after - setpoint) * lag
            joints = after - trail + (joints - setpoint + trail) * decay
            setpoint = after
        found[row] = joints if of == "joints" else setpoint
    return found


def unavoidable(
    course: Course,
    trial: Trial,
    scene: ViewpointScene,
    rule: str,
    steps: int | None = None,
    *,
    of: Of = "joints",
    tolerance_m: float = TOLERANCE_M,
) -> NDArray[np.bool_]:
    """Which samples break a rule of place so that no motion within the arm's limits could have kept it.

    On reported poses, everything at one moment: the camera where the joints are at a sample, the feature as measured at
    that sample.

    Args:
        course: What happened.
        trial: The feature.
        scene: Rules and arm.
        rule: ``"no_go"``, ``"floor"`` or ``"proximity"``.
        steps: From the state so many steps earlier; the joints' lag in whole steps unless told.
        of: Asked of the measured joints, or of their set points.
        tolerance_m: A rule is broken by more than this.

    Returns:
        ``(T,)``; true where it is proven.

    Raises:
        ConfigError: There is no such rule.
    """
    if rule not in PLACE_RULES:
        raise ConfigError(unknown_name("rule", rule, list(PLACE_RULES)))
    count = len(course.goals)
    steps = lag_steps(scene) if steps is None else steps
    joints = course.joints if of == "joints" else course.setpoints
    features = trial.T_world_feature[:count, :3, 3]
    places = (scene.T_world_base @ scene.arm.forward(joints[:count]))[:, :3, 3]
    broken = np.nan_to_num(broken_m(places, features, scene)[rule], nan=-1.0) > tolerance_m
    found = np.zeros(count, dtype=bool)
    for sample in np.flatnonzero(broken):
        box = reach(course, scene, int(sample), steps, of)
        found[sample] = all(
            decide(scene.arm.packed, scene.arm.camera_m, box, point, distance, BOXES) == IMPOSSIBLE
            for point, distance in _demands(rule, features[sample], scene, tolerance_m)
        )
    return found


def _demands(
    rule: str, feature_m: FloatArray, scene: ViewpointScene, tolerance_m: float
) -> list[tuple[FloatArray, float]]:
    """What keeps a rule, any of these: the camera beyond a plane (``(4,)``: 1, normal), or far from a point (0, point).

    In the frame of the arm's base, as :func:`decide` has them.
    """
    rotation, base = scene.T_world_base[:3, :3], scene.T_world_base[:3, 3]
    if rule == "proximity":
        point = rotation.T @ (feature_m - base)
        return [(np.append(0.0, point), scene.workspace.proximity_m - tolerance_m)]
    # A plane n . p = o of the world is (R' n) . q = o - n . t in the arm's frame; the zone's normals point inwards.
    planes = scene.workspace.floor[None] if rule == "floor" else -scene.workspace.zone.faces
    return [
        (np.append(1.0, rotation.T @ plane[:3]), float(plane[3] - plane[:3] @ base) - tolerance_m) for plane in planes
    ]


@compiled(makes_arrays=True)
def decide(arm: FloatArray, reach_m: float, box: FloatArray, demand: FloatArray, needed_m: float, boxes: int) -> int:
    """Whether any joints within a box bring the camera beyond a plane, or far enough from a point.

    Args:
        arm: ``(3,)`` of the kinematics.
        reach_m: From tool to camera.
        box: ``(2, 6)`` lowest and highest joints.
        demand: ``(4,)`` 1 and a plane's normal, or 0 and a point; frame of the arm's base.
        needed_m: Along the normal, or from the point.
        boxes: At most so many are looked at.

    Returns:
        ``POSSIBLE``, ``IMPOSSIBLE``, or ``OPEN`` where the boxes did not suffice.
    """
    stack = np.empty((WAITING, 2, 6))
    stack[0] = box
    waiting = 1
    middle, corner, half, p = np.empty(6), np.empty(6), np.empty(6), np.empty(3)
    pose, motion = np.empty((4, 4)), np.empty((6, 6))
    wrist_m = arm[2] + reach_m
    for _ in range(boxes):
        if waiting == 0:
            return IMPOSSIBLE
        waiting -= 1
        for k in range(6):
            middle[k] = (stack[waiting, 0, k] + stack[waiting, 1, k]) / 2
            half[k] = (stack[waiting, 1, k] - stack[waiting, 0, k]) / 2
        forward(arm, middle, pose)
        jacobian(arm, middle, reach_m, motion)
        for k in range(3):
            p[k] = pose[k, 3] + reach_m * pose[k, 2]
        if _value(p, demand) >= needed_m:
            return POSSIBLE
        shoulder, wrist = half[0] + half[1], half[3] + half[4] + half[5]
        depth = abs(middle[2] + arm[0] + arm[1]) + half[2]
        rest = shoulder**2 * (depth + wrist_m) + 2 * shoulder * (half[2] + wrist * wrist_m) + wrist**2 * wrist_m
        best = _farthest(p, motion, half, demand, middle, corner)
        if best + rest / 2 < needed_m:
            continue
        forward(arm, corner, pose)
        for k in range(3):
            p[k] = pose[k, 3] + reach_m * pose[k, 2]
        if _value(p, demand) >= needed_m:
            return POSSIBLE
        # Halve where most of the error comes from.
        widest, worst = 0, -1.0
        for k in range(6):
            if k < 2:
                share = half[k] * (shoulder * (depth + wrist_m) + half[2] + wrist * wrist_m)
            elif k == 2:
                share = half[k] * shoulder
            else:
                share = half[k] * (shoulder + wrist) * wrist_m
            if share > worst:
                widest, worst = k, share
        if waiting + 2 > WAITING:
            return OPEN
        stack[waiting + 1, 0] = stack[waiting, 0]
        stack[waiting + 1, 1] = stack[waiting, 1]
        stack[waiting, 1, widest] = middle[widest]
        stack[waiting + 1, 0, widest] = middle[widest]
        waiting += 2
    return IMPOSSIBLE if waiting == 0 else OPEN


@compiled
def _value(p: FloatArray, demand: FloatArray) -> float:
    """Along the plane's normal, or from the point."""
    if demand[0] > 0.0:
        return float(p[0] * demand[1] + p[1] * demand[2] + p[2] * demand[3])
    return math.sqrt((p[0] - demand[1]) ** 2 + (p[1] - demand[2]) ** 2 + (p[2] - demand[3]) ** 2)


@compiled(makes_arrays=True)
def _farthest(
    p: FloatArray, motion: FloatArray, half: FloatArray, demand: FloatArray, middle: FloatArray, corner: FloatArray
) -> float:
    """The linear part's largest value over the corners of a box, exactly, and in which one (``corner``, filled)."""
    if demand[0] > 0.0:
        value = _value(p, demand)
        for joint in range(6):
            slope = motion[0, joint] * demand[1] + motion[1, joint] * demand[2] + motion[2, joint] * demand[3]
            value += abs(slope) * half[joint]
            corner[joint] = middle[joint] + (half[joint] if slope > 0.0 else -half[joint])
        return float(value)
    best, chosen = -1.0, 0
    place = np.empty(3)
    for corners in range(64):
        place[:] = p
        for joint in range(6):
            step = half[joint] if corners >> joint & 1 else -half[joint]
            for k in range(3):
                place[k] += motion[k, joint] * step
        value = _value(place, demand)
        if value > best:
            best, chosen = value, corners
    for joint in range(6):
        corner[joint] = middle[joint] + (half[joint] if chosen >> joint & 1 else -half[joint])
    return best
