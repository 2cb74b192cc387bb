"""Two arms: scored against one mask or each against its own, searched together or separately, hidden and lost."""

from __future__ import annotations

import pickle
from dataclasses import replace
from typing import Any, Literal

import numpy as np
import pytest
from support import observe, resting_state, scene_of

from surgbench.camera import Camera
from surgbench.contract import Observation, Scene, Trace
from surgbench.errors import SurgbenchError
from surgbench.geometry import FloatArray
from surgbench.objective import LossWeights, Objective
from surgbench.pair_objective import PairObjective
from surgbench.search.arms import fit_of_arms
from surgbench.silhouette import VisibilityEvaluator
from surgbench.state import split_arms
from surgbench.trackers.adam import AdamTracker
from surgbench.trackers.cmaes import CmaesTracker
from surgbench.trackers.optimisers.cma import CMA
from surgbench.trackers.optimisers.cma_settings import released_settings
from surgbench.trackers.optimisers.normals import SobolNormals
from surgbench.trackers.pycma import PycmaTracker
from surgbench.trackers.xnes import XnesTracker

MASKS_ALONE = LossWeights(keypoints=0.0)
STEP = np.tile([0.01, 0.05, 0.01, 1e-3, -1e-3, 1e-3, 0.05, 0.05, 0.02], 2)


def crossing(behind_m: float = 0.01) -> FloatArray:
    """Two shafts that cross, the right one behind the left one."""
    left, right = resting_state(), resting_state(0.13 + behind_m)
    left[2], right[2] = 0.8, -0.8
    right[3:5] = 0.004, 0.006
    return np.concatenate([left, right])


def apart() -> FloatArray:
    """Two arms side by side."""
    state = crossing()
    state[[3, 12]] = -0.02, 0.025
    return state


def told(scene: Scene, state: FloatArray, swap: bool = False, start: FloatArray | None = None) -> Observation:
    """A frame with a mask for each arm, perhaps under the other's name."""
    frame = observe(scene, state)
    alone = tuple(VisibilityEvaluator(scene.instruments, scene.views[0].camera).visible_masks(state))
    view = replace(frame.views[0], instance_masks=alone[::-1] if swap else alone)
    return replace(frame, views=(view,), start=(state if start is None else start).copy())


def test_without_masks_of_single_arms_the_loss_is_that_of_both(small_camera: Camera) -> None:
    scene = scene_of(small_camera, arms=2)
    pair, both = PairObjective(scene, LossWeights()), Objective(scene, LossWeights())
    states = crossing() + np.random.default_rng(0).normal(0, 1, (5, 18)) * STEP
    for objective in (pair, both):
        objective.observe(observe(scene, crossing()))
    for one, other in zip(pair(states), both(states), strict=True):
        np.testing.assert_array_equal(one, other)
    with pytest.raises(SurgbenchError, match="--masks instances"):
        pair.arms(states)


@pytest.mark.parametrize("swap", [False, True])
def test_each_arm_is_held_against_what_its_own_mask_shows(small_camera: Camera, swap: bool) -> None:
    """Eq. 6 for each arm, from the visible masks themselves; masks under the other's name are put right."""
    scene, truth = scene_of(small_camera, arms=2), crossing()
    tips = tuple(small_camera.project(scene.instruments[0].tips_cam(arm)) for arm in split_arms(truth))
    frame = told(scene, truth, swap, start=truth + 0.2 * STEP)
    frame = replace(frame, views=(replace(frame.views[0], keypoints=tips),))
    visibility = VisibilityEvaluator(scene.instruments, small_camera)
    states = truth + np.random.default_rng(1).normal(0, 1, (6, 18)) * STEP
    objective, tips_only = PairObjective(scene, LossWeights()), Objective(scene, LossWeights())
    objective.observe(frame)
    tips_only.observe(frame)
    assert objective.turned == swap
    losses, overlaps = objective.arms(states)
    masks = visibility.visible_masks(truth)
    for loss, overlap, state in zip(losses, overlaps, states, strict=True):
        seen = visibility.visible_masks(state)
        for arm in range(2):
            difference = int(seen[arm].sum()) - int(masks[arm].sum())
            eq_6 = (seen[arm] ^ masks[arm]).sum() + LossWeights().appearance * abs(difference)
            eq_8 = tips_only.views[0].keypoints(state[None])[arm][0]
            assert loss[arm] == pytest.approx(eq_6 + eq_8, rel=1e-12)
            assert overlap[arm] == (seen[arm] & masks[arm]).sum() / (seen[arm] | masks[arm]).sum()
    both = Objective(scene, LossWeights())
    both.observe(frame)
    np.testing.assert_array_equal(objective(states)[0], both(states)[0])  # eq. 15, whatever else there is


