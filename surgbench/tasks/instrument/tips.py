"""The keypoint source as a tracker meets it: asked when tips are first looked at, timed, its answers checked."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from surgbench.contract import KeypointSource, Observation, Scene, View
from surgbench.errors import InvalidAnswerError, PluginError
from surgbench.geometry import FloatArray
from surgbench.keypoints.found import BOTH, FoundTips, Tips


def check_tips(value: Any, arms: int, who: str) -> Tips:
    """A keypoint source's answer: per arm finite ``(2, 2)`` or ``(1, 2)``, or ``None``.

    Raises:
        InvalidAnswerError: It is something else; one line that says what.
    """
    try:
        answers = tuple(value)
    except TypeError:
        raise InvalidAnswerError(f"{who} returned {type(value).__name__}, not the tips of every arm") from None
    if len(answers) != arms:
        raise InvalidAnswerError(f"{who} returned tips of {len(answers)} arms, not of {arms}")
    return tuple(_check_arm(answer, who) for answer in answers)


def _check_arm(value: Any, who: str) -> FloatArray | None:
    if value is None:
        return None
    try:
        tips = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise InvalidAnswerError(f"{who} returned {type(value).__name__}, not the pixels of tips") from None
    if tips.ndim != 2 or tips.shape[1] != 2 or len(tips) > BOTH:
        raise InvalidAnswerError(f"{who} returned tips of shape {tips.shape}, not (2, 2), (1, 2) or None")
    if not np.isfinite(tips).all():
        raise InvalidAnswerError(f"{who} returned tips with NaN or infinity")
    return tips if len(tips) else None


class AskedSource:
    """A keypoint source that is asked when somebody looks.

    Args:
        source: The plug-in.
        name: What it is called in messages.

    Attributes:
        asked_s: Seconds spent in it since :meth:`restart_clock`.
    """

    def __init__(self, source: KeypointSource, name: str) -> None:
        self._source = source
        self._who = f"keypoints '{name}'"
        self._every_frame = bool(getattr(source, "every_frame", False))
        self._failure: Exception | None = None
        self.asked_s = 0.0

    def reset(self, scene: Scene) -> None:
        """Start a sequence."""
        self._arms = scene.arms
        self._source.reset(scene)

    def restart_clock(self) -> None:
        """From here on :attr:`asked_s` counts anew."""
        self.asked_s = 0.0

    def show(self, observation: Observation, *, at_once: bool = False) -> Observation:
        """The frame with views whose tips are the source's, found when first looked at, or ``at_once``."""
        views = tuple(
            replace(view, found=FoundTips(partial(self._ask, observation, view))) for view in observation.views
        )
        if at_once or self._every_frame:
            for view in views:
                _ = view.tips
        return replace(observation, views=views)

    @contextmanager
    def blamed(self) -> Iterator[None]:
        """What the source raises in here is told as its own, whatever the one who looked makes of it."""
        try:
            yield
        finally:
            if self._failure is not None:
                raise self._failure

    def _ask(self, observation: Observation, view: View) -> Tips:
        begin = time.perf_counter()
        try:
            return check_tips(self._source.detect(observation, view), self._arms, self._who)
        except Exception as error:
            self._failure = self._name(error)
            raise self._failure from error
        finally:
            self.asked_s += time.perf_counter() - begin

    def _name(self, error: Exception) -> Exception:
        if isinstance(error, InvalidAnswerError):
            return error
        return PluginError(f"{self._who} raised {type(error).__name__}: {' '.join(str(error).split())}")
