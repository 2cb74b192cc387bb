"""Checks of what a tracker is given: masks of all kinds, things that are missing, one arm or two."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from surgbench.conformance.subject import Alive, CheckFailedError, Subject
from surgbench.contract import Mask, Observation, Scene
from surgbench.errors import SurgbenchError
from surgbench.randomness import generator
from surgbench.silhouette import Reference
from surgbench.state import POSITION, split_arms
from surgbench.tasks.instrument.conformance.scenes import CAMERA, Play, evaluator, play_of
from surgbench.tasks.instrument.conformance.session import Session, run_through

# From this frame on one of two arms is gone.
GONE = 3


def _all_pixels(value: bool) -> Mask:
    return np.full((CAMERA.height, CAMERA.width), value)


def empty_masks(subject: Subject, alive: Alive) -> str:
    """Masks without any instrument, and no tips."""
    return _masked(subject, alive, False)


def full_masks(subject: Subject, alive: Alive) -> str:
    """Masks that are instrument all over, and no tips."""
    return _masked(subject, alive, True)


def _masked(subject: Subject, alive: Alive, value: bool) -> str:
    play = play_of(subject)
    masks = {frame.index: _all_pixels(value) for frame in play.observations}
    steps = run_through(subject.make(), play.with_masks(masks), alive)
    return f"says that it is lost in {sum(step.lost.any() for step in steps)} of {len(steps)} frames"


def lost_and_found(subject: Subject, alive: Alive) -> str:
    """The instrument is gone for three frames and comes back."""
    play = play_of(subject, frames=10)
    gone = range(3, 6)
    steps = run_through(subject.make(), play.with_masks({index: _all_pixels(False) for index in gone}), alive)
    reference = Reference(play.observations[-1].mask)
    overlap = float(evaluator(1).score(steps[-1].state[None], reference).iou(reference)[0])
    said = sum(steps[index].lost.any() for index in gone)
    return f"says so in {said} of 3 frames; overlap {overlap:.2f} some frames after"


def no_keypoints(subject: Subject, alive: Alive) -> str:
    """No tips at all, tips in every other frame, and one tip of each arm."""
    run_through(subject.make(), play_of(subject, keypoints=False), alive)
    play = play_of(subject)
    none = {frame.index: frame.mask for frame in play.observations[1::2]}
    run_through(subject.make(), play.with_masks(none), alive)
    single = [_with_one_tip(frame) for frame in play.observations]
    run_through(subject.make(), replace(play, observations=tuple(single)), alive)
    return ""


def _with_one_tip(frame: Observation) -> Observation:
    view = frame.views[0]
    one = tuple(None if tips is None else tips[frame.index % len(tips)][None] for tips in view.tips)
    return replace(frame, views=(replace(view, keypoints=one), *frame.views[1:]))


def readings(subject: Subject, alive: Alive) -> str:
    """Joint readings in all frames, and in every other one."""
    return _with_and_without(subject, play_of(subject, readings=True), alive)


def kinematics(subject: Subject, alive: Alive) -> str:
    """The robot's own readings of its tool pose in all frames, and in every other one."""
    return _with_and_without(subject, play_of(subject, kinematics=True), alive)


def _with_and_without(subject: Subject, play: Play, alive: Alive) -> str:
    """As it is, and with every other frame without what the robot says."""
    run_through(subject.make(), play, alive)
    frames = [replace(frame, joints=None, kinematics=None) if frame.index % 2 else frame for frame in play.observations]
    try:
        run_through(subject.make(), replace(play, observations=tuple(frames)), alive)
    except SurgbenchError as error:
        raise SurgbenchError(f"frames without: {error}") from error
    return ""


def two_arms(subject: Subject, alive: Alive) -> str:
    """Two arms in one mask."""
    steps = run_through(subject.make(), play_of(subject, arms=2), alive)
    return f"{len(steps[0].state)} numbers"