def test_separate_searches_are_two_of_one_arm_each_ranked_by_its_own(small_camera: Camera) -> None:
    """Written down again: two searches draw in turn, are told their own losses, and the best of each is kept."""
    scene, truth = scene_of(small_camera, arms=2), crossing()
    frame = told(scene, truth, start=truth + STEP)
    tracker = CmaesTracker(CmaesTracker.Config(dual="separate", loss=MASKS_ALONE))
    tracker.reset(scene, frame.start, np.random.default_rng(3))
    estimate = tracker.step(frame)
    objective, space = PairObjective(scene, MASKS_ALONE), tracker._spaces.of(frame)
    objective.observe(frame)
    rng = np.random.default_rng(3)
    SobolNormals(18, rng)  # of the search of both
    normals = SobolNormals(9, rng)
    settings = released_settings(9, 70)
    searches = [CMA(start, 1.0, 70, settings=settings) for start in split_arms(space.encode(frame.start))]
    least, best = [np.inf, np.inf], np.zeros((2, 9))
    for _ in range(3):
        asked = [search.ask(normals.take(70)) for search in searches]
        states = space.decode(np.hstack(asked))
        losses, _ = objective.arms(states)
        for arm, search in enumerate(searches):
            search.tell(asked[arm], losses[:, arm])
            first = int(np.argmin(losses[:, arm]))
            if losses[first, arm] < least[arm]:
                least[arm], best[arm] = losses[first, arm], split_arms(states)[first, arm]
    np.testing.assert_array_equal(estimate.state, best.ravel())


def test_the_released_mistake_gives_a_sample_the_weight_of_the_sample_that_its_number_names() -> None:
    """``weights[argsort(losses)]``: written down again for one generation, the mean goes where such weights say."""
    losses = np.random.default_rng(0).permutation(70).astype(np.float64)
    normals = np.random.default_rng(1).standard_normal((70, 9))
    raw = np.log(35.5) - np.log(np.arange(1, 71))
    weights = raw / raw[:35].sum()
    assigned = weights[np.argsort(losses)]
    top = np.argsort(-assigned)[:15]
    search = CMA(np.zeros(9), 0.5, 70, settings=released_settings(9, 70))
    tracker = CmaesTracker(CmaesTracker.Config(released_ranks=True))
    tracker._prepare(2, np.random.default_rng(0))
    theirs: Any = tracker._search(np.zeros(9))
    theirs.tell(theirs._cma.ask(normals), losses)
    np.testing.assert_allclose(theirs._cma.mean, 2.0 * assigned[top] @ normals[top], rtol=1e-12)
    search.tell(search.ask(normals), losses)
    assert np.abs(search.mean / 0.5 - theirs._cma.mean).max() > 0.1
    both: Any = tracker._search(np.zeros(18))
    assert not both._mistaken


