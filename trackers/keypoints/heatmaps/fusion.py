"""A trained network's normalisations as part of the convolutions before them."""

from __future__ import annotations

import copy
from typing import Any

from torch import nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from surgbench.trackers.keypoints.heatmaps.network import BasicBlock, HeatmapNetwork


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
