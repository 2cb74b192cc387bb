"""The contour fit, the motion belief, the proposals and the tracker made of them, where the answer is known."""

from __future__ import annotations

import pickle
from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support import observe, resting_state, scene_of

from surgbench.camera import Camera
from surgbench.contract import Mask, Observation, Scene, View
from surgbench.geometry import FloatArray, look_at_rotation
from surgbench.keypoints.found import FoundTips
from surgbench.metrics import OUT_OF_VIEW_SHARE, RECOVERED_M, pose_errors
from surgbench.silhouette import Reference, SilhouetteEvaluator
from surgbench.state import ALPHA, ANGLES, BETA, GAMMA, JOINTS, POSITION, STATE_SCALE, STATE_SIZE
from surgbench.trackers.hybrid import HybridTracker
from surgbench.trackers.registration.arrival import DISTANCES, PATIENCE, STEADY, Whereabouts, arrivals
from surgbench.trackers.registration.belief import NO_SHAPE, MotionBelief
from surgbench.trackers.registration.edges import (
    explained_lengths,
    find_edges,
    missed_edge,
    missed_lengths,
)
from surgbench.trackers.registration.fit import ContourFit, FitConfig, Prior
from surgbench.trackers.registration.follower import ACCELERATION, SETTLING_S, VELOCITY
from surgbench.trackers.registration.jaws import JawJudge
from surgbench.trackers.registration.proposals import (
    SWEPT,
    Move,
    anew,
    best_of_each,
    jump_cost,
    propose,
    shift_to_mask,
    sweep_jaws,
)

NOTHING_KNOWN = np.full((STATE_SIZE, STATE_SIZE), 0.0) + 1e-9 * np.eye(STATE_SIZE)


def errors_of(scene: Scene, estimate: FloatArray, truth: FloatArray) -> dict[str, float]:
    errors = pose_errors(scene.instruments[0], scene.views[0].camera, estimate[None], truth[None])
    return {name: float(values[0]) for name, values in errors.items()}


def seen(scene: Scene, mask: Mask, index: int = 0) -> Observation:
    """A frame of which only the mask is known; no search begins at its ``start``, which is anywhere."""
    return Observation(index, index * scene.dt_s, (replace(scene.views[0], mask=mask),), start=resting_state())


# --- edges


def test_edges_are_found_where_the_mask_was_moved(camera: Camera) -> None:
    """A mask moved by whole pixels has its edges just so far along the normals; without any move, at the contour."""
    scene, state = scene_of(camera), resting_state()
    evaluator = SilhouetteEvaluator(scene.instruments, camera)
    mask, contour = evaluator.mask(state), evaluator.contour_points(state, 1)
    for move in (np.array([0, 0]), np.array([2, 0]), np.array([0, -3]), np.array([-2, 2])):
        moved = np.roll(mask, (move[1], move[0]), axis=(0, 1))
        offsets = find_edges(contour, moved, 8)
        off = offsets - contour.normals @ move
        # Where the shaft is long and straight; jaws and corners have other edges near by.
        near = np.abs(off) < 1.0
        assert near.mean() > 0.9
        assert abs(off[near].mean()) < 0.05


def test_no_edge_is_found_beyond_reach_nor_of_the_wrong_sense(camera: Camera) -> None:
    scene, state = scene_of(camera), resting_state()
    evaluator = SilhouetteEvaluator(scene.instruments, camera)
    contour = evaluator.contour_points(state, 2)
    assert np.isnan(find_edges(contour, np.ones((camera.height, camera.width), bool), 20)).all()
    assert np.isnan(find_edges(contour, np.zeros((camera.height, camera.width), bool), 20)).all()
    # The complement has an edge at every contour point, but the other way round.
    offsets = find_edges(contour, ~evaluator.mask(state), 2)
    assert np.isnan(offsets).mean() > 0.9


def test_a_missing_jaw_is_an_unexplained_edge_and_an_unexplained_contour(camera: Camera) -> None:
    scene, state = scene_of(camera), resting_state()
    evaluator = SilhouetteEvaluator(scene.instruments, camera)
    closed = state.copy()
    # The right jaw stays where it is, the left one comes to lie upon it.
    closed[7], closed[8] = state[7] - state[8], 0.0
    mask, other = evaluator.mask(state), evaluator.mask(closed)
    assert missed_edge(mask, mask, 2, 2).explained == 1.0
    assert missed_edge(mask, other, 2, 2).explained < 0.9
    contour = evaluator.contour_points(state, 1)
    for observed, least, most in ((mask, 0.99, 1.0), (other, 0.0, 0.9)):
        near_px, length_px = explained_lengths(contour, find_edges(contour, observed, 10), 0.0, 2.0)
        assert least < near_px / length_px <= most
    assert missed_edge(np.zeros_like(mask), mask, 2, 2).explained == 1.0


