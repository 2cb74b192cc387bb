"""Steps of many worlds at once, compiled: joints that are told their velocities, and how good the view is then.

Every world has an arm on a trial. What is true over a whole trial is in rows of tables, one for each trial; what is
measured of the feature lies in the frame of the arm's base, all trials one after another (:class:`Tables`).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from surgbench.compiled import compiled
from surgbench.geometry import FloatArray
from surgbench.viewpoint.kinematics import forward
from surgbench.viewpoint.servo_steps import (
    ACCELERATION,
    DT_S,
    FASTEST,
    JOINTS,
    LOWER,
    MEASURED,
    SETPOINT,
    UPPER,
    VELOCITY,
    clip,
    follow,
    possible,
    slower,
)

# Kept from a limit, so that rounding takes no set point beyond it: picometres, and as little of a turn.
_ROOM = 1e-12
# What `views` has in a row.
VVA_DEG, FD_MM, PF_DEG, AN_DEG, PN_FULL_MM, NO_GO_MM, FLOOR_MM, ORIENTATION_DEG, PROXIMITY_MM = range(9)
ERRORS, VIEWS = 5, 9
# What `flags` has in a row.
COUNTED, SEEN_NOW, ENDED = range(3)
# What `seen` has in a row: feature and normal in the camera's frame, the world's up in it, feature and normal in the
# base's.
SEEN = 15


class Tables(NamedTuple):
    """What trials are to the worlds; K trials, S samples in all of them.

    Attributes:
        arm: ``(K, 4)`` insertion offset, roll offset, wrist length, and from the tool's origin to the camera, metres.
        limits: ``(K, 4, 6)`` as :mod:`surgbench.viewpoint.servo_steps` has them.
        timing: ``(K, 3)`` likewise.
        start: ``(K, 6)`` joints at rest.
        up: ``(K, 3)`` the world's up in the base's frame.
        faces: ``(K, 6, 4)`` of the no-go zone, inward unit normals and offsets, in the base's frame.
        floor: ``(K, 4)`` of the floor, likewise.
        side: ``(K, 3)`` along which the camera's y axis must not point, in the base's frame.
        distances: ``(K, 2)`` d_t, and the smallest one allowed.
        first: ``(K,)`` where a trial's samples begin.
        length: ``(K,)`` how many there are.
        place: ``(S, 3)`` of the feature, in the base's frame; where it was not measured, the last one that was.
        normal: ``(S, 3)`` of the feature, likewise.
        measured: ``(S,)`` 2 where the feature was measured, 1 where it was before, 0 where it has not been yet.
    """

    arm: FloatArray
    limits: FloatArray
    timing: FloatArray
    start: FloatArray
    up: FloatArray
    faces: FloatArray
    floor: FloatArray
    side: FloatArray
    distances: FloatArray
    first: NDArray[np.int64]
    length: NDArray[np.int64]
    place: FloatArray
    normal: FloatArray
    measured: NDArray[np.int64]


@compiled
def reachable(limits: FloatArray, timing: FloatArray, state: FloatArray, j: int, wanted: float) -> float:
    """The set point after this step that comes nearest to a velocity, and from which a joint can still be stopped.

    Args:
        limits: As :mod:`surgbench.viewpoint.servo_steps` has them.
        timing: Likewise.
        state: Likewise.
        j: The joint.
        wanted: Its velocity; NaN counts as 0.
    """
    dt_s, change = timing[DT_S], limits[ACCELERATION, j] * timing[DT_S]
    at, now = state[SETPOINT, j], state[VELOCITY, j]
    if math.isnan(wanted):
        wanted = 0.0
    # v with at + v dt + v^2 / 2a at the limit: no faster, or it could not be stopped before it.
    up = math.sqrt(change * change + 2 * limits[ACCELERATION, j] * max(limits[UPPER, j] - at - _ROOM, 0.0)) - change
    down = math.sqrt(change * change + 2 * limits[ACCELERATION, j] * max(at - limits[LOWER, j] - _ROOM, 0.0)) - change
    velocity = clip(wanted, max(-limits[FASTEST, j], -down, now - change), min(limits[FASTEST, j], up, now + change))
    if possible(limits, timing, state, j, at + velocity * dt_s):
        return float(at + velocity * dt_s)
    return float(at + slower(limits, j, now, dt_s) * dt_s)


@compiled(makes_arrays=True)
def view(
    tables: Tables, k: int, sample: int, joints: FloatArray, pose: FloatArray, seen: FloatArray, views: FloatArray
) -> None:
    """What a camera sees, and how good that is (:func:`surgbench.viewpoint.scores.view_errors`).

    Args:
        tables: The trials.
        k: Which trial.
        sample: Which sample of all; the feature is where that says.
        joints: ``(6,)`` measured.
        pose: ``(4, 4)``, overwritten.
        seen: ``(15,)``, filled.
        views: ``(9,)``, of which the five errors are filled.
    """
    forward(tables.arm[k], joints, pose)
    d_t = tables.distances[k, 0]
    known = tables.measured[sample] > 0
    along = across = square = distance = level = facing = off = turned = 0.0
    for i in range(3):
        pose[i, 3] += tables.arm[k, 3] * pose[i, 2]
    for i in range(3):
        # Before the feature was ever measured it is where the camera looks.
        feature = tables.place[sample, i] if known else pose[i, 3] + d_t * pose[i, 2]
        normal = tables.normal[sample, i] if known else -pose[i, 2]
        seen[9 + i], seen[12 + i] = feature, normal
    for i in range(3):
        seen[i] = seen[3 + i] = seen[6 + i] = 0.0
        for row in range(3):
            seen[i] += pose[row, i] * (seen[9 + row] - pose[row, 3])
            seen[3 + i] += pose[row, i] * seen[12 + row]
            seen[6 + i] += pose[row, i] * tables.up[k, row]
        off += (pose[i, 3] - seen[9 + i] - d_t * seen[12 + i]) ** 2
    along, facing = seen[2], -seen[5]
    across = math.hypot(seen[0], seen[1])
    turned = math.hypot(seen[3], seen[4])
    square = along * along + across * across
    distance = math.sqrt(square)
    level = math.asin(clip(seen[6], -1.0, 1.0))
    views[VVA_DEG] = math.degrees(math.atan2(across, along))
    views[FD_MM] = 1e3 * abs(distance - d_t)
    views[PF_DEG] = math.degrees(abs(level))
    views[AN_DEG] = math.degrees(math.atan2(turned, facing))
    views[PN_FULL_MM] = 1e3 * math.sqrt(off)


@compiled(makes_arrays=True)
def depths(tables: Tables, k: int, sample: int, state: FloatArray, pose: FloatArray, views: FloatArray) -> None:
    """How far the camera is beyond each rule, by its set point or its joints, the worse of the two.

    Args:
        tables: The trials.
        k: Which trial.
        sample: Which sample of all; the feature is where that says.
        state: ``(3, 6)`` as :mod:`surgbench.viewpoint.servo_steps` has it.
        pose: ``(4, 4)``, overwritten.
        views: ``(9,)``, of which the depths are filled: millimetres and degrees, negative where nothing is broken.
    """
    for rule in range(ERRORS, VIEWS):
        views[rule] = -math.inf
    for part in (SETPOINT, MEASURED):
        forward(tables.arm[k], state[part], pose)
        for i in range(3):
            pose[i, 3] += tables.arm[k, 3] * pose[i, 2]
        inside = math.inf
        for face in range(tables.faces.shape[1]):
            depth = -tables.faces[k, face, 3]
            for i in range(3):
                depth += tables.faces[k, face, i] * pose[i, 3]
            inside = min(inside, depth)
        above, square, across = -tables.floor[k, 3], 0.0, 0.0
        for i in range(3):
            above += tables.floor[k, i] * pose[i, 3]
            square += (tables.place[sample, i] - pose[i, 3]) ** 2
            across += tables.side[k, i] * pose[i, 1]
        near = tables.distances[k, 1] - math.sqrt(square)
        views[NO_GO_MM] = max(views[NO_GO_MM], 1e3 * inside)
        views[FLOOR_MM] = max(views[FLOOR_MM], -1e3 * above)
        views[ORIENTATION_DEG] = max(views[ORIENTATION_DEG], math.degrees(math.asin(clip(across, -1.0, 1.0))))
        views[PROXIMITY_MM] = max(views[PROXIMITY_MM], 1e3 * near)
    if tables.measured[sample] == 0:  # it has not been seen yet
        views[PROXIMITY_MM] = -1e3 * tables.distances[k, 1]


@compiled(makes_arrays=True)
def step_worlds(
    tables: Tables,
    tolerances: FloatArray,
    trial: NDArray[np.int64],
    shares: FloatArray,
    index: NDArray[np.int64],
    state: FloatArray,
    seen: FloatArray,
    views: FloatArray,
    costs: FloatArray,
    flags: NDArray[np.bool_],
) -> None:
    """One step of N worlds: the joints follow, the errors are of where that is and of what was wanted before.

    Args:
        tables: The trials.
        tolerances: ``(5,)`` by which errors are divided before they are squared and added.
        trial: ``(N,)`` which one each world is on.
        shares: ``(N, 6)`` wanted joint velocities, as shares of the largest; clipped to -1 and 1.
        index: ``(N,)`` which step it is at, from 0; counted on.
        state: ``(N, 3, 6)`` as :mod:`surgbench.viewpoint.servo_steps` has it; moved on.
        seen: ``(N, 15)``, filled with what is seen at the next step.
        views: ``(N, 9)``, filled with errors and depths after this one.
        costs: ``(N, 2)``, filled: the errors as one number, 0 where the feature was not measured, and how far beyond
            all rules together, millimetres and degrees.
        flags: ``(N, 3)``, filled: whether the feature was measured at this step, whether it is at the next one, and
            whether the trial has ended. Worlds whose trial has ended stay as they are, with costs of 0.
    """
    pose, after, then = np.empty((4, 4)), np.empty((3, JOINTS)), np.empty(VIEWS)
    for n in range(len(trial)):
        costs[n, 0] = costs[n, 1] = 0.0
        if flags[n, ENDED]:
            flags[n, COUNTED] = False
            continue
        k = trial[n]
        limits, timing, now = tables.limits[k], tables.timing[k], state[n]
        sample = tables.first[k] + index[n]
        flags[n, COUNTED] = tables.measured[sample] == 2
        for j in range(JOINTS):
            if flags[n, COUNTED]:
                to = reachable(limits, timing, now, j, clip(shares[n, j], -1.0, 1.0) * limits[FASTEST, j])
                velocity = (to - now[SETPOINT, j]) / timing[DT_S]
            else:  # nobody is asked, and the arm comes to rest
                velocity = slower(limits, j, now[VELOCITY, j], timing[DT_S])
                to = now[SETPOINT, j] + (now[VELOCITY, j] + velocity) / 2 * timing[DT_S]
            follow(limits, timing, now, j, to, velocity, after)
        now[:] = after
        view(tables, k, sample, now[MEASURED], pose, seen[n], views[n])
        index[n] += 1
        flags[n, ENDED] = index[n] >= tables.length[k]
        if not flags[n, ENDED]:  # else the feature stays where it was
            sample += 1
            view(tables, k, sample, now[MEASURED], pose, seen[n], then)
            flags[n, SEEN_NOW] = tables.measured[sample] == 2
        depths(tables, k, sample, now, pose, views[n])
        for error in range(ERRORS):
            if flags[n, COUNTED]:
                costs[n, 0] += (views[n, error] / tolerances[error]) ** 2
        for rule in range(ERRORS, VIEWS):
            if rule != PROXIMITY_MM or flags[n, SEEN_NOW]:
                costs[n, 1] += max(views[n, rule], 0.0)


@compiled(makes_arrays=True)
def begin_worlds(
    tables: Tables,
    trial: NDArray[np.int64],
    begun: NDArray[np.bool_],
    index: NDArray[np.int64],
    state: FloatArray,
    seen: FloatArray,
    views: FloatArray,
    flags: NDArray[np.bool_],
) -> None:
    """Put those worlds that are ``begun`` at the beginning of their trials; the rest as in :func:`step_worlds`."""
    pose = np.empty((4, 4))
    for n in range(len(trial)):
        if begun[n]:
            k = trial[n]
            index[n] = 0
            for j in range(JOINTS):
                state[n, SETPOINT, j] = state[n, MEASURED, j] = tables.start[k, j]
                state[n, VELOCITY, j] = 0.0
            view(tables, k, tables.first[k], state[n, MEASURED], pose, seen[n], views[n])
            depths(tables, k, tables.first[k], state[n], pose, views[n])
            flags[n, COUNTED] = flags[n, ENDED] = False
            flags[n, SEEN_NOW] = tables.measured[tables.first[k]] == 2


@compiled
def observe_worlds(
    state: FloatArray,
    seen: FloatArray,
    views: FloatArray,
    flags: NDArray[np.bool_],
    low: FloatArray,
    high: FloatArray,
    out: NDArray[np.float32],
) -> None:
    """All that is known at a step in one row for each world: joints, set points, velocities, what is seen, depths.

    Args:
        state: As in :func:`step_worlds`.
        seen: Likewise.
        views: Likewise.
        flags: Likewise.
        low: ``(38,)`` to which numbers are clipped.
        high: ``(38,)``.
        out: ``(N, 38)``, filled.
    """
    for n in range(len(out)):
        for i in range(len(low)):
            if i < 3 * JOINTS:
                part = MEASURED if i < JOINTS else (SETPOINT if i < 2 * JOINTS else VELOCITY)
                value = state[n, part, i % JOINTS]
            elif i < 3 * JOINTS + SEEN:
                value = seen[n, i - 3 * JOINTS]
            elif i < 3 * JOINTS + SEEN + VIEWS - ERRORS:
                value = views[n, ERRORS + i - 3 * JOINTS - SEEN]
            else:
                value = 1.0 if flags[n, SEEN_NOW] else 0.0
            out[n, i] = clip(value, low[i], high[i])
