"""Other states that might explain a frame: where a tracker that slipped could have slipped from."""

from __future__ import annotations

from collections.abc import Sequence
from enum import IntEnum

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from surgbench.camera import Camera
from surgbench.contract import Mask
from surgbench.geometry import FloatArray, look_at_rotation, wrap_angle
from surgbench.instrument import Instrument
from surgbench.state import ANGLES, BETA, JOINTS, POSITION, STATE_SIZE, JointLimits, split_arms

# Spread of what is not drawn anew.
NEAR = np.array([0.01, 0.15, 0.01, 2e-4, 2e-4, 1e-3, 0.1, 0.1, 0.1])
WIDEST_ROLL_RAD = 1.6  # beyond a quarter turn the twin is nearer, of instruments that have one
WIDEST_JAW_RAD = 1.0
FARTHEST_M = 0.05  # along the shaft
NEARBY_M = 0.004  # likewise, standard deviation
SWEPT = 16  # places of a jaw in a sweep
# What a jump of each component counts as: beyond it, ever less for each further step.
JUMP = np.array([0.03, 0.1, 0.03, 2e-3, 2e-3, 4e-3, 0.1, 0.1, 0.1])


class Move(IntEnum):
    """How a proposal differs from the state it is drawn around."""

    TURN = 0  # about the shaft, by up to a quarter turn either way
    JAW = 1  # one jaw stays where it is, the other is somewhere else
    JOINTS = 2  # all joints anew
    BOTH = 3  # turned, and all joints anew
    NEAR = 4  # a little in everything
    SWEEP = 5  # one jaw exactly where it is, the other at every place in turn
    BELIEVED = 6  # anything that is believed to be likely
    SLIDE = 7  # along the shaft, and turned about it
    ANEW = 8  # a little along the shaft, and turned about it, with all joints anew


MOVES = (Move.TURN, Move.JAW, Move.TURN, Move.JOINTS, Move.JAW, Move.BOTH, Move.TURN, Move.JAW, Move.JOINTS, Move.NEAR)
MOVES_WITH_READINGS = (Move.TURN, Move.TURN, Move.NEAR)


def widest_rolls(instruments: Sequence[Instrument]) -> FloatArray:
    """``(arms,)``: how far about the shaft to look for each; all around it where no twin looks the same."""
    return np.array([np.pi if one.symmetry == "none" else WIDEST_ROLL_RAD for one in instruments])


