"""The colours of painted markers as a camera shows them, learned while a sequence goes on."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from surgbench.geometry import FloatArray
from surgbench.instrument.spec import Marker

HUES = 256
# What light, white balance and tone curve may turn a hue by, degrees: unseen yet, and once its own has been learned.
UNSEEN_DEG, SEEN_DEG = 20.0, 13.0
# Hues so near could be taken for one.
ALIKE_DEG = 40.0
# How far from what the gains say a marker's own hue may be learned to be.
LEARNED_DEG = 14.0
# Least saturation: of that which is expected, and in any case.
LEAST_SHARE, LEAST_SATURATION = 0.6, 0.3
# Of a colour's channels, those above this share of its brightest tell about the gains; below, stray light counts.
STRONG = 0.12
# Gains are within a few per cent, and a ratio of two channels that is measured is as good as that.
GAIN_SPREAD, RATIO_SPREAD = 0.08, 0.08
# Of what a marker's own hue and saturation were, how much a frame's count, after the first.
RATE = 0.1


def encoded(linear: FloatArray) -> FloatArray:
    """The sRGB curve."""
    return np.asarray(np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 0) ** (1 / 2.4) - 0.055))


def decoded(levels: FloatArray) -> FloatArray:
    """Linear light of sRGB values, 0 to 1."""
    return np.asarray(np.where(levels <= 0.04045, levels / 12.92, ((levels + 0.055) / 1.055) ** 2.4))


def hue_and_saturation(rgb: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Hue, degrees, and saturation of ``(..., 3)`` red, green and blue."""
    most, least = rgb.max(axis=-1), rgb.min(axis=-1)
    chroma = np.where(most > least, most - least, 1.0)
    red, green, blue = np.moveaxis(rgb, -1, 0)
    sextant = np.where(
        most == red,
        (green - blue) / chroma,
        np.where(most == green, 2 + (blue - red) / chroma, 4 + (red - green) / chroma),
    )
    saturation = np.divide(most - least, most, out=np.zeros_like(most), where=most > 0)
    return np.asarray(60.0 * sextant % 360.0), saturation


def turned(hue: ArrayLike, other: ArrayLike) -> FloatArray:
    """From the second hue to the first, -180 to 180 degrees."""
    return np.asarray((np.subtract(hue, other) + 180.0) % 360.0 - 180.0)


class Paint:
    """What each of P colours looks like: as painted, then by the gains of red and blue, then as it was seen.

    Args:
        markers: Those of one instrument.

    Attributes:
        hues: ``(P,)`` degrees, as they are expected now.
        saturations: ``(P,)`` the same.
        seen: ``(P,)`` whether a marker's own has been learned.
    """

    def __init__(self, markers: Sequence[Marker]) -> None:
        self._painted = np.array([marker.colour for marker in markers], dtype=np.float64)
        self._own_hue, self._own_saturation = hue_and_saturation(encoded(self._painted))
        self._linear = np.full_like(self._painted, np.nan)
        self.seen = np.zeros(len(markers), dtype=bool)
        self._expect()

    def learn(self, number: int, rgb: FloatArray) -> None:
        """Take a marker's mean colour in a frame in, red, green and blue as the image has them, 0 to 1."""
        hue, saturation = (one.item() for one in hue_and_saturation(rgb))
        if abs(turned(np.array(hue), self._balanced[number])) > LEARNED_DEG:
            return
        rate = RATE if self.seen[number] else 1.0
        old = self._own_hue[number]
        self._own_hue[number] = (old + rate * turned(np.array(hue), old)) % 360.0
        self._own_saturation[number] += rate * (saturation - self._own_saturation[number])
        linear = decoded(rgb) / max(float(decoded(rgb).max()), 1e-6)
        before = linear if rate == 1.0 else self._linear[number]
        self._linear[number] = before + rate * (linear - before)
        self.seen[number] = True

    def update(self) -> None:
        """What was learned changes what is expected, also of the markers that have not been seen."""
        self._expect()

    def alike(self) -> NDArray[np.float32]:
        """``(P, 256)``: 1 for hues that are like a marker's, as what is beside it may be."""
        levels = np.arange(HUES) * (360.0 / HUES)
        return (np.abs(turned(levels, self.hues[:, None])) <= ALIKE_DEG).astype(np.float32)

    def tables(self) -> tuple[NDArray[np.uint8], FloatArray]:
        """Which hues are of which marker, ``(P, 256)`` 0 or 255, full turn; and ``(P,)`` least saturations.

        A hue that is nearer to another marker's is left out where that one has been seen.
        """
        levels = np.arange(HUES) * (360.0 / HUES)
        off = np.abs(turned(levels, self.hues[:, None]))
        reach = np.where(self.seen, SEEN_DEG, UNSEEN_DEG)[:, None]
        rivals = np.where(self.seen[:, None], off, np.inf)
        own = off <= rivals.min(axis=0) + 180.0 / HUES
        own = (off <= reach) & own
        return np.where(own, 255, 0).astype(np.uint8), np.maximum(LEAST_SHARE * self.saturations, LEAST_SATURATION)

    def _expect(self) -> None:
        self._balanced, saturations = hue_and_saturation(encoded(self._painted * self._gains()))
        self.hues = np.where(self.seen, self._own_hue, self._balanced)
        typical = np.median(self._own_saturation[self.seen] / saturations[self.seen]) if self.seen.any() else 0.85
        self.saturations = np.where(self.seen, self._own_saturation, typical * saturations)

    def _gains(self) -> FloatArray:
        """``(3,)`` gains of red, green and blue, green's being 1: least squares over the ratios of strong channels."""
        rows, logs = [[1 / GAIN_SPREAD, 0.0], [0.0, 1 / GAIN_SPREAD]], [0.0, 0.0]
        for number in np.flatnonzero(self.seen):
            painted, shown = self._painted[number], self._linear[number]
            strong = np.flatnonzero(painted > STRONG * painted.max())
            for one, other in itertools.pairwise(strong):
                ratio = shown[one] / max(shown[other], 1e-6) * painted[other] / painted[one]
                signs = np.zeros(3)
                signs[one], signs[other] = 1.0, -1.0
                rows.append([signs[0] / RATIO_SPREAD, signs[2] / RATIO_SPREAD])
                logs.append(float(np.log(np.clip(ratio, 0.2, 5.0))) / RATIO_SPREAD)
        red, blue = np.linalg.lstsq(np.array(rows), np.array(logs), rcond=None)[0]
        return np.array([np.exp(red), 1.0, np.exp(blue)])
