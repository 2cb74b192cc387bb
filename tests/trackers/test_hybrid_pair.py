"""The tracker `hybrid` with two arms: what each is held against, arms that cross, and masks that confuse them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from support import resting_state, scene_of

from surgbench.camera import Camera
from surgbench.contract import Mask, Observation, Scene
from surgbench.geometry import FloatArray, look_at_rotation
from surgbench.metrics import pose_errors
from surgbench.objective import LossWeights
from surgbench.silhouette import SilhouetteEvaluator, VisibilityEvaluator
from surgbench.state import ALPHA, ANGLES, GAMMA, JOINTS, POSITION, STATE_SIZE
from surgbench.trackers.hybrid import HybridTracker
from surgbench.trackers.registration.cut import Cutter
from surgbench.trackers.registration.order import Order
from surgbench.trackers.registration.part import PartObjective, PartView
from surgbench.trackers.registration.screen import Screen

IN, HIDDEN, OUT = 16, 20, 16  # frames of a crossing
LEAD = 4


def apart() -> FloatArray:
    """One arm from the left and one from the right, which do not overlap."""
    left, right = resting_state(), resting_state(0.145)
    left[POSITION.start] -= 0.01
    right[GAMMA], right[ALPHA], right[POSITION.start] = -0.8, 0.1, 0.035
    right[POSITION.start + 1] = -0.012
    return np.stack([left, right])


def behind(front: FloatArray, other: FloatArray) -> FloatArray:
    """The other arm with its wrist and jaws behind the shaft of the first, which it meets head-on."""
    axis = look_at_rotation(front[ANGLES])[:, 2]
    own = np.array([-axis[0], -axis[1], -0.3 * axis[2]])
    own /= np.linalg.norm(own)
    state = other.copy()
    state[ALPHA], state[GAMMA] = -np.arcsin(own[1]), np.arctan2(own[0], own[2])
    place = front[POSITION] - 0.004 * axis
    state[POSITION] = place * (1.0 + 0.013 / place[2])
    state[JOINTS] *= 0.3
    return state


def crossing() -> FloatArray:
    """``(frames, 18)``: the right arm goes behind the left one's shaft, stays, and comes back; both move a little."""
    ease = 0.5 - 0.5 * np.cos(np.pi * np.arange(1, IN + 1) / (IN + 1))
    ways = np.concatenate([np.zeros(LEAD), ease, np.ones(HIDDEN), ease[::-1], np.zeros(5 * LEAD)])
    left, right = apart()
    states = []
    for frame, way in enumerate(ways):
        own = left.copy()
        own[POSITION] += 2e-3 * np.sin(frame / 12 + np.arange(3))
        own[JOINTS] += 0.1 * np.sin(frame / 15)
        other = right.copy()
        other[ANGLES] += 0.05 * np.sin(frame / 14)
        states.append(np.concatenate([own, (1.0 - way) * other + way * behind(own, other)]))
    return np.array(states)


def follow(
    scene: Scene,
    visible: NDArray[np.bool_],
    states: FloatArray,
    *,
    instances: bool = False,
    swapped: NDArray[np.bool_] | None = None,
) -> tuple[FloatArray, NDArray[np.bool_], FloatArray]:
    """Estimates, lost flags and confidences of a fresh tracker that is shown ``(frames, 2, H, W)`` masks."""
    tracker = HybridTracker()
    tracker.reset(scene, states[0], np.random.default_rng(0))
    start, answers = states[0], []
    for frame, masks in enumerate(visible):
        told: tuple[Mask, ...] | None = tuple(masks) if instances else None
        if told is not None and swapped is not None and swapped[frame]:
            told = told[::-1]
        view = replace(scene.views[0], mask=masks.any(axis=0), instance_masks=told)
        answers.append(tracker.step(Observation(frame, frame * scene.dt_s, (view,), start=start)))
        start = answers[-1].state
        assert np.isfinite(start).all()
    return (
        np.array([answer.state for answer in answers]),
        np.array([answer.lost for answer in answers]),
        np.array([answer.confidence for answer in answers]),
    )


def tips_off_m(scene: Scene, estimates: FloatArray, states: FloatArray) -> FloatArray:
    """``(frames, 2)``."""
    arms = [slice(STATE_SIZE * arm, STATE_SIZE * (arm + 1)) for arm in range(2)]
    camera = scene.views[0].camera
    return np.stack(
        [pose_errors(scene.instruments[0], camera, estimates[:, arm], states[:, arm])["tip_error_m"] for arm in arms],
        axis=1,
    )


