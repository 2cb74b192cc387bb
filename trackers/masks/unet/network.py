"""A small U-Net (Ronneberger et al., MICCAI 2015) in plain PyTorch.

It differs from the published one in that it is narrow, that its first convolution halves the picture, and that its last
one gives four channels, which are rearranged into a mask of the picture's size (Shi et al., CVPR 2016): full resolution
is where most of the time would go.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Annotated, Any

import torch
from pydantic import Field
from torch import Tensor, nn
from torch.nn import functional

from surgbench.config import Section

# Channels of each level, in widths; the first level is half as large as the picture.
LEVELS = (1, 2, 4, 8, 8)
# A picture's sides have to be multiples of this.
COARSEST_PX = 2 ** len(LEVELS)


class NetworkSettings(Section):
    """Size of the network.

    Attributes:
        width: Channels of the first level.
        input_px: Width of the picture that is looked at, a multiple of 32; its height follows from the camera's.
    """

    width: Annotated[int, Field(ge=4, le=64)] = 16
    input_px: Annotated[int, Field(ge=64, le=2048, multiple_of=COARSEST_PX)] = 352


class MaskNetwork(nn.Module):
    """From pictures to masks."""

    def __init__(self, settings: NetworkSettings) -> None:
        super().__init__()
        widths = [settings.width * level for level in LEVELS]
        self.stem = Step(3, widths[0], 5, stride=2)
        self.first = Step(widths[0], widths[0])
        self.down = nn.ModuleList(
            nn.Sequential(Step(before, after, stride=2), Step(after, after)) for before, after in pairwise(widths)
        )
        # Each takes what comes from the coarser level and its own; the first level's are few.
        after = [max(width // 2, settings.width) for width in widths[:-1]]
        below = [*after[1:], widths[-1]]
        self.up = nn.ModuleList(
            Step(coarse + own, out) for coarse, own, out in zip(below, widths[:-1], after, strict=True)
        )
        self.mask = nn.Conv2d(after[0], 4, 3, padding=1)

    def forward(self, pictures: Tensor) -> Tensor:
        """Logits of every pixel.

        Args:
            pictures: ``(n, 3, h, w)`` float32, -1 to 1; sides are multiples of 32.

        Returns:
            ``(n, h, w)`` float32, above 0 where there is rather an instrument.
        """
        features = [self.first(self.stem(pictures))]
        for step in self.down:
            features.append(step(features[-1]))
        merged = features[-1]
        for step, own in zip(reversed(list(self.up)), reversed(features[:-1]), strict=True):
            merged = step(torch.cat([functional.interpolate(merged, scale_factor=2.0, mode="nearest"), own], dim=1))
        return functional.pixel_shuffle(self.mask(merged), 2)[:, 0]


class Step(nn.Module):
    """A convolution, its normalisation, and what is positive of it."""

    def __init__(self, before: int, after: int, size: int = 3, stride: int = 1) -> None:
        super().__init__()
        self.convolution = nn.Conv2d(before, after, size, stride=stride, padding=size // 2, bias=False)
        self.norm: Any = nn.BatchNorm2d(after)

    def forward(self, features: Tensor) -> Tensor:
        """``(n, before, h, w)`` to ``(n, after, h / stride, w / stride)``."""
        return torch.relu(self.norm(self.convolution(features)))
