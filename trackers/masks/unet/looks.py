"""What one picture may look like: cut out and turned, before another backdrop, in other light and colours.

All of it costs far less than rendering, so that few rendered pictures are enough. Instruments are recoloured apart from
what is behind them, and are put before the backdrops of other pictures (Ghiasi et al., CVPR 2021): a network is not to
know tissue and drapes by heart (domain randomisation: Tobin et al., IROS 2017).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from surgbench.config import NotNegative, Positive, Section
from surgbench.geometry import FloatArray

Fraction = Annotated[float, Field(ge=0, le=1)]
Image = NDArray[np.uint8]
Light = NDArray[np.float32]
# Blur, in pixels, of the edge of an instrument that is put before another backdrop.
SEAM_PX = 0.6
# How much the channels are changed apart against all together, of what is behind instruments and of these, which are of
# steel.
TINTS = (0.6, 0.25)
# Cells of what unevenly lights a picture.
LIGHT_CELLS = 4


class LookSettings(Section):
    """How pictures are changed while they are learnt.

    Attributes:
        cut_px: Width and height of what the network is shown, multiples of 32.
        aim: How often an instrument is in the middle, as far as the picture allows, and not anything.
        zoom: How large things are against how the network is shown a whole picture, least and most.
        stretch: How much more in one direction than in the other, at most.
        turn_rad: How far it is turned, at most.
        other_backdrop: How often it is put before another picture's backdrop, instruments there included.
        recolour: How much the colours of the instruments, and of the rest, are changed, each apart.
        swap_colours: How often the rest has its colours exchanged.
        shade: How much the light differs over a picture.
        gamma: By what factor the contrast differs, at most.
        blur_px: Standard deviation of a blur, at most.
        noise: Standard deviation of noise in levels of 255, at most.
    """

    cut_px: tuple[int, int] = (224, 160)
    aim: Fraction = 0.6
    zoom: tuple[Positive, Positive] = (0.75, 2.0)
    stretch: Annotated[float, Field(ge=1, le=2)] = 1.12
    turn_rad: NotNegative = 0.35
    other_backdrop: Fraction = 0.4
    recolour: Annotated[float, Field(ge=0, le=2)] = 0.35
    swap_colours: Fraction = 0.3
    shade: Annotated[float, Field(ge=0, le=2)] = 0.4
    gamma: Annotated[float, Field(ge=1, le=4)] = 1.4
    blur_px: NotNegative = 1.2
    noise: NotNegative = 7.0

    @model_validator(mode="after")
    def _possible(self) -> LookSettings:
        if any(side < 32 or side % 32 for side in self.cut_px):
            raise ValueError("cut_px must be multiples of 32")
        if self.zoom[0] > self.zoom[1]:
            raise ValueError("zoom must be [least, most] with least <= most")
        return self


@dataclass(frozen=True)
class Pictures:
    """Pictures and what is to be found in them.

    Attributes:
        images: Each ``(height, width, 3)`` uint8 RGB.
        masks: Each ``(height, width)`` uint8, 255 where an instrument shows.
        input_px: As wide the network is shown a whole picture.
        settings: How they are changed.
    """

    images: Sequence[Image]
    masks: Sequence[Image]
    input_px: int
    settings: LookSettings

    def __len__(self) -> int:
        """How many there are."""
        return len(self.images)

    def looks(self, chosen: NDArray[np.int64], rng: np.random.Generator) -> tuple[Image, Image]:
        """Chosen pictures, each in a look of its own.

        Returns:
            Pictures ``(n, h, w, 3)`` and masks ``(n, h, w)`` uint8, of the size of ``cut_px``.
        """
        shown = [self.look(int(index), rng) for index in chosen]
        return np.stack([image for image, _ in shown]), np.stack([mask for _, mask in shown])

    def look(self, index: int, rng: np.random.Generator) -> tuple[Image, Image]:
        """A picture in a random look."""
        settings = self.settings
        image, mask = self._cut(index, rng)
        light = image.astype(np.float32)
        inside = (mask.astype(np.float32) / np.float32(255.0))[..., None]
        if rng.random() < settings.other_backdrop:
            other, its_mask = self._cut(int(rng.integers(len(self))), rng)
            seam = cv2.GaussianBlur(inside, (0, 0), SEAM_PX)[..., None]
            light += (1 - seam) * (other.astype(np.float32) - light)
            mask = np.maximum(mask, its_mask)
            inside = (mask.astype(np.float32) / np.float32(255.0))[..., None]
        light /= np.float32(255.0)
        if rng.random() < settings.swap_colours:
            light += (1 - inside) * (light[..., rng.permutation(3)] - light)
        tints = rng.normal(0, 1, (2, 3)) * np.array(TINTS)[:, None]
        gains = np.exp(settings.recolour * (rng.uniform(-1, 1, (2, 1)) + tints))
        light *= gains[0].astype(np.float32) + inside * (gains[1] - gains[0]).astype(np.float32)
        shades = np.exp(settings.shade * rng.normal(0, 0.5, (LIGHT_CELLS, LIGHT_CELLS))).astype(np.float32)
        light *= cv2.resize(shades, light.shape[1::-1], interpolation=cv2.INTER_CUBIC)[..., None]
        sigma = rng.uniform(0, settings.blur_px)
        if sigma > 0.3:
            light = np.asarray(cv2.GaussianBlur(light, (0, 0), sigma), np.float32)
        gamma = settings.gamma ** rng.uniform(-1, 1)
        light = np.power(np.clip(light, 0.0, 1.0), np.float32(gamma)) * np.float32(255.0)
        light += rng.standard_normal(light.shape, np.float32) * np.float32(rng.uniform(0, settings.noise))
        return np.clip(np.rint(light), 0, 255).astype(np.uint8), mask

    def _cut(self, index: int, rng: np.random.Generator) -> tuple[Image, Image]:
        """What is cut out of a picture, and where an instrument shows in it."""
        image, mask, settings = self.images[index], self.masks[index], self.settings
        width, height = settings.cut_px
        matrix = self._place(index, rng)
        # What is beyond the picture is mirrored: instruments go on at its border, as they do.
        cut = cv2.warpAffine(image, matrix, (width, height), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
        shown = cv2.warpAffine(mask, matrix, (width, height), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
        return np.asarray(cut, np.uint8), np.where(shown >= 128, np.uint8(255), np.uint8(0))

    def _place(self, index: int, rng: np.random.Generator) -> FloatArray:
        """``(2, 3)`` from a picture to what is cut out of it."""
        settings = self.settings
        size = np.array(self.masks[index].shape[::-1], np.float64)
        low, high = np.log(settings.zoom)
        zoom = np.exp(rng.uniform(low, high)) * self.input_px / size[0]
        stretch = settings.stretch ** rng.uniform(-0.5, 0.5)
        scale = zoom * np.array([stretch, 1.0 / stretch]) * np.where(rng.random(2) < 0.5, -1.0, 1.0)
        turn = rng.uniform(-settings.turn_rad, settings.turn_rad)
        linear = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]) * scale
        middle, aimed = rng.random(2) * size, rng.random() < settings.aim
        rows, columns = np.nonzero(self.masks[index])
        if aimed and len(rows):
            pixel = int(rng.integers(len(rows)))
            middle = np.array([columns[pixel], rows[pixel]], np.float64)
        # As little as can be lies beyond the border.
        margin = np.minimum(0.5 * np.array(settings.cut_px) / np.abs(scale), 0.5 * size)
        middle = np.clip(middle, margin, size - margin)
        return np.column_stack([linear, 0.5 * np.array(settings.cut_px) - linear @ middle])