@pytest.fixture(scope="module")
def crossed() -> tuple[Scene, FloatArray, NDArray[np.bool_]]:
    """A scene, true states, and what is visible of each arm."""
    camera = Camera(width=700, height=493, fx=905.955, fy=904.820, cx=294.280, cy=238.699)
    scene, states = scene_of(camera, arms=2), crossing()
    visibility = VisibilityEvaluator(scene.instruments, camera)
    return scene, states, np.stack([visibility.visible_masks(state) for state in states])


@pytest.mark.slow
@pytest.mark.parametrize("instances", [False, True])
def test_a_crossing_is_survived(crossed: tuple[Scene, FloatArray, NDArray[np.bool_]], instances: bool) -> None:
    """Both come out as who they are; the arm in front stays right, the hidden one says that it is not known well."""
    scene, states, visible = crossed
    estimates, lost, confidence = follow(scene, visible, states, instances=instances)
    off = tips_off_m(scene, estimates, states)
    hidden = slice(LEAD + IN, LEAD + IN + HIDDEN)
    assert (off[-LEAD:] < 2e-3).all()
    assert not lost[-LEAD:].any()
    assert np.median(off[hidden, 0]) < 1e-3
    # The outlines of both together do not show all of it.
    assert lost[:, 0].mean() <= (0.0 if instances else 0.2)
    assert ((off[:, 1] < 5e-3) | lost[:, 1])[hidden].mean() > 0.9
    assert lost[LEAD + IN + HIDDEN - 1, 1]
    wrong = off > 0.01
    assert (lost | (confidence < 0.5))[wrong].all()


@pytest.mark.slow
def test_exchanged_masks_are_exchanged_back(crossed: tuple[Scene, FloatArray, NDArray[np.bool_]]) -> None:
    """In some frames, the crossing included, or in all of them: nothing becomes different."""
    scene, states, visible = crossed
    plain, *_ = follow(scene, visible, states, instances=True)
    some = np.zeros(len(states), dtype=bool)
    some[[2, 3, 8, 9, LEAD + IN + 3, LEAD + IN + 4, LEAD + IN + HIDDEN + 5, -2]] = True
    for swapped in (some, np.ones(len(states), dtype=bool)):
        np.testing.assert_array_equal(follow(scene, visible, states, instances=True, swapped=swapped)[0], plain)


@pytest.mark.slow
def test_masks_that_tell_nothing_are_not_listened_to(crossed: tuple[Scene, FloatArray, NDArray[np.bool_]]) -> None:
    """Two that are the same are no more than the union; of one alone the rest of the union is the other's."""
    scene, states, visible = (crossed[0], crossed[1][: LEAD + 4], crossed[2][: LEAD + 4])
    union: NDArray[np.bool_] = np.asarray(visible.any(axis=1))
    same = np.stack([union, union], axis=1)
    np.testing.assert_array_equal(follow(scene, same, states, instances=True)[0], follow(scene, visible, states)[0])
    tracker = HybridTracker()
    tracker.reset(scene, states[0], np.random.default_rng(0))
    for frame in range(len(visible)):
        one = visible[frame, 0]
        view = replace(scene.views[0], mask=union[frame], instance_masks=(one, np.zeros_like(one)))
        answer = tracker.step(Observation(frame, frame * scene.dt_s, (view,), start=states[0]))
    assert not np.asarray(answer.lost).any()
    assert (tips_off_m(scene, answer.state[None], states[-1:]) < 1e-3).all()


@pytest.mark.slow
def test_an_arm_that_never_shows_is_lost(crossed: tuple[Scene, FloatArray, NDArray[np.bool_]]) -> None:
    scene, states, _ = crossed
    states = states[:12].copy()
    states[:, STATE_SIZE + POSITION.start] += 0.5
    evaluator = SilhouetteEvaluator(scene.instruments[:1], scene.views[0].camera)
    visible = np.stack([[evaluator.mask(state[:STATE_SIZE])] * 2 for state in states])
    visible[:, 1] = False
    for instances in (False, True):
        estimates, lost, _ = follow(scene, visible, states, instances=instances)
        assert lost[:, 1].all()
        assert not lost[:, 0].any()
        assert tips_off_m(scene, estimates, states)[-1, 0] < 1e-3


