"""One step of the controller `gaze`: from what is measured to the next set point."""

from __future__ import annotations

import math

import numpy as np

from surgbench.compiled import compiled
from surgbench.geometry import FloatArray
from surgbench.trackers.viewing.approach import chase, track
from surgbench.trackers.viewing.barrier import guard
from surgbench.trackers.viewing.brake import secure
from surgbench.trackers.viewing.choice import ray, seek
from surgbench.trackers.viewing.fit import fit
from surgbench.trackers.viewing.look import look_nearly
from surgbench.trackers.viewing.pace import pace
from surgbench.trackers.viewing.way import arc, clear, go_round
from surgbench.trackers.viewing.world import ACCELERATION, LOWER, UPPER, VELOCITY, World

AT_ONCE, LATER, FITTED = range(3)
# Where the numbers of ``options`` stand.
FILTER_GAIN, NORMAL_GAIN, PATIENCE, SHARE, FASTEST = range(5)
# Of ``memory``: whether there is a way round, and the direction it goes by; steps since it was looked for; and the
# velocity with which the camera should go round the feature.
ROUND, TRIED, VELOCITY_OF_WAY = 0, 4, 5
MEMORY = 8
# After so many steps a way round is looked for again.
TRY_AGAIN = 8
# Of a joint's limit, so that rounding never makes a stop before it impossible.
ROUNDING = 1e-9
# One over the tolerance of the camera's place, where a step has to give something up.
TURN = 1 / 5e-3
# Beyond this cost of a view another turn of roll and wrist is tried; a way shorter than this is never gone round.
LOST, BETTER = 2e4, 0.8
SHORT_RAD = 0.3
# However far roll and wrist are behind, the others go on at this share of their pace.
LEAST_PACE = 0.2
# So much a way may be beyond a rule, and so much it must be within once there is another way.
SURE_M = 1e-3


@compiled
def reachable(limits: FloatArray, setpoint: FloatArray, velocity: FloatArray, dt_s: float, box: FloatArray) -> None:
    """What every joint can reach in one step, and still stop before its limit: ``box``, ``(2, 6)``, is filled."""
    for joint in range(6):
        a = limits[3, joint]
        room_up = max(limits[1, joint] - setpoint[joint] - ROUNDING, 0.0)
        room_down = max(setpoint[joint] - limits[0, joint] - ROUNDING, 0.0)
        fast_up = math.sqrt(a * a * dt_s * dt_s + 2 * a * room_up) - a * dt_s
        fast_down = math.sqrt(a * a * dt_s * dt_s + 2 * a * room_down) - a * dt_s
        least = max(velocity[joint] - a * dt_s, -limits[2, joint])
        most = min(velocity[joint] + a * dt_s, limits[2, joint])
        # Where both cannot be had, braking as hard as possible comes nearest.
        box[0, joint] = setpoint[joint] + min(max(least, -fast_down), most) * dt_s
        box[1, joint] = setpoint[joint] + max(min(most, fast_up), least) * dt_s


@compiled(makes_arrays=True, calls="viewpoint")
def predict(motion: FloatArray, world: World, feature: FloatArray, later: FloatArray, normal: FloatArray) -> None:
    """The feature when the joints are at the set point, and after the next step; and the normal then, a unit vector."""
    length = 0.0
    for k in range(3):
        feature[k] = motion[0, k] + world.lag_s * motion[1, k]
        later[k] = feature[k] + world.dt_s * motion[1, k]
        normal[k] = motion[2, k] + (world.lag_s + world.dt_s) * motion[3, k]
        length += normal[k] ** 2
    length = math.sqrt(length)
    for k in range(3):
        normal[k] = normal[k] / length if length > 1e-9 else motion[2, k]


@compiled(makes_arrays=True, calls="viewpoint")
def direct(
    world: World,
    feature: FloatArray,
    tool: FloatArray,
    start: FloatArray,
    start_m: float,
    end: FloatArray,
    end_m: float,
    near: FloatArray,
    memory: FloatArray,
) -> None:
    """Decide on the way: straight, or round by a direction that ``memory`` (``(8,)``) keeps."""
    by = memory[1:4]
    going = memory[ROUND] > 0.0
    slack_m = -SURE_M if going else SURE_M
    short = arc(start, end, np.empty(3)) < SHORT_RAD
    if short or clear(world, feature, tool, start, start_m, end, end_m, near, True, slack_m):
        memory[ROUND], memory[TRIED] = 0.0, 0.0
        return
    memory[TRIED] += 1.0
    going = going and clear(world, feature, tool, start, start_m, by, world.distance_m, near, False, SURE_M)
    if memory[TRIED] < TRY_AGAIN and (going or memory[ROUND] == 0.0):
        return
    if going and clear(world, feature, tool, by, world.distance_m, end, end_m, near, False, SURE_M):
        memory[TRIED] = 0.0
        return
    memory[TRIED] = 0.0
    found = go_round(world, feature, tool, start, start_m, end, end_m, near, True, SURE_M, by)
    if not found and not clear(world, feature, tool, start, start_m, end, end_m, near, False, slack_m):
        found = go_round(world, feature, tool, start, start_m, end, end_m, near, False, SURE_M, by)
    memory[ROUND] = 1.0 if found else 0.0


