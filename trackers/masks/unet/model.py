"""A trained network of instrument masks on disk, and ready to be asked."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from surgbench.processes.torch_threads import one_thread
from surgbench.trackers.learning.weights import load_weights, save_weights
from surgbench.trackers.masks.unet.network import COARSEST_PX, MaskNetwork, NetworkSettings, Step

FORMAT = "surgbench-instrument-masks-1"


def save_network(path: Path, network: MaskNetwork, settings: NetworkSettings) -> None:
    """Write a network, so that the file is whole or not there at all."""
    save_weights(path, network, FORMAT, settings)


def load_network(path: Path) -> tuple[MaskNetwork, NetworkSettings]:
    """Read a network.

    Returns:
        The network in single precision, ready to be asked (``eval``), and its size.

    Raises:
        SurgbenchError: There is no such file, it is damaged, or holds another network; one line.
    """
    network, settings = load_weights(path, FORMAT, "instrument masks", NetworkSettings, MaskNetwork)
    return network, settings


def input_size(width: int, height: int, settings: NetworkSettings) -> tuple[int, int]:
    """Width and height of the picture that the network looks at, of a camera's: as near as can be to its shape."""
    rows = round(settings.input_px * height / width / COARSEST_PX)
    return settings.input_px, COARSEST_PX * max(rows, 1)


def normalised(pictures: torch.Tensor) -> torch.Tensor:
    """``(n, h, w, 3)`` uint8 as the network takes them, ``(n, 3, h, w)`` float32 from -1 to 1."""
    return pictures.permute(0, 3, 1, 2).float() / 127.5 - 1.0


class Segmenter:
    """Finds what shows of instruments in pictures of one size.

    Args:
        network: Trained; not changed.
        settings: Its size.
        width: Of the camera.
        height: Of the camera.
        device: Where the network is asked.
    """

    def __init__(
        self, network: MaskNetwork, settings: NetworkSettings, width: int, height: int, device: str = "cpu"
    ) -> None:
        fused: Any = without_norms(network)
        self._network = fused.to(device, memory_format=torch.channels_last)
        self._input = input_size(width, height, settings)
        self._size, self._device = (width, height), device

    def logits(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Log-odds that an instrument shows at each pixel.

        Args:
            image: ``(height, width, 3)`` RGB.

        Returns:
            ``(height, width)``.
        """
        # Each pixel of the smaller picture is the mean of what it covers: no pattern of its own comes up.
        small = cv2.resize(image, self._input, interpolation=cv2.INTER_AREA)
        with torch.inference_mode(), one_thread():
            one = normalised(torch.from_numpy(small).to(self._device)[None])
            found = self._network(one.contiguous(memory_format=torch.channels_last))[0].cpu().numpy()
        large: NDArray[np.float32] = cv2.resize(found, self._size, interpolation=cv2.INTER_LINEAR)
        return large


def without_norms(network: MaskNetwork) -> MaskNetwork:
    """A copy whose normalisations are part of the convolutions before them: the same answers in less time."""
    fused = copy.deepcopy(network).eval()
    for step in fused.modules():
        if isinstance(step, Step):
            step.convolution, step.norm = fuse_conv_bn_eval(step.convolution, step.norm), nn.Identity()
    return fused