def test_the_nearer_arm_is_seen_whole_and_hides_the_other(
    camera: Camera, crossed: tuple[Scene, FloatArray, NDArray[np.bool_]]
) -> None:
    """By what is seen, and where that is silent by the expected depths; of arms that are lost neither is known."""
    scene, states, visible = crossed
    frame = LEAD + IN + 5
    own = states[frame].reshape(2, STATE_SIZE)
    alone = SilhouetteEvaluator(scene.instruments[:1], camera)
    silhouettes = [alone.mask(state) for state in own]
    meet = silhouettes[0] & silhouettes[1]
    assert np.count_nonzero(meet & visible[frame, 0]) > 0.9 * np.count_nonzero(meet)
    hides = [mask.copy() for mask in visible[frame]]
    Order(camera).clear(hides, visible[frame], silhouettes, own, (False, False))
    assert hides[0][meet].mean() > 0.9
    assert np.count_nonzero(hides[1] & silhouettes[0]) < 0.02 * np.count_nonzero(meet)
    silent = [mask.copy() for mask in silhouettes]
    Order(camera).clear(silent, np.zeros_like(visible[frame]), silhouettes, own, (False, False))
    assert silent[0][meet].mean() > 0.9
    assert silent[1][meet].mean() < 0.1
    untouched = [mask.copy() for mask in silhouettes]
    Order(camera).clear(untouched, visible[frame], silhouettes, own, (True, True))
    assert all((one == other).all() for one, other in zip(untouched, silhouettes, strict=True))


def test_what_is_hidden_counts_neither_way(crossed: tuple[Scene, FloatArray, NDArray[np.bool_]]) -> None:
    """The loss of the right state is next to nothing, whichever part of it the other arm covers."""
    scene, states, visible = crossed
    frame = LEAD + IN + 5
    one = replace(scene, instruments=scene.instruments[:1], limits=scene.limits[:1], arms=1)
    own = states[frame].reshape(2, STATE_SIZE)
    for instances in (None, tuple(visible[frame])):
        view = replace(scene.views[0], mask=visible[frame].any(axis=0), instance_masks=instances)
        for part, state in zip(Cutter(scene, 0)(view, own, (False, False)), own, strict=True):
            assert isinstance(part, PartView)
            assert not (part.mask & part.hidden).any()
            objective = PartObjective(one, LossWeights())
            objective.observe(Observation(frame, 0.0, (part,), start=state))
            loss, overlap = objective.mismatch(state[None])
            assert loss[0] < 30
            assert overlap[0] > 0.98


def test_a_large_piece_that_nothing_shows_of_is_hidden(crossed: tuple[Scene, FloatArray, NDArray[np.bool_]]) -> None:
    """Not before a frame did not fit, not where the arm may have moved, and not a sliver; until all of it is seen."""
    scene, states, _ = crossed
    silhouette = SilhouetteEvaluator(scene.instruments[:1], scene.views[0].camera).mask(states[0, :STATE_SIZE])
    columns = np.flatnonzero(silhouette.any(axis=0))
    nothing, cut, sliver = np.zeros_like(silhouette), silhouette.copy(), silhouette.copy()
    cut[:, columns[-70] :] = False
    sliver[:, columns[-4] :] = False
    screen = Screen()
    assert not screen(silhouette, cut, nothing, cut, unfit=False).any()
    assert not screen(silhouette, sliver, nothing, sliver, unfit=True).any()
    moved = np.roll(silhouette, 25, axis=0)
    assert not screen(silhouette, moved, nothing, moved, unfit=True).any()
    for unfit in (True, False):
        hidden = screen(silhouette, cut, nothing, cut, unfit=unfit)
        assert hidden[silhouette & ~cut].mean() > 0.7  # tips are narrower
        assert hidden[cut].mean() < 0.02
    assert not screen(silhouette, silhouette, nothing, silhouette, unfit=False).any()
    assert not screen(silhouette, cut, nothing, cut, unfit=False).any()


@pytest.mark.slow
def test_tissue_before_the_jaws_ends_no_arm(crossed: tuple[Scene, FloatArray, NDArray[np.bool_]]) -> None:
    """The arm stays where its shaft and its motion have it, and says that it isn't known when that is long ago."""
    scene, states, visible = crossed
    states, shown = np.repeat(states[:1], 30, axis=0), np.repeat(visible[:1], 30, axis=0)
    wrist = scene.views[0].camera.project(states[0, POSITION])
    columns = np.arange(shown.shape[-1])
    for frame in range(6, 22):  # over the right end, further and further
        shown[frame, 0, :, columns > wrist[0] + 50 - 5 * min(frame - 6, 9)] = False
    estimates, lost, confidence = follow(scene, shown, states, instances=True)
    off = tips_off_m(scene, estimates, states)
    assert ((off[:, 0] < 5e-3) | lost[:, 0]).all()
    assert (off[-4:] < 1e-3).all()
    assert (confidence[18:22, 0] < confidence[:6, 0].min()).all()