def judged(scene: Scene, state: FloatArray, mask: Mask) -> float:
    """Share of the jaws that a mask leaves unexplained of a state as it is."""
    camera = scene.views[0].camera
    evaluator = SilhouetteEvaluator(scene.instruments, camera)
    contour = evaluator.contour_points(state, 1)
    shape = scene.arms, len(scene.instruments[0].spec.links)
    missed, length = missed_lengths(contour, find_edges(contour, mask, 14), 0.0, 2.0, shape)
    assert length.sum() == pytest.approx(contour.lengths_px.sum())
    edge = missed_edge(mask, evaluator.mask(state), 2, 2)
    share: float = JawJudge(scene.instruments, camera)(state, missed, length, edge)
    return share


def test_jaws_are_judged_by_their_own_contour(camera: Camera) -> None:
    """A jaw on the other one is a whole jaw missed, of either arm; one opened too far is as much; a right one is none.

    What is wrong far from the jaws is not theirs.
    """
    scene, state = scene_of(camera), resting_state()
    evaluator = SilhouetteEvaluator(scene.instruments, camera)
    mask = evaluator.mask(state)
    assert judged(scene, state, mask) < 0.05
    for side in (-1.0, 1.0):
        closed, open_ = state.copy(), state.copy()
        closed[7], closed[8] = state[7] + side * state[8], 0.0
        open_[7], open_[8] = state[7] + side * 0.25, state[8] + 0.25
        assert judged(scene, closed, mask) > 0.5
        assert judged(scene, open_, mask) > 0.5
    speck = mask.copy()
    speck[2:12, 2:12] = True
    assert judged(scene, state, speck) < 0.05
    assert judged(scene, state, np.zeros_like(mask)) == 1.0


def test_the_worse_arm_is_judged(camera: Camera) -> None:
    scene = scene_of(camera, arms=2)
    pair = np.concatenate([resting_state(), resting_state()])
    pair[[2, 11]], pair[[3, 12]] = [0.8, -0.8], [-0.02, 0.02]
    mask = SilhouetteEvaluator(scene.instruments, camera).mask(pair)
    assert judged(scene, pair, mask) < 0.05
    for arm in (0, 9):
        slipped = pair.copy()
        slipped[arm + 7], slipped[arm + 8] = pair[arm + 7] - pair[arm + 8], 0.0
        assert judged(scene, slipped, mask) > 0.5


# --- fit


@pytest.mark.slow
@settings(max_examples=15)
@given(st.integers(0, 10_000))
def test_the_fit_returns_to_the_truth(seed: int) -> None:
    """From an ordinary frame's motion away, without any prior: thousandths of a radian and a tenth of a millimetre."""
    camera = Camera(width=700, height=493, fx=905.955, fy=904.820, cx=294.280, cy=238.699)
    scene, truth = scene_of(camera), resting_state()
    rng = np.random.default_rng(seed)
    start = truth + rng.normal(0, 1, STATE_SIZE) * [0.005, 0.02, 0.005, 4e-4, 4e-4, 4e-4, 0.02, 0.02, 0.01]
    fit = ContourFit(scene, SilhouetteEvaluator(scene.instruments, camera), STATE_SCALE, FitConfig(iterations=10))
    found = fit(start, observe(scene, truth), Prior(start, NOTHING_KNOWN))
    errors = errors_of(scene, found.state, truth)
    assert errors["rotation_error_rad"] < 0.01
    assert errors["tip_error_m"] < 3e-4
    assert found.explained > 0.98