def masks_of_arms(subject: Subject, alive: Alive) -> str:
    """A mask for each of two arms: in all frames or every other one, exchanged, the same for both, empty for one."""
    play = play_of(subject, arms=2, instances=True)
    nothing = _all_pixels(False)
    ways: dict[str, Callable[[int, tuple[Mask, ...]], tuple[Mask, ...] | None]] = {
        "in all frames": lambda index, masks: masks,
        "in every other frame": lambda index, masks: None if index % 2 else masks,
        "exchanged in some frames": lambda index, masks: masks[::-1] if index in (2, 3) else masks,
        "the same for both arms": lambda index, masks: (masks[0] | masks[1],) * 2,
        "empty for one arm": lambda index, masks: (masks[0], nothing) if index >= GONE else masks,
    }
    said = 0
    for name, way in ways.items():
        frames = [_with_instances(frame, way) for frame in play.observations]
        try:
            steps = run_through(subject.make(), replace(play, observations=tuple(frames)), alive)
        except SurgbenchError as error:
            raise SurgbenchError(f"{name}: {error}") from error
        said = sum(bool(step.lost[1]) for step in steps[GONE:])
    return f"says that the arm without a mask is lost in {said} of {len(play.observations) - GONE} frames"


def _with_instances(frame: Observation, way: Callable[[int, tuple[Mask, ...]], tuple[Mask, ...] | None]) -> Observation:
    view = frame.views[0]
    assert view.instance_masks is not None
    masks = way(frame.index, view.instance_masks)
    gone = masks is not None and not masks[1].any()
    # An arm that is gone is gone from the mask of both, and has no tips.
    changed = replace(view, instance_masks=masks, mask=masks[0] if masks is not None and gone else view.mask)
    return replace(frame, views=(replace(changed, keypoints=(view.tips[0], None)) if gone else changed,))


def crossing_arms(subject: Subject, alive: Alive) -> str:
    """One arm passes behind the other, in one mask of both and with a mask for each."""
    words = []
    for instances in (False, True):
        play = play_of(subject, arms=2, crossing=True, instances=instances, frames=16)
        steps = run_through(subject.make(), play, alive)
        places = split_arms(np.array([step.state for step in steps]))[:, :, POSITION]
        off_mm = 1e3 * np.linalg.norm(places - split_arms(play.truth)[:, :, POSITION], axis=-1)[-1]
        said = ", ".join(f"{name} {off:.1f} mm off" for name, off in zip(("left", "right"), off_mm, strict=True))
        words.append(f"{'a mask for each' if instances else 'one mask'}: {said}")
    return "; ".join(words)


def untouched(subject: Subject, alive: Alive) -> str:
    """Nothing is written into what is handed in."""
    play = play_of(subject, readings=True)
    state = play.truth[0].copy()
    session = Session(subject.make(), play.scene, state, alive)
    given = _copies({"state": state}, play.scene, None)
    session.tracker.reset(play.scene, state, generator(check="conformance"))  # session.reset would hand in a copy
    _compare(given, _views({"state": state}, play.scene, None), "reset")
    for observation in map(session.prepare, play.observations):
        given = _copies({}, play.scene, observation)
        session.step(observation)
        _compare(given, _views({}, play.scene, observation), "step")
    return ""


Arrays = dict[str, NDArray[np.generic]]


def _views(arrays: Arrays, scene: Scene, observation: Observation | None) -> Arrays:
    return {**arrays, **dict(_scene_arrays(scene)), **dict(_frame_arrays(observation))}


def _copies(arrays: Arrays, scene: Scene, observation: Observation | None) -> Arrays:
    return {name: array.copy() for name, array in _views(arrays, scene, observation).items()}


def _scene_arrays(scene: Scene) -> Iterator[tuple[str, NDArray[np.generic]]]:
    for arm, box in enumerate(scene.limits):
        yield f"scene.limits[{arm}].lower_rad", box.lower_rad
        yield f"scene.limits[{arm}].upper_rad", box.upper_rad
    yield "scene.views[0].mask", scene.views[0].mask
    yield "scene.views[0].T_view_cam", scene.views[0].T_view_cam
    if scene.T_cam_base is not None:
        yield "scene.T_cam_base", scene.T_cam_base


def _frame_arrays(observation: Observation | None) -> Iterator[tuple[str, NDArray[np.generic]]]:
    if observation is None:
        return
    yield "observation.start", observation.start
    for name in ("joints", "kinematics"):
        if getattr(observation, name) is not None:
            yield f"observation.{name}", getattr(observation, name)
    view = observation.views[0]
    yield "the mask", view.mask
    for arm, mask in enumerate(view.instance_masks or ()):
        yield f"the mask of arm {arm}", mask
    yield "T_view_cam", view.T_view_cam
    for arm, tips in enumerate(view.tips):
        if tips is not None:
            yield f"the keypoints of arm {arm}", tips


def _compare(before: Arrays, after: Arrays, method: str) -> None:
    for name, array in before.items():
        if not np.array_equal(array, after[name]):
            raise CheckFailedError(f"{method} writes into {name}: work on a copy")
