"""ResNet-18 (He et al., CVPR 2016) with a heatmap head, in plain PyTorch.

The backbone is the published one but for its width, its single input channel, and that it has no classifier. The head
adds its stages up from the coarsest to the finest (feature pyramid of Lin et al., CVPR 2017), down to half the input's
resolution, and rearranges four channels into one heatmap of the input's size (Shi et al., CVPR 2016).
"""

from __future__ import annotations

from typing import Annotated

import torch
from pydantic import Field
from torch import Tensor, nn
from torch.nn import functional

from surgbench.config import Section

STAGES = 4


class NetworkSettings(Section):
    """Size of the network.

    Attributes:
        width: Channels of the first stage; the published ResNet-18 has 64.
        head: Channels of the pyramid.
        input_px: Side of the square picture.
    """

    width: Annotated[int, Field(ge=4, le=256)] = 24
    head: Annotated[int, Field(ge=4, le=256)] = 16
    input_px: Annotated[int, Field(ge=32, le=1024, multiple_of=32)] = 128


class HeatmapNetwork(nn.Module):
    """From pictures of masks to heatmaps of tips."""

    def __init__(self, settings: NetworkSettings) -> None:
        super().__init__()
        width = settings.width
        self.stem = nn.Sequential(
            nn.Conv2d(1, width, 7, stride=2, padding=3, bias=False), nn.BatchNorm2d(width), nn.ReLU()
        )
        widths = [width * 2**stage for stage in range(STAGES)]
        self.stages = nn.ModuleList(
            nn.Sequential(BasicBlock(before, after, 1 if stage == 0 else 2), BasicBlock(after, after, 1))
            for stage, (before, after) in enumerate(zip([width, *widths], widths, strict=False))
        )
        self.lateral = nn.ModuleList(nn.Conv2d(channels, settings.head, 1) for channels in [width, *widths])
        self.smooth = nn.Conv2d(settings.head, settings.head, 3, padding=1)
        self.heat = nn.Conv2d(settings.head, 4, 3, padding=1)
        # Almost nowhere is a tip.
        self.heat.bias = nn.Parameter(torch.full((4,), -4.0))

    def forward(self, pictures: Tensor) -> Tensor:
        """Logits of the heat of every pixel.

        Args:
            pictures: ``(n, 1, s, s)`` float32, 1 in the mask, 0 in the background, 0.5 beyond
                the image.

        Returns:
            ``(n, s, s)`` float32.
        """
        features = [self.stem(pictures)]
        features.append(self.stages[0](functional.max_pool2d(features[0], 3, stride=2, padding=1)))
        for stage in list(self.stages)[1:]:
            features.append(stage(features[-1]))
        merged = self.lateral[-1](features[-1])
        for lateral, feature in zip(reversed(list(self.lateral)[:-1]), reversed(features[:-1]), strict=True):
            merged = functional.interpolate(merged, scale_factor=2.0, mode="nearest") + lateral(feature)
        return functional.pixel_shuffle(self.heat(torch.relu(self.smooth(merged))), 2)[:, 0]


class BasicBlock(nn.Module):
    """Two 3 x 3 convolutions and a short cut."""

    def __init__(self, before: int, after: int, stride: int) -> None:
        super().__init__()
        self.first = nn.Conv2d(before, after, 3, stride=stride, padding=1, bias=False)
        self.first_norm: nn.Module = nn.BatchNorm2d(after)
        self.second = nn.Conv2d(after, after, 3, padding=1, bias=False)
        self.second_norm: nn.Module = nn.BatchNorm2d(after)
        self.short_cut: nn.Module = nn.Identity()
        if stride != 1 or before != after:
            self.short_cut = nn.Sequential(
                nn.Conv2d(before, after, 1, stride=stride, bias=False), nn.BatchNorm2d(after)
            )

    def forward(self, features: Tensor) -> Tensor:
        """``(n, before, h, w)`` to ``(n, after, h / stride, w / stride)``."""
        inner = torch.relu(self.first_norm(self.first(features)))
        return torch.relu(self.second_norm(self.second(inner)) + self.short_cut(features))
