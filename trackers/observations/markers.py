"""Finds an instrument's painted markers in an image, each by its colour near the place where it is expected.

Pixels are a marker's by hue and saturation (:mod:`~surgbench.trackers.observations.paint`). Of their connected parts
the one is taken that is most like the expected spot in place and size, if what is around it is unlike it. Its middle
is the centroid of how much of each pixel is paint, which is told by the pixel's linear colour. Markers are all off by
about the same: those that are not are left out. Nothing is known of what may be in front of a marker: one that is
hidden is not found, and one of which little shows neither.
"""

from __future__ import annotations

from typing import Annotated

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from surgbench.camera import Camera
from surgbench.config import Positive, Section
from surgbench.geometry import FloatArray
from surgbench.instrument import Instrument
from surgbench.trackers.observations.paint import Paint, decoded
from surgbench.trackers.observations.patches import Patches, Shown

# Of the sensor's noise, before hues are looked at; and levels below which a hue means nothing.
BLUR_PX, DARKEST = 1.0, 14
# A part's area against what should show.
LEAST_AREA, MOST_AREA = 0.35, 2.2
# How much more than the least saturation is asked for, one after the other.
STRICTER = (1.0, 1.25, 1.5)
# How far beyond the part its blurred rim reaches, and the shares of paint from which a pixel counts, and fully.
RIM_PX, RIM_LEAST, RIM_FULL = 3, 0.3, 0.7
# What is around a spot is looked at so far; it is at most so saturated, of the spot's own, as far as its hue is alike.
AROUND_PX, AROUND_SHARE = 6, 0.75
# Markers of one instrument are off by the same but for this.
APART_PX = 12.0
# What a factor of e in area is worth against the whole search radius.
AREA_WEIGHT = 0.5

Image = NDArray[np.uint8]
_DECODED = decoded(np.arange(256) / 255.0).astype(np.float32)


class MarkerConfig(Section):
    """Options of the detector."""

    search_px: Annotated[Positive, Field(description="markers are sought so far from where they are expected")] = 30.0


class MarkerFinder:
    """Finds the markers of one instrument in the images of one camera.

    Args:
        instrument: With markers.
        camera: Pinhole.
        config: Options.
        patches: Of the instrument, where they are at hand.

    Attributes:
        paint: The colours as learned.
    """

    def __init__(
        self, instrument: Instrument, camera: Camera, config: MarkerConfig, patches: Patches | None = None
    ) -> None:
        self._instrument, self._camera, self._config = instrument, camera, config
        self._patches = patches or Patches(instrument)
        self.paint = Paint(instrument.spec.markers)

    def find(self, image: Image, state: FloatArray) -> tuple[FloatArray, Shown]:
        """Look for all markers, and learn their colours.

        Args:
            image: ``(height, width, 3)`` RGB.
            state: ``(9,)`` as it is expected, in the camera's frame.

        Returns:
            ``(P, 2)`` pixels, NaN for those that are not found; and what was expected to show.
        """
        shown = self._patches.shown(self._instrument.link_transforms(state), self._camera)
        places, areas = shown.places_px, shown.areas_px
        found = np.full_like(places, np.nan)
        wanted = shown.sought
        if not wanted.any():
            return found, shown
        radii = np.sqrt(areas / np.pi)
        reach = self._config.search_px + 2.0 * radii
        window = _window(places[wanted], reach[wanted], image.shape)
        part = image[window]
        hsv = cv2.cvtColor(cv2.GaussianBlur(part, (0, 0), BLUR_PX), cv2.COLOR_RGB2HSV_FULL)
        hue, saturation, value = (np.asarray(plane, np.uint8) for plane in cv2.split(hsv))
        bright = value > DARKEST
        tables, least = self.paint.tables()
        alike = self.paint.alike()
        corner = np.array([window[1].start, window[0].start])
        colours: dict[int, FloatArray] = {}
        for number in np.flatnonzero(wanted).tolist():
            own = _window(places[number][None] - corner, reach[number : number + 1], part.shape)
            hues = cv2.LUT(hue[own], tables[number])
            member = (hues > 0) & bright[own]
            origin = np.array([own[1].start, own[0].start]) + corner
            for stricter in STRICTER:  # where paint runs into tissue of its hue, a higher bar parts them
                like = member & (saturation[own] > 255.0 * stricter * least[number])
                blob = self._best(like, places[number] - origin, float(areas[number]), image.shape, origin)
                if blob is not None and _stands_out(blob, saturation[own], alike[number][hue[own]]):
                    middle, colours[number] = _centroid(part[own], blob)
                    found[number] = middle + origin
                    break
        found[~_agreeing(found - places)] = np.nan
        for number, colour in colours.items():
            if np.isfinite(found[number, 0]):
                self.paint.learn(number, colour)
        self.paint.update()
        return found, shown

    def _best(
        self,
        member: NDArray[np.bool_],
        expected: FloatArray,
        area: float,
        shape: tuple[int, ...],
        corner: FloatArray,
    ) -> NDArray[np.bool_] | None:
        """The connected part that is most like a spot of this area at this place, unless the image's border cuts it."""
        _, labels, sizes, middles = cv2.connectedComponentsWithStats(member.astype(np.uint8), connectivity=4)
        counts = sizes[1:, cv2.CC_STAT_AREA] / area
        off = np.linalg.norm(middles[1:] - expected, axis=1) / self._config.search_px
        low = sizes[1:, [cv2.CC_STAT_LEFT, cv2.CC_STAT_TOP]] + corner
        high = low + sizes[1:, [cv2.CC_STAT_WIDTH, cv2.CC_STAT_HEIGHT]]
        whole = (low > 0).all(axis=1) & (high < [shape[1], shape[0]]).all(axis=1)
        fit = whole & (counts >= LEAST_AREA) & (counts <= MOST_AREA) & (off <= 1.0)
        if not fit.any():
            return None
        cost = np.where(fit, off + AREA_WEIGHT * np.abs(np.log(np.maximum(counts, 1e-9))), np.inf)
        return np.asarray(labels == 1 + int(cost.argmin()))


