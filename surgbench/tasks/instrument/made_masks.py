"""The mask source as the loop meets it: one for each view, timed, its answers checked."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surgbench.camera import Camera
from surgbench.contract import Mask, Observation, Scene, View
from surgbench.errors import InvalidAnswerError, PluginError, SurgbenchError
from surgbench.mask_sources import FoundMasks, MaskSource, Prompts


def check_mask(value: Any, camera: Camera, who: str) -> Mask:
    """A source's mask as ``(height, width)`` bool of the camera's size.

    Raises:
        InvalidAnswerError: It is something else; one line that says what.
    """
    mask = np.asarray(value)
    if mask.dtype != np.bool_:
        raise InvalidAnswerError(f"{who} returned a mask of {mask.dtype}, not of bool")
    if mask.shape != (camera.height, camera.width):
        raise InvalidAnswerError(f"{who} returned a mask of shape {mask.shape}, not {(camera.height, camera.width)}")
    return mask


def check_found(value: Any, camera: Camera, arms: int, who: str) -> FoundMasks:
    """A source's answer, a mask or :class:`FoundMasks`.

    Raises:
        InvalidAnswerError: It is something else; one line that says what.
    """
    found = value if isinstance(value, FoundMasks) else FoundMasks(value)
    alone = found.instance_masks
    if alone is not None:
        if not isinstance(alone, (tuple, list)):
            raise InvalidAnswerError(f"{who} returned {type(alone).__name__}, not a mask of every arm")
        if len(alone) != arms:
            raise InvalidAnswerError(f"{who} returned masks of {len(alone)} arms, not of {arms}")
        alone = tuple(check_mask(mask, camera, who) for mask in alone)
    try:
        confidence = float(found.confidence)
    except (TypeError, ValueError):
        raise InvalidAnswerError(f"{who} returned a confidence that is no number ({found.confidence!r})") from None
    if not 0 <= confidence <= 1:
        raise InvalidAnswerError(f"{who} returned a confidence of {confidence:g}, not of 0 to 1")
    return FoundMasks(check_mask(found.mask, camera, who), alone if arms > 1 else None, confidence)


def with_images_read(observation: Observation) -> Observation:
    """The frame with images that are in memory, so that nobody's time is that of a disk."""
    return replace(observation, views=tuple(replace(view, image=_kept(view.image())) for view in observation.views))


def _kept(image: NDArray[np.uint8] | None) -> Callable[[], NDArray[np.uint8] | None]:
    return partial(_hand, image)


def _hand(image: NDArray[np.uint8] | None) -> NDArray[np.uint8] | None:
    return image


def masks_alone(view: View) -> View:
    """A view's mask of all arms without anything else that it holds, to be sent on."""
    return View(view.camera, view.T_view_cam, view.mask)


@dataclass(frozen=True)
class Made:
    """What a source made of a frame, and what it took.

    Attributes:
        observation: With its masks.
        elapsed_s: Of all views.
        confidence: The least of the views.
    """

    observation: Observation
    elapsed_s: float
    confidence: float


class MaskMaker:
    """Puts a source's masks in the place of the dataset's.

    Args:
        create: Makes a source, one for each view.
        name: What it is called in messages.
    """

    def __init__(self, create: Callable[[], MaskSource], name: str) -> None:
        self._create = create
        self._who = f"masks '{name}'"
        self._sources: list[MaskSource] = []

    def reset(self, scene: Scene, observation: Observation, prompts: tuple[Prompts | None, ...]) -> None:
        """Start a sequence with its first frame, and the points on it for each view."""
        self._arms = scene.arms
        self._sources = [self._create() for _ in observation.views]
        for source, view, points in zip(self._sources, observation.views, prompts, strict=True):
            with self._named():
                source.reset(scene, view, points)

    def make(self, observation: Observation) -> Made:
        """The frame with the source's masks."""
        views, confidence = [], 1.0
        begin = time.perf_counter()
        for source, view in zip(self._sources, observation.views, strict=True):
            with self._named():
                answer = source.segment(observation, view)
            found = check_found(answer, view.camera, self._arms, self._who)
            views.append(_with(view, found))
            confidence = min(confidence, found.confidence)
        elapsed_s = time.perf_counter() - begin
        return Made(replace(observation, views=tuple(views)), elapsed_s, confidence)

    @contextmanager
    def _named(self) -> Iterator[None]:
        try:
            yield
        except SurgbenchError:
            raise  # its line says what is wrong
        except Exception as error:
            raise PluginError(f"{self._who} raised {type(error).__name__}: {' '.join(str(error).split())}") from error


def _with(view: View, found: FoundMasks) -> View:
    return replace(view, mask=found.mask, instance_masks=found.instance_masks)
