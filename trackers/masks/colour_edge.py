"""Masks by colour and edges, without anything learned: instruments are grey, and what is behind them is not."""

from __future__ import annotations

from typing import Annotated, ClassVar

import cv2
import numpy as np
from pydantic import Field

from surgbench.config import Section
from surgbench.contract import Mask, Observation, Plugin, Scene, View
from surgbench.mask_sources import FoundMasks, Prompts
from surgbench.trackers.masks.grey_parts import Thresholds, find_grey
from surgbench.trackers.masks.images import image_of
from surgbench.trackers.masks.own_arms import OwnArms


class ColourEdgeMasks(Plugin):
    """Grey parts that come from the picture's border, as their colours and edges say; see :mod:`.grey_parts`.

    Of a picture that shows more instruments than the scene has, :class:`.own_arms.OwnArms` takes the scene's.
    """

    name: ClassVar[str] = "colour-edge"
    summary: ClassVar[str] = "grey instruments before coloured tissue or drapes, by colour and edges; nothing learned"
    reads_images: ClassVar[bool] = True

    class Config(Section):
        """Its few numbers.

        Attributes:
            width_px: Width of the reduced picture.
            contrast: How much greyer than its surroundings an instrument is, as a share of their saturation.
            probability: Of a pixel's colour to be an instrument's.
        """

        width_px: Annotated[int, Field(ge=64, description="pictures are reduced to this width, pixels")] = 350
        contrast: Annotated[
            float, Field(gt=0, lt=1, description="how much greyer than its surroundings an instrument is, of 1")
        ] = 0.3
        probability: Annotated[
            float, Field(gt=0, lt=1, description="of a pixel's colour to be an instrument's, from which it is one")
        ] = 0.4

    def __init__(self, config: Config | None = None) -> None:
        self.config = config or self.Config()
        self._thresholds = Thresholds(self.config.contrast, self.config.probability)

    def reset(self, scene: Scene, view: View, prompts: Prompts | None) -> None:
        """Start a sequence; prompts say which instrument is the scene's where there is one."""
        self._own = OwnArms(scene, view, prompts)
        self._before: Mask | None = None

    def segment(self, observation: Observation, view: View) -> FoundMasks:
        """The mask of the scene's arms.

        Raises:
            DatasetError: The view has no image, or one of another size than its camera's.
        """
        image = image_of(observation, view)
        height, width = image.shape[:2]
        scale = min(1.0, self.config.width_px / width)
        size = max(1, round(width * scale)), max(1, round(height * scale))
        small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        before = self._before
        if before is None:
            predicted = self._own.predicted(observation)
            before = None if predicted is None else _resized(predicted, size)
        found = find_grey(small, before, self._thresholds)
        self._before = found.mask
        mask = self._own.pick(_resized(found.mask, (width, height)), observation, view)
        return FoundMasks(mask, confidence=found.probability if mask.any() else 0.0)


def _resized(mask: Mask, size: tuple[int, int]) -> Mask:
    """A mask in another size (width, height), its outline between the pixels' centres."""
    smooth = cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_LINEAR)
    return np.asarray(smooth > 0.5)
