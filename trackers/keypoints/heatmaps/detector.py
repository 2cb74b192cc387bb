"""From a mask to its tips."""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from surgbench.contract import Mask
from surgbench.geometry import FloatArray
from surgbench.processes.torch_threads import one_thread
from surgbench.trackers.keypoints.heatmaps.network import BasicBlock, HeatmapNetwork, NetworkSettings
from surgbench.trackers.keypoints.heatmaps.peaks import TIPS, exactly_two, find_peaks
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
    """

    def __init__(
        self,
        network: HeatmapNetwork,
        settings: NetworkSettings,
        least_heat: float,
        apart_px: int,
        device: str = "cpu",
    ) -> None:
        self._network = without_norms(network).to(device, memory_format=torch.channels_last)
        self._size, self._least_heat, self._apart_px, self._device = settings.input_px, least_heat, apart_px, device

    def look(self, mask: Mask) -> Look | None:
        """The heatmap of a mask ``(H, W)``; ``None`` where there is no instrument in it."""
        square = find_square(mask)
        if square is None:
            return None
        picture = square.cut(mask, self._size)
        with torch.inference_mode(), one_thread():
            one = torch.from_numpy(picture).to(self._device)[None, None].float() / 255.0
            logits = self._ask(one)
            peaks, heat = self._peaks(logits)
            if self._in_doubt(heat):
                logits = 0.5 * (logits + self._ask(one.flip(-1))[:, ::-1])
                peaks, heat = self._peaks(logits)
        return Look(square, picture, logits, peaks, heat)

    def _ask(self, pictures: torch.Tensor) -> NDArray[np.float32]:
        logits: NDArray[np.float32] = (
            self._network(pictures.contiguous(memory_format=torch.channels_last))[0].cpu().numpy()
        )
        return logits

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
        """Tips ``(2, 2)`` as pixels (u, v) in no particular order; ``None`` where not exactly two stand out."""
        look = self.look(mask)
        if look is None:
            return None
        tips = exactly_two(look.peaks[look.heat >= self._least_heat])
        return None if tips is None else look.square.to_image(tips, self._size)


def without_norms(network: HeatmapNetwork) -> HeatmapNetwork:
    """A copy whose normalisations are part of the convolutions before them: the same answers in less time."""
    fused = copy.deepcopy(network).eval()
    fused.stem = nn.Sequential(_fuse(fused.stem[0], fused.stem[1]), nn.ReLU())
    for block in fused.modules():
        if isinstance(block, BasicBlock):
            block.first, block.first_norm = _fuse(block.first, block.first_norm), nn.Identity()
            block.second, block.second_norm = _fuse(block.second, block.second_norm), nn.Identity()
            if isinstance(block.short_cut, nn.Sequential):
                block.short_cut = _fuse(block.short_cut[0], block.short_cut[1])
    return fused


def _fuse(convolution: Any, norm: Any) -> Any:
    return fuse_conv_bn_eval(convolution, norm)