@compiled(makes_arrays=True, calls="viewpoint")
def advance(
    world: World,
    options: FloatArray,
    goal_weights: FloatArray,
    way_weights: FloatArray,
    step_weights: FloatArray,
    iterations: FloatArray,
    index: int,
    pose: FloatArray,
    motion: FloatArray,
    last: FloatArray,
    goal: FloatArray,
    memory: FloatArray,
    joints: FloatArray,
    setpoint: FloatArray,
    velocity: FloatArray,
    out: FloatArray,
) -> int:
    """One step; everything in the frame of the arm's base.

    Args:
        world: Arm and rules.
        options: ``(5,)``: the two filter gains, by how much roll and wrist are behind when the others go at half their
            pace, the share of the accelerations for the way, and the largest speed on it.
        goal_weights: ``(7,)``.
        way_weights: ``(7,)``.
        step_weights: ``(7,)``.
        iterations: ``(2,)`` of the two fits.
        index: Of the step.
        pose: ``(4, 4)`` the feature as measured.
        motion: ``(4, 3)`` filtered feature and its velocity, normal and its velocity.
        last: ``(6,)`` what looked at the feature in the last step, updated.
        goal: ``(6,)`` joints where the camera should be in the end; the last step's, improved.
        memory: ``(8,)`` of the way.
        joints: ``(6,)`` measured.
        setpoint: ``(6,)``.
        velocity: ``(6,)``.
        out: ``(6,)`` the next set point.

    Returns:
        ``AT_ONCE`` where the naive pose can be had in this step, ``LATER``, or ``FITTED`` where it cannot be had.
    """
    dt = world.dt_s
    track(pose[:3, 3].copy(), options[FILTER_GAIN], dt, motion[0], motion[1])
    track(pose[:3, 1].copy(), options[NORMAL_GAIN], dt, motion[2], motion[3])
    feature, later, normal, tool = np.empty(3), np.empty(3), np.empty(3), np.empty((2, 3))
    tool[0], tool[1] = pose[:3, 2], pose[:3, 1]
    predict(motion, world, feature, later, normal)
    free = seek(
        world, later, normal, tool, goal_weights, int(iterations[0]), index, setpoint, goal
    )  # fmt: skip

    # Where the camera would be if it looked at the feature from where the slow joints are, and where it should be.
    virtual, p = setpoint.copy(), np.empty(3)
    virtual[3:] = last[3:]
    start, end, across = np.empty(3), np.empty(3), np.empty(3)
    start_m, end_m = ray(world, virtual, feature, start), ray(world, goal, later, end)
    direct(world, later, tool, start, start_m, end, end_m, virtual, memory)
    further = 0.0
    if memory[ROUND] > 0.0:
        further = world.distance_m * arc(memory[1:4], end, across)
        end[:] = memory[1:4]
        end_m = world.distance_m
    angle = arc(start, end, across)

    # How fast it went along the way until now, as far as that is this way, and how far it should be after the step.
    speed = 0.0
    for k in range(3):
        speed += memory[VELOCITY_OF_WAY + k] * across[k]
    behind = 0.0
    for joint in range(3, 6):
        behind = max(behind, abs(last[joint] - setpoint[joint]))
    patience = max(1.0 / (1.0 + (behind / options[PATIENCE]) ** 2), LEAST_PACE)
    along = np.empty(2)
    speed = pace(
        world, later, start, start_m, end, end_m, further, virtual, max(speed, 0.0), options[SHARE], patience, tool,
        way_weights, int(iterations[0]), along,
    )  # fmt: skip
    moved = min(along[0], options[FASTEST] * dt)
    for k in range(3):
        memory[VELOCITY_OF_WAY + k] = min(speed, options[FASTEST]) * across[k]
    share = moved / along[1] if along[1] > 1e-12 else 1.0
    u, wanted, box = np.empty(3), np.empty(6), np.empty((2, 6))
    for k in range(3):
        u[k] = math.cos(share * angle) * start[k] + math.sin(share * angle) * across[k]
    reachable(world.limits, setpoint, velocity, dt, box)
    met = share >= 1.0 and memory[ROUND] == 0.0
    if met:
        wanted[:] = goal
    else:
        distance_m = start_m + share * (end_m - start_m)
        look_nearly(
            world, later, u, distance_m, tool, way_weights, int(iterations[0]), virtual, p, wanted
        )  # fmt: skip
    for joint in range(3):
        out[joint] = min(box[1, joint], max(box[0, joint], wanted[joint]))
        met = met and out[joint] == wanted[joint]

    # Roll and wrist turn to the feature from there.
    view = last.copy()
    view[:3] = out[:3]
    bounds = world.limits[:2].copy()
    bounds[0, :3] = bounds[1, :3] = out[:3]
    if met and free:
        view[3:] = goal[3:]
    else:
        missed = fit(
            world, view, bounds[0], bounds[1], later, normal, tool, step_weights, int(iterations[1])
        )  # fmt: skip
        if missed > LOST:
            other = view.copy()
            for joint in range(3, 6):
                other[joint] = min(world.limits[UPPER, joint], max(world.limits[LOWER, joint], wanted[joint]))
            other_missed = fit(
                world, other, bounds[0], bounds[1], later, normal, tool, step_weights, int(iterations[1])
            )  # fmt: skip
            if other_missed < BETTER * missed:
                view[:] = other
    rate = np.empty(3)
    for joint in range(3):
        rate[joint] = (view[3 + joint] - last[3 + joint]) / dt
        if abs(rate[joint]) > world.limits[VELOCITY, 3 + joint]:
            rate[joint] = 0.0
    last[:] = view
    turned = chase(
        setpoint[3:], view[3:], rate, box[:, 3:], world.limits[ACCELERATION, 3:], dt, 1.0, out[3:]
    )  # fmt: skip
    guarded = guard(world, setpoint, velocity, feature, later, tool, box, step_weights, TURN, out)
    guarded = secure(world, setpoint, velocity, joints, out) or guarded
    return FITTED if not free else (AT_ONCE if met and turned and not guarded else LATER)
