"""From a mask to its tips."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from surgbench.contract import Mask
from surgbench.geometry import FloatArray
from surgbench.trackers.keypoints.heatmaps.engines import EngineName, make_engine
from surgbench.trackers.keypoints.heatmaps.network import HeatmapNetwork, NetworkSettings
from surgbench.trackers.keypoints.heatmaps.peaks import TIPS, find_peaks
from surgbench.trackers.keypoints.heatmaps.square import Square, find_square

# A peak is doubtful between these shares of the heat that stands out. One mask in ten has one. The answers for the
# picture and for its mirror image, whose instrument is as good as any, differ more where they are wrong: their mean
# takes away a third of the false pairs.
DOUBT = (0.6, 1.5)


@dataclass(frozen=True)
class Look:
    """What the network saw and said.

    Attributes:
        square: Where it looked.
        picture: ``(s, s)`` uint8, what it was given.
        logits: ``(s, s)`` float32.
        peaks: ``(n, 2)`` column and row of the peaks, the hottest first, those that are a little too cold included.
        heat: ``(n,)`` theirs.
    """

    square: Square
    picture: NDArray[np.uint8]
    logits: NDArray[np.float32]
    peaks: FloatArray
    heat: FloatArray


class TipDetector:
    """Finds the two tips in one arm's mask.

    Args:
        network: Trained, in ``eval`` mode; not changed.
        settings: Its size.
        least_heat: What a peak must reach to stand out.
        apart_px: How near a hotter pixel may not be, pixels of the network's picture.
        device: Where the network is asked.
        engine: What works it out there.
        peaks: Of more than two peaks there is no pair (``two``), or the hottest two are one (``top``).
        single_heat: What a peak that stands out alone must exceed to be an answer; 1: never.
    """

    def __init__(
        self,
        network: HeatmapNetwork,
        settings: NetworkSettings,
        least_heat: float,
        apart_px: int,
        device: str = "cpu",
        *,
        engine: EngineName = "torch",
        peaks: Literal["two", "top"] = "two",
        single_heat: float = 1.0,
    ) -> None:
        self._ask = make_engine(engine, network, settings, device)
        self._size, self._least_heat, self._apart_px = settings.input_px, least_heat, apart_px
        self._top, self._single_heat = peaks == "top", single_heat

    def look(self, mask: Mask) -> Look | None:
        """The heatmap of a mask ``(H, W)``; ``None`` where there is no instrument in it."""
        square = find_square(mask)
        if square is None:
            return None
        picture = square.cut(mask, self._size)
        one = picture.astype(np.float32) / np.float32(255.0)
        logits = self._ask(one)
        peaks, heat = self._peaks(logits)
        if self._in_doubt(heat):
            logits = np.float32(0.5) * (logits + self._ask(one[:, ::-1])[:, ::-1])
            peaks, heat = self._peaks(logits)
        return Look(square, picture, logits, peaks, heat)

    def _peaks(self, logits: NDArray[np.float32]) -> tuple[FloatArray, FloatArray]:
        peaks: tuple[FloatArray, FloatArray] = find_peaks(logits, DOUBT[0] * self._least_heat, self._apart_px)
        return peaks

    def _in_doubt(self, heat: FloatArray) -> bool:
        """Whether the mirror image is looked at too: a little more or less heat, and there would be a pair or none."""
        return len(heat) > TIPS or (len(heat) == TIPS and bool(heat[1] < DOUBT[1] * self._least_heat))

    def warm_up(self) -> None:
        """Ask once: the first answers take longer than the others."""
        mask = np.zeros((4 * self._size, 4 * self._size), dtype=bool)
        mask[: 2 * self._size, self._size : 2 * self._size] = True
        for _ in range(3):
            self.detect(mask)

    def detect(self, mask: Mask) -> FloatArray | None:
        """Tips as pixels (u, v) in no particular order, ``(2, 2)`` or ``(1, 2)``; ``None`` without."""
        look = self.look(mask)
        if look is None:
            return None
        count = int((look.heat >= self._least_heat).sum())
        if count == 0 or (count == 1 and look.heat[0] <= self._single_heat) or (count > TIPS and not self._top):
            return None
        return look.square.to_image(look.peaks[: min(count, TIPS)], self._size)