def propose(
    states: FloatArray,
    count: int,
    limits: JointLimits,
    known_joints: bool,
    rng: np.random.Generator,
    widest_roll_rad: ArrayLike = WIDEST_ROLL_RAD,
) -> tuple[FloatArray, NDArray[np.intp]]:
    """Draw states around some that are thought of.

    Args:
        states: ``(m, 9 * arms)`` the present estimate, the last one, and the like.
        count: How many to draw.
        limits: Of the joints, per arm.
        known_joints: Joints are known from readings: they are not drawn anew.
        rng: The only source of randomness.
        widest_roll_rad: How far to turn about the shaft; one number, or ``(arms,)`` (:func:`widest_rolls`).

    Returns:
        ``(count, 9 * arms)`` states, with two arms one of them changed in each; and ``(count,)`` their :class:`Move`.
    """
    moves = np.resize(np.array(MOVES_WITH_READINGS if known_joints else MOVES, dtype=np.intp), count)
    drawn: FloatArray = np.tile(states, (-(-count // len(states)), 1))[rng.permutation(count)]
    arms = split_arms(drawn)
    arm = rng.integers(arms.shape[1], size=count)
    one = arms[np.arange(count), arm]
    lower, upper = limits.lower_rad[arm], limits.upper_rad[arm]
    widest = np.minimum(upper, [np.inf, np.inf, WIDEST_JAW_RAD])
    near = (moves == Move.NEAR) | (moves == Move.JAW)
    one[near] += rng.normal(0.0, 1.0, (int(near.sum()), STATE_SIZE)) * NEAR
    rolled = np.broadcast_to(widest_roll_rad, arms.shape[1])[arm] * rng.uniform(-1.0, 1.0, count)
    one[:, BETA] += np.where((moves == Move.TURN) | (moves == Move.BOTH), rolled, 0.0)
    anew = (moves == Move.JOINTS) | (moves == Move.BOTH)
    one[anew, JOINTS] = rng.uniform(lower, widest)[anew]
    jaw = moves == Move.JAW
    yaw, half = one[:, JOINTS.start + 1], one[:, JOINTS.start + 2]
    side = np.where(rng.random(count) < 0.5, 1.0, -1.0)
    opening = rng.uniform(0.0, 2.0 * widest[:, 2])
    # The jaws stand at yaw - half and yaw + half; one of them stays.
    one[jaw, JOINTS.start + 1] = (yaw + side * (half - opening / 2.0))[jaw]
    one[jaw, JOINTS.start + 2] = opening[jaw] / 2.0
    one[:, JOINTS] = np.clip(one[:, JOINTS], lower, upper)
    arms[np.arange(count), arm] = one
    return drawn, moves


def sweep_jaws(states: FloatArray, limits: JointLimits) -> FloatArray:
    """States in which one jaw stays exactly where it is and the other is at every place in turn.

    What a jaw that lies on the other one needs; unlike what is drawn, it is the same whatever the seed.

    Args:
        states: ``(m, 9 * arms)`` to begin with.
        limits: Of the joints, per arm.

    Returns:
        ``(m * arms * 2 * SWEPT, 9 * arms)``.
    """
    swept = []
    count = states.shape[1] // STATE_SIZE
    for state in states:
        for arm in range(count):
            yaw, half = state[arm * STATE_SIZE + JOINTS.start + 1], state[arm * STATE_SIZE + JOINTS.start + 2]
            lower, upper = limits.lower_rad[arm], limits.upper_rad[arm]
            opening = np.linspace(0.0, 2.0 * min(upper[2], WIDEST_JAW_RAD), SWEPT)
            for side in (-1.0, 1.0):
                # The jaws stand at yaw - half and yaw + half; that one stays.
                some: FloatArray = np.tile(state, (SWEPT, 1))
                joints = some[:, arm * STATE_SIZE :][:, JOINTS]
                joints[:, 1], joints[:, 2] = yaw + side * (half - opening / 2.0), opening / 2.0
                joints[:] = np.clip(joints, lower, upper)
                swept.append(some)
    return np.concatenate(swept)


def slide(
    states: FloatArray, count: int, rng: np.random.Generator, widest_roll_rad: float = WIDEST_ROLL_RAD
) -> FloatArray:
    """States that have moved along their shafts and turned about them, which is what a shaft tells nothing of.

    Args:
        states: ``(m, 9)`` of one arm.
        count: How many to draw.
        rng: The only source of randomness.
        widest_roll_rad: How far to turn.

    Returns:
        ``(count, 9)``.
    """
    slid: FloatArray = np.resize(states, (count, STATE_SIZE))
    ways = rng.uniform(-FARTHEST_M, FARTHEST_M, count)
    slid[:, POSITION] += ways[:, None] * look_at_rotation(slid[:, ANGLES])[..., 2]
    slid[:, BETA] += widest_roll_rad * rng.uniform(-1.0, 1.0, count)
    return slid


def anew(
    states: FloatArray,
    count: int,
    limits: JointLimits,
    rng: np.random.Generator,
    widest_roll_rad: float = WIDEST_ROLL_RAD,
) -> FloatArray:
    """States with the shaft all but where it is, of which roll and joints are not known any more.

    Args:
        states: ``(m, 9)`` of one arm.
        count: How many to draw.
        limits: Of the joints.
        rng: The only source of randomness.
        widest_roll_rad: How far to turn.

    Returns:
        ``(count, 9)``.
    """
    drawn: FloatArray = np.resize(states, (count, STATE_SIZE))
    drawn[:, POSITION] += NEARBY_M * rng.standard_normal((count, 1)) * look_at_rotation(drawn[:, ANGLES])[..., 2]
    drawn[:, BETA] += widest_roll_rad * rng.uniform(-1.0, 1.0, count)
    lower, upper = limits.lower_rad[0], limits.upper_rad[0]
    drawn[:, JOINTS] = rng.uniform(lower, np.minimum(upper, [np.inf, np.inf, WIDEST_JAW_RAD]), (count, len(lower)))
    return drawn


def best_of_each(losses: FloatArray, moves: NDArray[np.intp], count: int) -> NDArray[np.intp]:
    """Indices of ``count`` proposals with small losses, every kind of move in its turn."""
    order = np.argsort(losses, kind="stable")
    rank = np.empty(len(order), dtype=np.intp)
    for move in Move:
        own = order[moves[order] == move]
        rank[own] = np.arange(len(own))
    return np.lexsort((losses, rank))[:count]


def jump_cost(state: FloatArray, last: FloatArray) -> float:
    """How unlikely a jump from the last state is: minus the logarithm of a heavy-tailed density, 0 for none.

    Args:
        state: ``(9 * arms,)``.
        last: Same shape.
    """
    change = (state - last).reshape(-1, STATE_SIZE)
    change[:, : POSITION.start] = wrap_angle(change[:, : POSITION.start])
    return float(np.log1p((change / JUMP) ** 2).sum())


def shift_to_mask(state: FloatArray, silhouette: Mask, mask: Mask, camera: Camera) -> FloatArray:
    """The state of one arm moved across the image so that its silhouette's centre is where the mask's is.

    Args:
        state: ``(9,)``.
        silhouette: ``(H, W)`` its silhouette; where it is empty the wrist itself is moved there.
        mask: ``(H, W)`` observed, not empty.
        camera: Of both.
    """
    moved = np.array(state)
    target = _centre(mask)
    here = _centre(silhouette) if silhouette.any() else camera.project(state[POSITION])
    moved[POSITION][:2] += (target - here) / [camera.fx, camera.fy] * state[POSITION][2]
    return moved


def _centre(mask: Mask) -> FloatArray:
    moments = cv2.moments(mask.view(np.uint8), binaryImage=True)
    return np.array([moments["m10"], moments["m01"]]) / moments["m00"]