@pytest.mark.parametrize("dual", ["joint", "separate"])
def test_masks_of_single_arms_bring_both_arms_nearer(camera: Camera, dual: Literal["joint", "separate"]) -> None:
    scene, truth = scene_of(camera, arms=2), crossing()
    frame = told(scene, truth, start=truth + STEP)
    tracker = CmaesTracker(CmaesTracker.Config(dual=dual, iterations=6, loss=MASKS_ALONE))
    tracker.reset(scene, frame.start, np.random.default_rng(0))
    estimate = tracker.step(frame)
    objective = PairObjective(scene, MASKS_ALONE)
    objective.observe(frame)
    before, after = objective.arms(np.stack([frame.start, estimate.state]))[1]
    assert (after > before).all()
    assert (after > 0.85).all()
    assert not np.any(estimate.lost)


def test_the_released_descent_has_the_right_arm_where_the_left_one_fits_best(camera: Camera) -> None:
    scene, truth = scene_of(camera, arms=2), crossing()
    # The left arm begins where it is, and every step takes it away; the right one does not.
    start = truth + np.concatenate([np.zeros(9), STEP[9:]])
    frame = told(scene, truth, start=start)
    objective = PairObjective(scene, MASKS_ALONE)
    objective.observe(frame)
    found = {}
    for released in (False, True):
        tracker = AdamTracker(AdamTracker.Config(released_iterate=released, loss=MASKS_ALONE))
        tracker.trace = Trace()
        tracker.reset(scene, start, np.random.default_rng(0))
        found[released] = tracker.step(frame).state
        way = np.concatenate(tracker.trace.states)
        left = int(np.argmin(objective.arms(way)[0][:, 0]))
        assert np.array_equal(found[released], way[left]) == released
    losses = objective.arms(np.stack([found[False], found[True]]))[0]
    assert losses[0, 1] < losses[1, 1]
    without = replace(frame, views=(replace(frame.views[0], instance_masks=None),))
    assert np.array_equal(tracker.step(without).state, found[False])  # there is no left one alone
    assert "released_iterate" not in AdamTracker.Config().model_dump()  # hashes of other runs do not know of it
    assert AdamTracker.Config(released_iterate=True).model_dump()["released_iterate"] is True


@pytest.mark.parametrize("second", ["same", "nearly", "nothing"])
def test_masks_that_are_the_same_for_both_arms_tell_nothing_apart(small_camera: Camera, second: str) -> None:
    """A separate search, too, goes on with one mask of both; it does not end the run."""
    scene, truth = scene_of(small_camera, arms=2), crossing()
    frame = told(scene, truth, start=truth + STEP)
    one = frame.views[0].mask & (second != "nothing")
    other = one.copy()
    if second == "nearly":
        other[tuple(np.argwhere(one)[0])] = False
    view = replace(frame.views[0], instance_masks=(one, other))
    assert view.told_apart is None
    frame = replace(frame, views=(view,))
    pair, both = PairObjective(scene, MASKS_ALONE), Objective(scene, MASKS_ALONE)
    for objective in (pair, both):
        objective.observe(frame)
    assert not pair.tells_apart
    states = np.stack([truth, truth + STEP])
    np.testing.assert_array_equal(pair.arms(states)[0], np.stack([both(states)[0]] * 2, axis=1))
    tracker = CmaesTracker(CmaesTracker.Config(dual="separate"))
    tracker.reset(scene, frame.start, np.random.default_rng(0))
    assert np.isfinite(tracker.step(frame).state).all()


def test_separate_searches_need_a_mask_for_each_arm(small_camera: Camera) -> None:
    scene = scene_of(small_camera, arms=2)
    tracker = CmaesTracker(CmaesTracker.Config(dual="separate"))
    tracker.reset(scene, crossing(), np.random.default_rng(0))
    with pytest.raises(SurgbenchError, match="--masks instances"):
        tracker.step(observe(scene, crossing()))


# --- how sure of each


