"""Trains the network of instrument masks on pictures of which they are known."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from surgbench.config import Count, NotNegative, Positive
from surgbench.trackers.learning.course import Course, CourseSettings
from surgbench.trackers.learning.weights import WEIGHTS
from surgbench.trackers.masks.unet.looks import Pictures
from surgbench.trackers.masks.unet.model import Segmenter, load_network, normalised, save_network
from surgbench.trackers.masks.unet.network import MaskNetwork, NetworkSettings

EDGE_PX = 5


class TrainingSettings(CourseSettings):
    """How the network is trained.

    Attributes:
        looks: How often an epoch shows each picture, every time in another look.
        edge_weight: How much more pixels near an instrument's edge count.
        bfloat16: Whether the network is trained in mixed precision. An epoch then takes two thirds of the time and
            teaches less, for rounding is a third of the first gradients.
    """

    epochs: Count = 32
    patience: Count = 32
    batch: Count = 8
    learning_rate: Positive = 3e-3
    looks: Count = 3
    edge_weight: NotNegative = 2.0
    bfloat16: bool = False


class Training(Course[Pictures]):
    """One training of the network, in a folder; see :class:`Course`."""

    measures: ClassVar[tuple[str, ...]] = ("iou", "worst_iou")

    def _make(self) -> MaskNetwork:
        return MaskNetwork(self._size)

    def _load(self, path: Path) -> tuple[MaskNetwork, NetworkSettings]:
        loaded: tuple[MaskNetwork, NetworkSettings] = load_network(path)
        return loaded

    def _save(self) -> None:
        save_network(self._folder / WEIGHTS, self._network, self._size)

    def _words(self, row: Mapping[str, Any]) -> str:
        return f"IoU {row['iou']}, worst {row['worst_iou']}"

    def _repeats(self) -> int:
        return int(self._settings.looks)

    def _batch_loss(self, examples: Pictures, chosen: Any, rng: np.random.Generator) -> Tensor:
        pictures, masks = examples.looks(chosen, rng)
        batch = normalised(torch.from_numpy(pictures).to(self._device))
        with torch.autocast(self._device, torch.bfloat16, enabled=self._settings.bfloat16):
            logits: Tensor = self._network(batch.contiguous(memory_format=self._format))
        targets = (torch.from_numpy(masks).to(self._device) >= 128).float()
        return mask_loss(logits.float(), targets, self._settings.edge_weight)

    def _validate(self, examples: Pictures) -> tuple[float, dict[str, float | None]]:
        """Whole pictures as they are, as the mask source looks at them."""
        losses, overlaps = [], []
        segmenters: dict[tuple[int, ...], Segmenter] = {}
        for image, mask in zip(examples.images, examples.masks, strict=True):
            height, width = mask.shape
            if (width, height) not in segmenters:
                segmenters[width, height] = Segmenter(self._network, self._size, width, height, self._device)
            logits, truth = segmenters[width, height].logits(image), mask >= 128
            target = torch.from_numpy(truth.astype(np.float32))[None]
            losses.append(float(mask_loss(torch.from_numpy(logits)[None], target, self._settings.edge_weight)))
            overlaps.append(overlap(logits > 0, truth))
        return float(np.mean(losses)), {"iou": float(np.mean(overlaps)), "worst_iou": float(np.min(overlaps))}


def mask_loss(logits: Tensor, target: Tensor, edge_weight: float) -> Tensor:
    """Cross entropy of every pixel, those near an edge weighed more, and 1 less the soft Dice coefficient of the batch.

    The latter (Milletari et al., 3DV 2016) counts instruments as much as what is behind them, however small they are.

    Args:
        logits: ``(n, h, w)`` float32.
        target: The same shape, 0 or 1.
        edge_weight: How much more pixels count within half of ``EDGE_PX`` of an edge.
    """
    mean = functional.avg_pool2d(target[:, None], EDGE_PX, stride=1, padding=EDGE_PX // 2, count_include_pad=False)
    near = ((mean > 0) & (mean < 1))[:, 0].float()
    weight = 1.0 + edge_weight * near
    entropy = functional.binary_cross_entropy_with_logits(logits, target, weight=weight) / weight.mean()
    share = torch.sigmoid(logits)
    dice = (2.0 * (share * target).sum() + 1.0) / (share.sum() + target.sum() + 1.0)
    return entropy + 1.0 - dice


def overlap(found: NDArray[np.bool_], truth: NDArray[np.bool_]) -> float:
    """Intersection over union of two masks; 1 where both are empty."""
    union = int((found | truth).sum())
    return float((found & truth).sum()) / union if union else 1.0