def test_a_dilated_mask_does_not_read_as_a_nearer_instrument(camera: Camera) -> None:
    scene, truth = scene_of(camera), resting_state()
    evaluator = SilhouetteEvaluator(scene.instruments, camera)
    mask = cv2.dilate(evaluator.mask(truth).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    # A frame's motion is all that it may have moved.
    prior = Prior(truth, np.diag((STATE_SCALE / [0.01, 0.05, 0.01, 1e-3, 1e-3, 1e-3, 0.03, 0.03, 0.03]) ** 2))
    found = ContourFit(scene, evaluator, STATE_SCALE, FitConfig(offset_px=2.0))(truth, seen(scene, mask), prior)
    without = ContourFit(scene, evaluator, STATE_SCALE, FitConfig(offset_px=1e-6))(truth, seen(scene, mask), prior)
    assert 0.7 < found.offset_px < 1.3
    assert abs(found.state[5] - truth[5]) < 0.3e-3 < abs(without.state[5] - truth[5])


def test_a_mask_of_another_instrument_weighs_little(camera: Camera) -> None:
    """Edges that are wrong by more than rounding are wrong together, and do not outvote what was known before."""
    scene, truth = scene_of(camera), resting_state()
    evaluator = SilhouetteEvaluator(scene.instruments, camera)
    own = evaluator.mask(truth)
    # Edges that a segmentation has moved by 3 px, outward and inward from one block of 32 px to the next.
    thick = cv2.dilate(own.astype(np.uint8), np.ones((7, 7), np.uint8)) > 0
    thin = cv2.erode(own.astype(np.uint8), np.ones((7, 7), np.uint8)) > 0
    rows, columns = np.indices(own.shape) // 32
    ragged = np.where((rows + columns) % 2 == 0, thick, thin)
    prior = Prior(truth, np.eye(STATE_SIZE))
    weight = {}
    for name, mask in (("own", own), ("ragged", ragged)):
        fit = ContourFit(scene, evaluator, STATE_SCALE, FitConfig())
        weight[name] = np.trace(fit(truth, seen(scene, mask), prior).information)
    assert weight["ragged"] < weight["own"] / 20


def test_a_frame_that_is_not_learned_from_weighs_on_no_other(camera: Camera) -> None:
    """A mask that the instrument has left would else make the edges of the right one count little for long."""
    scene, truth = scene_of(camera), resting_state()
    evaluator = SilhouetteEvaluator(scene.instruments, camera)
    elsewhere = truth.copy()
    elsewhere[3] += 6e-3
    prior = Prior(truth, 1e6 * np.eye(STATE_SIZE))  # it stays where it is
    weight = {}
    for learn in (False, True):
        fit = ContourFit(scene, evaluator, STATE_SCALE, FitConfig())
        fit(truth, seen(scene, evaluator.mask(truth)), prior)
        fit(truth, seen(scene, evaluator.mask(elsewhere), 1), prior, learn=learn)
        weight[learn] = np.trace(fit(truth, seen(scene, evaluator.mask(truth), 2), prior).information)
    fresh = ContourFit(scene, evaluator, STATE_SCALE, FitConfig())
    expected = np.trace(fresh(truth, seen(scene, evaluator.mask(truth)), prior).information)
    assert weight[False] == pytest.approx(expected, rel=1e-6)
    assert weight[True] < 0.5 * expected


def test_nothing_to_see_leaves_the_prior(camera: Camera) -> None:
    scene, truth = scene_of(camera), resting_state()
    evaluator = SilhouetteEvaluator(scene.instruments, camera)
    fit = ContourFit(scene, evaluator, STATE_SCALE, FitConfig())
    away = truth.copy()
    away[:3] += 0.01
    for fill in (False, True):
        mask = np.full((camera.height, camera.width), fill)
        found = fit(away, seen(scene, mask), Prior(truth, np.eye(STATE_SIZE)))
        np.testing.assert_allclose(found.state, truth, atol=1e-9)
        assert (found.information == 0).all()


# --- belief


def linear_update(
    mean: FloatArray, covariance: FloatArray, H: FloatArray, z: FloatArray, noise: FloatArray
) -> tuple[FloatArray, FloatArray]:
    gain = covariance @ H.T @ np.linalg.inv(H @ covariance @ H.T + noise)
    return mean + gain @ (z - H @ mean), covariance - gain @ H @ covariance


def test_the_belief_is_a_kalman_filter() -> None:
    """Handed the mode and the information of a linear measurement, it ends where Kalman's equations do."""
    rng = np.random.default_rng(0)
    n = STATE_SIZE
    belief = MotionBelief(STATE_SCALE, 1 / 30, 10 * STATE_SCALE, STATE_SCALE, 0.02, 0.001)
    state = resting_state()
    belief.restart(state, 0.1 * STATE_SCALE)
    for _ in range(4):
        belief.predict()
        belief.read_joints(state[JOINTS] + 0.01, 0.003)
        mean, covariance = belief._mean.copy(), belief._covariance.copy()
        root = rng.normal(0, 1, (n, n))
        information = root @ root.T
        z = mean[:n] + rng.normal(0, 0.1, n)
        H = np.eye(n, len(mean))
        expected, spread = linear_update(
            mean, covariance, H, z, np.asarray(np.linalg.inv(information), dtype=np.float64)
        )
        belief.update(expected[:n] * STATE_SCALE, NO_SHAPE, information)
        np.testing.assert_allclose(belief._mean, expected, atol=1e-8)
        np.testing.assert_allclose(belief._covariance, spread, atol=1e-8)


def test_the_bias_of_readings_is_learned_and_outlives_a_restart() -> None:
    belief = MotionBelief(STATE_SCALE, 1 / 30, 10 * STATE_SCALE, STATE_SCALE, 0.02, 1e-4)
    state, bias = resting_state(), np.array([0.02, -0.03, 0.01])
    belief.restart(state, 0.1 * STATE_SCALE)
    for _ in range(50):
        belief.predict()
        belief.read_joints(state[JOINTS] + bias, 0.003)
        belief.update(state, NO_SHAPE, 1e4 * np.eye(STATE_SIZE))
    belief.restart(state, 10 * STATE_SCALE)
    belief.read_joints(state[JOINTS] + bias, 0.003)
    np.testing.assert_allclose(belief.state[JOINTS], state[JOINTS], atol=2e-3)


def test_a_velocity_that_nothing_tells_of_settles() -> None:
    settling_s = np.full(STATE_SIZE, np.inf)
    settling_s[8] = 0.5
    belief = MotionBelief(STATE_SCALE, 0.1, STATE_SCALE, STATE_SCALE, 0.02, 0.001, settling_s=settling_s)
    belief.restart(resting_state(), 0.1 * STATE_SCALE)
    belief._mean[STATE_SIZE : 2 * STATE_SIZE] = 1.0
    for _ in range(5):
        belief.predict()
    velocity = belief._mean[STATE_SIZE : 2 * STATE_SIZE]
    np.testing.assert_allclose(velocity, [*[1.0] * 8, np.exp(-1.0)])


def test_a_hidden_jaw_goes_with_the_other() -> None:
    """One jaw is seen to turn by 0.3 rad and the other is not seen: the opening changes by a small part of it."""
    belief = MotionBelief(STATE_SCALE, 1 / 30, ACCELERATION, VELOCITY, 0.02, 0.001, settling_s=SETTLING_S)
    start = resting_state()
    belief.restart(start, 0.01 * STATE_SCALE)
    seen = np.zeros(STATE_SIZE)  # the jaw at yaw - half
    seen[7], seen[8] = STATE_SCALE[7], -STATE_SCALE[8]
    for frame in range(30):
        belief.predict()
        place = start[7] - start[8] + 0.01 * (frame + 1)
        prior = belief.prior
        told = 1e6 * np.outer(seen, seen)
        off = place - (belief.state[7] - belief.state[8])
        step = np.linalg.solve(prior.information + told, 1e6 * seen * off)
        belief.update(belief.state + step * STATE_SCALE, NO_SHAPE, told)
    yaw, half = (belief.state - start)[7:]
    assert abs(yaw - half - 0.3) < 0.01
    assert abs(half) < 0.2 * yaw


# --- proposals


def test_proposals_keep_their_promises(camera: Camera) -> None:
    scene = scene_of(camera)
    state = resting_state()
    limits = scene.joint_limits
    states, moves = propose(state[None], 400, limits, False, np.random.default_rng(0))
    again, _ = propose(state[None], 400, limits, False, np.random.default_rng(0))
    np.testing.assert_array_equal(states, again)
    assert (limits.clip(states[:, None, JOINTS]) == states[:, None, JOINTS]).all()
    turned = states[moves == Move.TURN]
    assert (np.delete(turned, BETA, axis=1) == np.delete(state, BETA)).all()
    assert np.ptp(turned[:, BETA]) > 2.5
    jaw = states[moves == Move.JAW]
    stays = np.minimum(
        np.abs(jaw[:, 7] + jaw[:, 8] - state[7] - state[8]), np.abs(jaw[:, 7] - jaw[:, 8] - state[7] + state[8])
    )
    assert np.median(stays) < 0.15  # the spread of what is near
    assert np.ptp(jaw[:, 8]) > 0.7
    known, moves = propose(state[None], 60, limits, True, np.random.default_rng(0))
    assert (known[moves == Move.TURN][:, JOINTS] == state[JOINTS]).all()
    assert not np.isin(moves, [Move.JAW, Move.JOINTS, Move.BOTH]).any()


def test_of_what_is_drawn_anew_the_shaft_stays_on_its_line(camera: Camera) -> None:
    state, limits = resting_state(), scene_of(camera).joint_limits
    drawn = anew(state[None], 300, limits, np.random.default_rng(0))
    assert (drawn[:, [ALPHA, GAMMA]] == state[[ALPHA, GAMMA]]).all()
    assert (limits.clip(drawn[:, None, JOINTS]) == drawn[:, None, JOINTS]).all()
    off = drawn[:, POSITION] - state[POSITION]
    axis = look_at_rotation(state[ANGLES])[:, 2]
    np.testing.assert_allclose(off, (off @ axis)[:, None] * axis, atol=1e-12)
    assert np.ptp(drawn[:, BETA]) > 3.0
    assert (np.ptp(drawn[:, JOINTS], axis=0) > 0.9).all()


def test_with_two_arms_one_is_changed_at_a_time(camera: Camera) -> None:
    scene = scene_of(camera, arms=2)
    pair = np.concatenate([resting_state(), resting_state()])
    states, _ = propose(pair[None], 50, scene.joint_limits, False, np.random.default_rng(0))
    changed = (states.reshape(-1, 2, STATE_SIZE) != pair.reshape(2, STATE_SIZE)).any(axis=2)
    assert (changed.sum(axis=1) == 1).all()
    assert changed.any(axis=0).all()


def test_a_sweep_leaves_one_jaw_where_it_is(camera: Camera) -> None:
    scene = scene_of(camera, arms=2)
    pair = np.concatenate([resting_state(), resting_state()])
    swept = sweep_jaws(pair[None], scene.joint_limits).reshape(2, 2, SWEPT, 2, STATE_SIZE)
    own = resting_state()
    for arm in (0, 1):
        assert (swept[arm, :, :, 1 - arm] == own).all()
        for side, sign in ((0, -1), (1, 1)):
            jaws = swept[arm, side, :, arm]
            assert (jaws[:, :7] == own[:7]).all()
            np.testing.assert_allclose(jaws[:, 7] + sign * jaws[:, 8], own[7] + sign * own[8])
            assert np.ptp(jaws[:, 7] - sign * jaws[:, 8]) > 1.5


def test_every_kind_of_move_has_its_turn() -> None:
    moves = np.array([0, 0, 0, 1, 1, 2])
    losses = np.array([1.0, 2.0, 3.0, 50.0, 40.0, 60.0])
    assert list(best_of_each(losses, moves, 4)) == [0, 4, 5, 1]


def test_a_full_turn_is_no_jump_and_small_steps_cost_little() -> None:
    state = resting_state()
    turned = state.copy()
    turned[BETA] += 2 * np.pi
    assert jump_cost(turned, state) == pytest.approx(0.0, abs=1e-9)
    step = state + 0.3 * np.array([0.01, 0.05, 0.01, 1e-3, 1e-3, 1e-3, 0.05, 0.05, 0.05])
    other = state.copy()
    other[7], other[8] = 1.2, 0.6
    assert 0 < jump_cost(step, state) < 1 < jump_cost(other, state)


def test_a_lost_instrument_is_moved_to_the_mask(camera: Camera) -> None:
    scene, state = scene_of(camera), resting_state()
    evaluator = SilhouetteEvaluator(scene.instruments, camera)
    elsewhere = state.copy()
    elsewhere[3] += 0.03
    moved = shift_to_mask(elsewhere, evaluator.mask(elsewhere), evaluator.mask(state), camera)
    # Not all the way: the shaft is cut by the image's border, so that its centre is not a point of the instrument.
    assert np.linalg.norm(moved[3:6] - state[3:6]) < 0.6 * 0.03


# --- absences


def drawn_back(state: FloatArray, way_m: float) -> FloatArray:
    """The same state so far back along its shaft."""
    back = state.copy()
    back[POSITION] -= way_m * look_at_rotation(state[ANGLES])[:, 2]
    return back


def test_an_instrument_arrives_along_its_shaft(camera: Camera) -> None:
    """From out of the picture it is put in as far as the mask shows, whether that is a little or a lot."""
    scene, state = scene_of(camera), resting_state()
    evaluator = SilhouetteEvaluator(scene.instruments, camera)
    gone = drawn_back(state, 0.09)
    assert not evaluator.mask(gone).any()
    for way_m in (0.045, 0.02, 0.0):
        there = drawn_back(state, way_m)
        mask = evaluator.mask(there)
        assert mask.any()
        came = arrivals(gone, evaluator, mask)
        assert (np.delete(came, [3, 4, 5], axis=1) == np.delete(gone, [3, 4, 5])).all()
        assert np.linalg.norm(came[0, POSITION] - there[POSITION]) < 6e-3
        overlaps = evaluator.score(came, Reference(mask)).iou(Reference(mask))
        assert overlaps[0] > 0.7
        order = np.argsort(DISTANCES)
        assert (np.diff(came[order, 5]) > 0).all()  # nearer ones come out nearer


def test_it_is_found_again_only_where_enough_is_seen_that_fits() -> None:
    state = resting_state()
    away, little, much = 0.0, 0.004, 0.05
    kept = Whereabouts(np.zeros(STATE_SIZE))
    kept.note(state, much, lost=False, fits=True)
    assert not kept.lost
    np.testing.assert_array_equal(kept.sure, state)
    kept.note(state + 1, away, lost=True, fits=True)
    assert kept.lost
    assert kept.unseen
    assert kept.doubted
    kept.note(state + 2, little, lost=False, fits=True)
    assert kept.lost
    assert not kept.unseen
    np.testing.assert_array_equal(kept.sure, state)
    for _ in range(STEADY):
        assert kept.lost
        kept.note(state + 3, much, lost=False, fits=True)
    assert not kept.lost
    assert not kept.doubted
    np.testing.assert_array_equal(kept.sure, state + 3)


def test_what_never_fits_is_taken_for_all_that_there_is_in_the_end() -> None:
    """Else it would be looked for through all of a recording, whose masks are of another instrument."""
    kept = Whereabouts(resting_state())
    kept.note(resting_state(), 0.0, lost=True, fits=False)
    doubted = []
    for frame in range(PATIENCE + 10):
        kept.note(resting_state() + frame, 0.05, lost=False, fits=False)
        doubted.append(kept.doubted)
    assert doubted == [True] * PATIENCE + [False] * 10
    assert not kept.lost
    assert kept.sure[0] == resting_state()[0] + PATIENCE + 9


def test_a_belief_may_begin_anew_with_other_speeds(camera: Camera) -> None:
    """What arrives fast is followed at once, where one at rest would be held back."""
    far = resting_state()
    far[3] += 5e-3
    reached = []
    for speed in (None, 100.0 * STATE_SCALE):
        belief = MotionBelief(STATE_SCALE, 1 / 30, STATE_SCALE, STATE_SCALE, 0.02, 0.001)
        belief.restart(resting_state(), 0.1 * STATE_SCALE, speed)
        belief.predict()
        reached.append(np.sqrt(belief.covariance[3, 3]))
    assert reached[0] < 0.2 < 3.0 < reached[1]  # natural steps after a frame


# --- tracker


def motion(frames: int) -> FloatArray:
    """An instrument that turns, bends and opens, smoothly."""
    t = np.arange(frames)[:, None] / 30
    swing = np.array([0.03, 0.4, 0.03, 0.004, 0.004, 0.006, 0.3, 0.3, 0.15])
    phase = np.arange(STATE_SIZE)
    return np.asarray(resting_state() + swing * (np.sin(np.pi * t + phase) - np.sin(phase)), dtype=np.float64)


def follow(
    scene: Scene, states: FloatArray, start: FloatArray, masks: list[Mask] | None = None, seed: int = 0
) -> tuple[FloatArray, HybridTracker]:
    """Estimates of a fresh tracker; every frame's search begins at its own last estimate."""
    tracker = HybridTracker()
    tracker.reset(scene, start, np.random.default_rng(seed))
    estimates = [start]
    for index, state in enumerate(states):
        frame = observe(scene, state, index) if masks is None else seen(scene, masks[index], index)
        answer = tracker.step(replace(frame, start=estimates[-1].copy()))
        assert np.isfinite(answer.state).all()
        estimates.append(answer.state)
    return np.array(estimates[1:]), tracker


@pytest.mark.slow
def test_it_follows_to_tenths_of_a_millimetre(camera: Camera) -> None:
    scene, states = scene_of(camera), motion(25)
    estimates, _ = follow(scene, states, states[0])
    errors = [errors_of(scene, *pair) for pair in zip(estimates, states, strict=True)]
    assert np.mean([e["rotation_error_rad"] for e in errors]) < 0.005
    assert np.mean([e["tip_error_m"] for e in errors]) < 2e-4


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_a_jaw_in_the_mask_is_found_within_five_frames(camera: Camera, seed: int, side: float) -> None:
    """Of a number of states, each with one jaw taken to lie on the other, both plainly seen."""
    scene = scene_of(camera)
    rng, plain = np.random.default_rng(100 + seed), 0
    for _ in range(4):
        states = motion(5) + rng.normal(0, 1, STATE_SIZE) * [0.1, 0.3, 0.1, 2e-3, 2e-3, 5e-3, 0.2, 0.2, 0.0]
        slipped = states[0].copy()
        slipped[7], slipped[8] = slipped[7] + side * slipped[8], 0.0
        evaluator = SilhouetteEvaluator(scene.instruments, camera)
        masks = [evaluator.mask(state) for state in states]
        if judged(scene, slipped, masks[0]) < 0.5:  # edge-on, where the jaws lie on each other in the image
            continue
        plain += 1
        estimates, _ = follow(scene, states, slipped, masks, seed)
        errors = errors_of(scene, estimates[-1], states[-1])
        assert max(errors["q2_error_rad"], errors["q3_error_rad"]) < 0.05, (side, states[0])
    assert plain >= 2


@pytest.mark.slow
def test_it_finds_back_from_a_jaw_that_slipped(camera: Camera) -> None:
    """It begins with both jaws where only one is, which no small step mends."""
    scene, states = scene_of(camera), motion(15)
    slipped = states[0].copy()
    slipped[7], slipped[8] = slipped[7] - slipped[8], 0.0
    estimates, _ = follow(scene, states, slipped)
    assert errors_of(scene, estimates[-1], states[-1])["q3_error_rad"] < 0.02


def asked_of(scene: Scene, states: FloatArray, config: HybridTracker.Config) -> list[int]:
    """Frames in which a tracker that follows the true masks looks for tips; there are none to be found."""
    evaluator = SilhouetteEvaluator(scene.instruments, scene.views[0].camera)
    tracker, asked = HybridTracker(config), []
    tracker.reset(scene, states[0], np.random.default_rng(0))
    for index, state in enumerate(states):

        def look(frame: int = index) -> tuple[None]:
            asked.append(frame)
            return (None,)

        first = scene.views[0]
        view = View(first.camera, first.T_view_cam, evaluator.mask(state), found=FoundTips(look))
        tracker.step(Observation(index, index * scene.dt_s, (view,), start=state))
    return asked


@pytest.mark.slow
def test_tips_are_looked_for_at_the_start_and_where_the_jaws_are_known_badly(camera: Camera) -> None:
    scene, states = scene_of(camera), motion(12)
    assert asked_of(scene, states, HybridTracker.Config()) == [0]
    assert asked_of(scene, states, HybridTracker.Config(weak_jaws_rad=0)) == list(range(12))
    slipped = states.copy()
    slipped[6:, 7] += 0.9  # so that it searches
    assert 6 in asked_of(scene, slipped, HybridTracker.Config())


@pytest.mark.slow
def test_the_truth_lies_within_what_it_states(camera: Camera) -> None:
    """About as often as Gaussian numbers do, neither far less often nor always."""
    scene, states = scene_of(camera), motion(30)
    tracker = HybridTracker()
    tracker.reset(scene, states[0], np.random.default_rng(0))
    answers = [tracker.step(replace(observe(scene, state, index), start=state)) for index, state in enumerate(states)]
    stated = np.array([answer.standard_deviations for answer in answers])
    off = np.abs(np.array([answer.state for answer in answers]) - states)
    assert (off < 1.645 * stated).mean() > 0.75
    assert (stated < 0.05).all()


def test_it_waits_while_nothing_is_seen(camera: Camera) -> None:
    scene, states = scene_of(camera), motion(16)
    evaluator = SilhouetteEvaluator(scene.instruments, camera)
    masks = [evaluator.mask(state) for state in states]
    masks[6:9] = [np.zeros_like(masks[0]), np.ones_like(masks[0]), np.zeros_like(masks[0])]
    estimates, _ = follow(scene, states, states[0], masks)
    assert errors_of(scene, estimates[-1], states[-1])["tip_error_m"] < 1e-3


def absence(moved: FloatArray) -> FloatArray:
    """In the picture, drawn back within 25 frames, away for 20, turned and displaced meanwhile, and put in again."""
    ease = 0.5 - 0.5 * np.cos(np.pi * np.arange(25) / 24)
    ways = 0.09 * np.concatenate([np.zeros(5), ease, np.ones(15), ease[::-1], np.zeros(5)])
    shares = np.clip((np.arange(len(ways)) - 29) / 15, 0.0, 1.0)
    return np.array([drawn_back(resting_state() + share * moved, way) for share, way in zip(shares, ways, strict=True)])


MOVED = [
    np.zeros(STATE_SIZE),
    np.array([0.08, 0.5, -0.05, 0.004, -0.004, 0.015, 0.3, -0.2, 0.1]),
    np.array([-0.05, -0.5, 0.08, -0.005, 0.005, -0.012, -0.3, 0.3, -0.1]),
]


@pytest.mark.slow
# Of the third absence seed 1 stops where the belief knows nothing yet of how fast the instrument comes in.
@pytest.mark.parametrize("moved", MOVED)
@pytest.mark.parametrize("seed", range(3))
def test_an_instrument_that_comes_back_is_found_within_six_frames(camera: Camera, moved: FloatArray, seed: int) -> None:
    scene, states = scene_of(camera), absence(moved)
    evaluator = SilhouetteEvaluator(scene.instruments, camera)
    masks = [evaluator.mask(state) for state in states]
    away = np.array([mask.mean() < OUT_OF_VIEW_SHARE for mask in masks])
    assert 20 <= away.sum() <= 35
    tracker, estimates, lost = HybridTracker(), [states[0]], []
    tracker.reset(scene, states[0], np.random.default_rng(seed))
    for index, mask in enumerate(masks):
        answer = tracker.step(replace(seen(scene, mask, index), start=estimates[-1].copy()))
        estimates.append(answer.state)
        lost.append(answer.lost)
    back = int(np.flatnonzero(away)[-1]) + 1
    errors = [errors_of(scene, *pair) for pair in zip(estimates[1:], states, strict=True)]
    assert min(e["tip_error_m"] for e in errors[back : back + 7]) < RECOVERED_M
    # It says so while nothing is seen, and not for long after.
    assert np.mean(np.array(lost)[away]) > 0.95
    assert np.count_nonzero(np.array(lost)[~away]) <= 4
    assert errors[-1]["rotation_error_rad"] < 0.02
    assert errors[-1]["tip_error_m"] < 1e-3


@pytest.mark.slow
def test_two_arms_in_one_mask(camera: Camera) -> None:
    scene = scene_of(camera, arms=2)
    left = motion(8)
    right = left.copy()
    right[:, 2], right[:, 3], right[:, 1] = -right[:, 2], right[:, 3] + 0.035, right[:, 1] + 1.0
    states = np.concatenate([left, right], axis=1)
    estimates, _ = follow(scene, states, states[0])
    one = scene_of(camera)
    for arm in (slice(0, 9), slice(9, 18)):
        assert errors_of(one, estimates[-1, arm], states[-1, arm])["tip_error_m"] < 1e-3


@pytest.mark.slow
def test_same_seed_same_estimates_also_after_a_journey(camera: Camera) -> None:
    """A tracker that is pickled in the middle goes on as the one that stayed."""
    scene, states = scene_of(camera), motion(6)
    slipped = states[0].copy()
    slipped[7], slipped[8] = slipped[7] - slipped[8], 0.0  # so that it searches, which is where chance comes in
    one, stayed = follow(scene, states[:3], slipped)
    two, _ = follow(scene, states[:3], slipped)
    np.testing.assert_array_equal(one, two)
    travelled: HybridTracker = pickle.loads(pickle.dumps(stayed))
    for index in range(3, 6):
        frame = replace(observe(scene, states[index], index), start=one[-1])
        np.testing.assert_array_equal(stayed.step(frame).state, travelled.step(frame).state)