@pytest.mark.parametrize("with_masks", [False, True])
def test_the_arm_that_is_elsewhere_is_the_one_that_is_lost(camera: Camera, with_masks: bool) -> None:
    scene, truth = scene_of(camera, arms=2), apart()
    frame = told(scene, truth) if with_masks else observe(scene, truth)
    objective = PairObjective(scene, MASKS_ALONE)
    objective.observe(frame)
    np.testing.assert_array_equal(fit_of_arms(objective, truth).overlap, [1.0, 1.0])
    for arm in range(2):
        wrong = truth.copy()
        split_arms(wrong)[arm, 4] += 0.03
        fit = fit_of_arms(objective, wrong)
        assert fit.confidence[arm] <= fit.overlap[arm] < 0.5 < fit.overlap[1 - arm]
        assert not fit.hidden.any()


@pytest.mark.parametrize("with_masks", [False, True])
def test_jaws_that_are_elsewhere_are_doubted_though_the_shaft_overlaps(camera: Camera, with_masks: bool) -> None:
    scene, truth = scene_of(camera, arms=2), np.tile(resting_state(), 2)
    truth[[3, 12]] = -0.02, 0.02
    frame = told(scene, truth) if with_masks else observe(scene, truth)
    objective = PairObjective(scene, MASKS_ALONE)
    objective.observe(frame)
    for arm in range(2):
        wrong = truth.copy()
        split_arms(wrong)[arm, 6:8] += 1.0
        fit = fit_of_arms(objective, wrong)
        assert fit.overlap[arm] > 0.6
        assert fit.confidence[arm] < 0.5 < fit.confidence[1 - arm]


@pytest.mark.parametrize("with_masks", [False, True])
def test_an_arm_behind_the_other_is_hidden(camera: Camera, with_masks: bool) -> None:
    scene, truth = scene_of(camera, arms=2), np.tile(resting_state(), 2)
    truth[9:] = [*resting_state()[:3], 0, 0, 0.14, *resting_state()[6:]]
    frame = told(scene, truth) if with_masks else observe(scene, truth)
    objective = PairObjective(scene, MASKS_ALONE)
    objective.observe(frame)
    fit = fit_of_arms(objective, truth)
    assert fit.hidden.tolist() == [False, True]
    assert fit.confidence[0] > 0.9
    assert fit.confidence[1] == 0.0


@pytest.mark.parametrize("make", [CmaesTracker, XnesTracker, PycmaTracker])
def test_masks_of_single_arms_are_used_where_they_are(make: Any, small_camera: Camera) -> None:
    scene, truth = scene_of(small_camera, arms=2), crossing()
    frame = told(scene, truth, start=truth + STEP)

    def estimate(dual: str, frame: Observation) -> FloatArray:
        tracker = make(make.Config(dual=dual))
        tracker.reset(scene, frame.start, np.random.default_rng(0))
        state: FloatArray = tracker.step(frame).state
        return state

    union = replace(frame, views=(replace(frame.views[0], instance_masks=None),))
    np.testing.assert_array_equal(estimate("auto", frame), estimate("separate", frame))
    np.testing.assert_array_equal(estimate("auto", union), estimate("joint", frame))


@pytest.mark.parametrize("make", [CmaesTracker, XnesTracker, PycmaTracker, AdamTracker])
def test_trackers_say_it_of_each_arm(make: Any, small_camera: Camera) -> None:
    """The right arm has gone from both masks; what it is said to be is finite, and lost."""
    scene, truth = scene_of(small_camera, arms=2), apart()
    frame, empty = told(scene, truth), np.zeros((small_camera.height, small_camera.width), dtype=bool)
    alone = (frame.views[0].instance_masks or ())[0]
    frame = replace(frame, views=(replace(frame.views[0], mask=alone, instance_masks=(alone, empty)),))
    tracker = make()
    tracker.reset(scene, frame.start, np.random.default_rng(0))
    estimate = pickle.loads(pickle.dumps(tracker)).step(frame)
    assert np.isfinite(estimate.state).all()
    assert estimate.lost.tolist() == [False, True]
    assert estimate.confidence[1] < 0.5 < estimate.confidence[0]
