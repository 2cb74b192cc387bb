"""The child process that a tracker runs in: it is sent observations, and answers with estimates.

The engine's loop is predict, step, update: the filter predicts where the frame's search begins, the tracker
estimates, the filter takes the estimate in. Whatever the tracker raises or returns wrong is told to the
parent in one line, with the traceback beside it.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surgbench.contract import Estimate, Observation, Scene, TimedFilter, Trace, Traceable, View
from surgbench.errors import InvalidAnswerError
from surgbench.geometry import FloatArray
from surgbench.mask_sources import Prompts
from surgbench.metrics import OUT_OF_VIEW_SHARE
from surgbench.processes.service import Tell, serve_parent
from surgbench.randomness import generator
from surgbench.registry import create, find
from surgbench.state import JOINTS, STATE_NAMES, STATE_SIZE, clip_joints, split_arms
from surgbench.suite.settings import Plug
from surgbench.tasks.instrument.asked import Scored
from surgbench.tasks.instrument.made_masks import MaskMaker, masks_alone, with_images_read
from surgbench.tasks.instrument.tips import AskedSource
from surgbench.tasks.instrument.told_prompts import of_views
from surgbench.timing import step_s

# What no state exceeds, of an arm, however long a lost one has drifted; with more, errors are no numbers.
_BOUNDS = (*(1e6,) * 3, *(1e3,) * 3, *(1e6,) * 3)
_UNITS = (*("rad",) * 3, *("m",) * 3, *("rad",) * 3)


@dataclass(frozen=True)
class Setup:
    """What a child is told before the first frame.

    Attributes:
        tracker: And the other plug-ins by name, with their options.
        scene: The sequence's constants.
        tracker_axes: Named axes that seed the tracker's generator.
        initialiser_axes: Those of the initialiser; not the tracker, so that all trackers start alike.
        scored: Which state is answered: the tracker's own, or what the filter makes of it.
        mask_source: What makes the masks; ``None``: views have them.
        prompts: Points in the first picture of each view for it, where some are told.
    """

    tracker: Plug
    initialiser: Plug
    filter: Plug
    keypoints: Plug
    scene: Scene
    tracker_axes: dict[str, str | int]
    initialiser_axes: dict[str, str | int]
    scored: Scored = "raw"
    mask_source: Plug | None = None
    prompts: tuple[Prompts | None, ...] = ()


@dataclass(frozen=True)
class Answer:
    """One frame's estimate and what it took.

    Of two arms ``confidence`` is that of the less certain one, and ``lost`` says whether either is; ``confidence_arms``
    and ``lost_arms`` hold each arm's own, ``(arms,)``, and are ``None`` of one arm.

    ``latency_keypoints_ms`` is what the tracker waited for the keypoint source: 0 where it did not look at the tips. It
    is not in ``latency_optimise_ms``. ``latency_filter_ms`` is the filter's ``predict`` and ``update``, and
    ``latency_masks_ms`` what the mask source took, where there is one. All are ``None`` of a frame that no tracker was
    asked about.

    ``seen`` has the reference view's masks where a source made them, and ``confidence_masks`` how sure it was.
    """

    start: FloatArray
    state: FloatArray
    confidence: float
    lost: bool
    standard_deviations: FloatArray | None
    latency_ms: float | None
    latency_optimise_ms: float | None
    latency_keypoints_ms: float | None
    latency_filter_ms: float | None
    confidence_arms: FloatArray | None = None
    lost_arms: NDArray[np.bool_] | None = None
    latency_masks_ms: float | None = None
    confidence_masks: float | None = None
    seen: View | None = None


def waiting(first: FloatArray) -> Answer:
    """Of a frame before any instrument shows: lost, and for want of another the state that tracking will begin with."""
    arms = first.size // STATE_SIZE
    answer = Answer(first.copy(), first.copy(), 0.0, True, None, None, None, None, None)
    return answer if arms == 1 else replace(answer, confidence_arms=np.zeros(arms), lost_arms=np.ones(arms, dtype=bool))


def check_state(value: Any, size: int, who: str) -> FloatArray:
    """A plug-in's answer as a finite ``(size,)`` array.

    Raises:
        InvalidAnswerError: It is something else; one line that says what.
    """
    return _finite(value, size, f"{who} returned a state")


def check_possible(state: FloatArray, who: str) -> FloatArray:
    """A state, unless no instrument anywhere could have it: its errors would be no numbers.

    Raises:
        InvalidAnswerError: It lies so far away; one line that says what does.
    """
    for arm in split_arms(state):
        for name, value, bound, unit in zip(STATE_NAMES, arm, _BOUNDS, _UNITS, strict=True):
            if abs(value) > bound:
                raise InvalidAnswerError(f"{who} returned a state outside all limits: {name} is {value:.3g} {unit}")
    return state


def check_confidence(value: Any, arms: int, who: str) -> FloatArray:
    """A plug-in's confidence, of all arms together or ``(arms,)``, as ``(arms,)`` finite numbers.

    Raises:
        InvalidAnswerError: It is something else.
    """
    try:
        confidence = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        confidence = np.array(np.nan)
    if confidence.shape not in ((), (arms,)):
        raise InvalidAnswerError(f"{who} returned a confidence of shape {confidence.shape}, not a number or ({arms},)")
    if not np.isfinite(confidence).all():
        raise InvalidAnswerError(f"{who} returned a confidence that is no number ({value!r})")
    return np.array(np.broadcast_to(confidence, (arms,)))


def check_lost(value: Any, arms: int, who: str) -> NDArray[np.bool_]:
    """What a plug-in says of being lost, of all arms together or ``(arms,)``, as ``(arms,)`` bool.

    Raises:
        InvalidAnswerError: It is something else.
    """
    lost = np.asarray(value)
    if lost.shape == ():
        return np.full(arms, bool(value))
    if lost.shape != (arms,):
        raise InvalidAnswerError(f"{who} returned 'lost' of shape {lost.shape}, not a bool or ({arms},)")
    return np.array(lost, dtype=bool)


def check_standard_deviations(value: Any, size: int, who: str) -> FloatArray | None:
    """A plug-in's standard deviations as a ``(size,)`` array of finite numbers above 0; ``None`` stays ``None``.

    Raises:
        InvalidAnswerError: They are something else; one line that says what.
    """
    if value is None:
        return None
    deviations = _finite(value, size, f"{who} returned standard deviations")
    if (deviations <= 0).any():
        raise InvalidAnswerError(f"{who} returned a standard deviation of {deviations.min():g}, not above 0")
    return deviations


def _finite(value: Any, size: int, returned: str) -> FloatArray:
    """An answer as a finite ``(size,)`` array of its own; ``returned`` says whose it is, and what."""
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise InvalidAnswerError(f"{returned} of {type(value).__name__}, not an array of {size} numbers") from None
    if array.shape != (size,):
        raise InvalidAnswerError(f"{returned} of shape {array.shape}, not ({size},)")
    if not np.isfinite(array).all():
        raise InvalidAnswerError(f"{returned} with NaN or infinity")
    return array


class Loop:
    """Predict, step, update over one sequence.

    Args:
        setup: Plug-ins, scene and seeds.
    """

    def __init__(self, setup: Setup) -> None:
        self._setup = setup
        self._scene = setup.scene
        self._size = STATE_SIZE * setup.scene.arms
        self._tracker = self._make(setup.tracker)
        self._filter = self._make(setup.filter)
        self._last_s: float | None = None  # when the last frame was
        self._keypoints = AskedSource(self._make(setup.keypoints), setup.keypoints.name)
        source = setup.mask_source
        self._masks = None if source is None else MaskMaker(partial(self._make, source), source.name)

    @staticmethod
    def _make(plug: Plug) -> Any:
        return create(find(plug.kind, plug.reference), plug.options)

    def initialise(
        self, observation: Observation, truth: FloatArray | None, progress: Callable[[float], None]
    ) -> FloatArray | None:
        """State of the frame that tracking begins with, by the initialiser, ``(9 * arms,)``, joints within limits.

        ``None`` where masks are made and this one shows no instrument, so that the next frame is to be tried.
        """
        setup, scene = self._setup, self._scene
        self._keypoints.reset(scene)
        # With the truth there are points on the instruments before there are masks.
        if not setup.initialiser.needs_truth:
            observation = self._first_masks(observation, None)
            prompted = any(points is not None for points in setup.prompts)
            if self._masks is not None and not prompted and observation.mask.mean() < OUT_OF_VIEW_SHARE:
                return None
        observation = self._keypoints.show(observation)
        initialiser = self._make(setup.initialiser)
        with self._keypoints.blamed():
            state = initialiser.initialise(scene, observation, generator(**setup.initialiser_axes), truth, progress)
        return clip_joints(
            check_state(state, self._size, f"initialiser '{setup.initialiser.name}'"), scene.joint_limits
        )

    def _first_masks(self, observation: Observation, state: FloatArray | None) -> Observation:
        """Have the mask source start with a frame; returns the frame with its masks.

        Args:
            observation: The frame that tracking begins with.
            state: Its state, where it is known.
        """
        if self._masks is None:
            return observation
        start = np.zeros(self._size) if state is None else state
        observation = with_images_read(replace(observation, start=start.copy()))
        self._restart_masks(observation, state)
        return self._masks.make(observation).observation

    def _restart_masks(self, observation: Observation, state: FloatArray | None) -> None:
        if self._masks is not None:
            known = state if self._setup.initialiser.needs_truth else None
            self._masks.reset(self._scene, observation, of_views(self._setup.prompts, self._scene, observation, known))

    def begin(self, observation: Observation, state: FloatArray, truth: FloatArray | None = None) -> None:
        """Start at a frame's state: warm up on a throw-away tracker, then reset everything.

        Args:
            observation: The frame: the first in which an instrument shows.
            state: Its state, ``(9 * arms,)``.
            truth: ``(T, 9 * arms)`` from this frame on, only for a filter with ``needs_truth``; then it starts this
                frame too.
        """
        setup, scene = self._setup, self._scene
        if truth is not None:
            self._filter.give_truth(truth)
            state = clip_joints(truth[0], scene.joint_limits)
        self._keypoints.reset(scene)
        # Compilation and caches belong to nobody's latency: the sources are warmed up whether this step looks or not.
        first = with_images_read(observation) if self._reads_images else observation
        observation = self._keypoints.show(self._first_masks(first, state), at_once=True)
        warm = self._make(setup.tracker)
        warm.reset(scene, state.copy(), generator(**setup.tracker_axes))
        warm.step(replace(observation, start=state.copy()))
        self._tracker.reset(scene, state.copy(), generator(**setup.tracker_axes))
        self._filter.reset(scene, state.copy())
        self._keypoints.reset(scene)
        self._restart_masks(first, state)
        self._first, self._last_s = state, None

    def _predict(self, before_s: float, now_s: float) -> Any:
        if isinstance(self._filter, TimedFilter):
            self._filter.elapse(step_s(before_s, now_s, self._scene.dt_s))
        return self._filter.predict()

    def step(self, observation: Observation, trace: Trace | None = None) -> Answer:
        """One frame. ``observation.start`` is filled in here."""
        if self._reads_images:
            observation = with_images_read(observation)
        begin = time.perf_counter()
        start = self._first if self._last_s is None else self._predict(self._last_s, observation.timestamp_s)
        self._last_s = observation.timestamp_s
        filter_s = time.perf_counter() - begin
        start = check_state(start, self._size, f"filter '{self._setup.filter.name}'")
        if observation.joints is not None:
            split_arms(start)[:, JOINTS] = observation.joints
        start = clip_joints(start, self._scene.joint_limits)
        self._keypoints.restart_clock()
        observation = replace(observation, start=start.copy())
        made = None if self._masks is None else self._masks.make(observation)
        observation = self._keypoints.show(observation if made is None else made.observation)
        if isinstance(self._tracker, Traceable):
            self._tracker.trace = trace
        before, waited_s = time.perf_counter(), self._keypoints.asked_s
        with self._keypoints.blamed():
            answer = self._tracker.step(observation)
        optimise_s = time.perf_counter() - before - (self._keypoints.asked_s - waited_s)
        estimate = answer if isinstance(answer, Estimate) else Estimate(answer)
        who = f"tracker '{self._setup.tracker.name}'"
        state = check_possible(check_state(estimate.state, self._size, who), who)
        arms = self._scene.arms
        confidence = check_confidence(estimate.confidence, arms, f"tracker '{self._setup.tracker.name}'")
        lost = check_lost(estimate.lost, arms, f"tracker '{self._setup.tracker.name}'")
        deviations = check_standard_deviations(
            estimate.standard_deviations, self._size, f"tracker '{self._setup.tracker.name}'"
        )
        before = time.perf_counter()
        filtered = self._filter.update(state.copy())
        filter_s += time.perf_counter() - before
        if self._setup.scored == "filtered":
            state = check_state(filtered, self._size, f"filter '{self._setup.filter.name}'")
        return Answer(
            start=start,
            state=state,
            confidence=float(confidence.min()),
            lost=bool(lost.any()),
            standard_deviations=deviations,
            latency_ms=1e3 * (time.perf_counter() - begin),
            latency_optimise_ms=1e3 * optimise_s,
            latency_keypoints_ms=1e3 * self._keypoints.asked_s,
            latency_filter_ms=1e3 * filter_s,
            confidence_arms=None if arms == 1 else confidence,
            lost_arms=None if arms == 1 else lost,
            latency_masks_ms=None if made is None else 1e3 * made.elapsed_s,
            confidence_masks=None if made is None else made.confidence,
            seen=None if made is None else masks_alone(made.observation.views[0]),
        )

    @property
    def _reads_images(self) -> bool:
        return self._masks is not None or bool(getattr(self._tracker, "reads_images", False))


class Service:
    """Answers the parent's messages.

    They are ``("setup", Setup)``, ``("first", observation, truth of this frame for the initialiser, truth of this and
    all later frames for the filter)``, the two ``None`` unless the plug-in needs them, and ``("step", observation)``.
    """

    def __init__(self) -> None:
        self._loop: Loop | None = None

    def __call__(self, tell: Tell, kind: str, *content: Any) -> tuple[Any, ...]:
        """One message's answer."""
        if kind == "setup":
            self._loop = Loop(*content)
            return ("ready",)
        assert self._loop is not None
        if kind == "first":
            begin = time.perf_counter()
            observation, first_truth, truth = content
            state = self._loop.initialise(observation, first_truth, lambda fraction: tell("progress", fraction))
            elapsed_s = time.perf_counter() - begin
            if state is not None:
                self._loop.begin(observation, state, truth)
            return ("initialised", state, elapsed_s)
        return ("answer", self._loop.step(*content))


if __name__ == "__main__":
    # What crosses to the parent must be of this module's importable self, not of __main__.
    from surgbench.tasks.instrument import worker

    serve_parent(worker.Service())