def _window(places: FloatArray, reach: FloatArray, shape: tuple[int, ...]) -> tuple[slice, slice]:
    """Rows and columns within reach of any of the places."""
    low = np.floor((places - reach[:, None]).min(axis=0)).astype(int)
    high = np.ceil((places + reach[:, None]).max(axis=0)).astype(int) + 1
    (left, top), (right, bottom) = np.clip([low, high], 0, [shape[1], shape[0]])
    return slice(int(top), int(bottom)), slice(int(left), int(right))


def _stands_out(blob: NDArray[np.bool_], saturation: Image, alike: NDArray[np.float32]) -> bool:
    """Whether what is around a part is less saturated, or of another hue."""
    rim = _grown(blob, RIM_PX - 1)
    around = _grown(blob, AROUND_PX) & ~rim
    if not around.any():
        return False
    return bool((saturation[around] * alike[around]).mean() < AROUND_SHARE * saturation[blob].mean())


def _grown(blob: NDArray[np.bool_], by_px: int) -> NDArray[np.bool_]:
    kernel = np.ones((2 * by_px + 1, 2 * by_px + 1), np.uint8)
    return np.asarray(cv2.dilate(blob.astype(np.uint8), kernel), dtype=bool)


def _agreeing(off: FloatArray) -> NDArray[np.bool_]:
    """Of ``(P, 2)`` displacements those near the one that most are near to; of two such the smaller counts."""
    near = np.linalg.norm(off[:, None] - off, axis=2) <= APART_PX  # never true of NaN
    if not near.any():
        return np.zeros(len(off), dtype=bool)
    size = np.linalg.norm(np.nan_to_num(off), axis=1)
    middle = np.lexsort((size, -near.sum(axis=1)))[0]
    return np.asarray(near[middle])


def _centroid(image: Image, blob: NDArray[np.bool_]) -> tuple[FloatArray, FloatArray]:
    """Middle of a spot of paint, columns and rows, and its mean colour, 0 to 1.

    Of a pixel that mixes paint and what is beside it, how much is paint is told by how far its linear colour is from
    grey in the direction of the paint's.
    """
    rows, columns = np.nonzero(_grown(blob, RIM_PX))
    linear = _DECODED[image[rows, columns]]
    tint = linear - linear.mean(axis=1, keepdims=True)
    inside = blob[rows, columns]
    direction = tint[inside].mean(axis=0)
    length = max(float(np.linalg.norm(direction)), 1e-6)
    along = tint @ (direction / length)
    # What is of another hue is as much less of it.
    aside = np.sqrt(np.maximum((tint**2).sum(axis=1) - along**2, 0.0))
    weight = np.clip(((along - aside) / length - RIM_LEAST) / (RIM_FULL - RIM_LEAST), 0.0, 1.0)
    colour = image[blob].mean(axis=0) / 255.0
    total = weight.sum()
    if total <= 0:
        return np.array([columns[inside].mean(), rows[inside].mean()]), colour
    return np.array([weight @ columns / total, weight @ rows / total]), colour
