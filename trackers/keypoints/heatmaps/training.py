"""Trains the heatmap network on labelled masks."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field
from torch import Tensor
from torch.nn import functional

from surgbench.config import Positive
from surgbench.geometry import FloatArray
from surgbench.keypoints.accuracy import Outcome, accuracy, pair_errors
from surgbench.trackers.keypoints.heatmaps.model import load_network, save_network
from surgbench.trackers.keypoints.heatmaps.network import HeatmapNetwork, NetworkSettings
from surgbench.trackers.keypoints.heatmaps.patches import Patches
from surgbench.trackers.keypoints.heatmaps.peaks import exactly_two, find_peaks
from surgbench.trackers.learning.course import Course, CourseSettings
from surgbench.trackers.learning.weights import WEIGHTS


class TrainingSettings(CourseSettings):
    """How the network is trained.

    Attributes:
        sigma_px: Standard deviation of a tip's heat, pixels of the network's picture.
        least_heat: What a peak must reach when the validation masks are measured.
        apart_px: As the detector's.
        bfloat16: Whether the network is trained in mixed precision.
    """

    sigma_px: Positive = 1.25
    least_heat: Annotated[float, Field(gt=0, lt=1)] = 0.36
    apart_px: Annotated[int, Field(ge=1, le=64)] = 2
    bfloat16: bool = True


class Training(Course[Patches]):
    """One training of the network, in a folder; see :class:`Course`."""

    measures: ClassVar[tuple[str, ...]] = (
        "detected_percent",
        "median_error_px",
        "p95_error_px",
        "false_pair_percent",
    )

    def _make(self) -> HeatmapNetwork:
        return HeatmapNetwork(self._size)

    def _load(self, path: Path) -> tuple[HeatmapNetwork, NetworkSettings]:
        loaded: tuple[HeatmapNetwork, NetworkSettings] = load_network(path)
        return loaded

    def _save(self) -> None:
        save_network(self._folder / WEIGHTS, self._network, self._size)

    def _words(self, row: Mapping[str, Any]) -> str:
        return (
            f"detected {row['detected_percent']} %, median {row['median_error_px']} px, "
            f"false pairs {row['false_pair_percent']} %"
        )

    def _batch_loss(self, examples: Patches, chosen: Any, rng: np.random.Generator) -> Tensor:
        pictures, tips = examples.looks(chosen, rng)
        return self._loss(self._logits(pictures), tips)

    def _logits(self, pictures: NDArray[np.uint8]) -> Tensor:
        batch = torch.from_numpy(pictures).to(self._device)[:, None].float() / 255.0
        with torch.autocast(self._device, torch.bfloat16, enabled=self._settings.bfloat16):
            logits: Tensor = self._network(batch.contiguous(memory_format=self._format))
        return logits.float()

    def _loss(self, logits: Tensor, tips: FloatArray) -> Tensor:
        """Cross entropy of heat and target, summed over pixels; its mean over masks."""
        target = target_heat(torch.from_numpy(tips).float().to(self._device), logits.shape[-1], self._settings.sigma_px)
        return functional.binary_cross_entropy_with_logits(logits, target, reduction="sum") / len(logits)

    def _validate(self, examples: Patches) -> tuple[float, dict[str, float | None]]:
        total, outcomes = 0.0, []
        for chosen in self._batches(examples):
            pictures, tips = examples.looks(chosen, None)
            logits = self._logits(pictures)
            total += float(self._loss(logits, tips)) * len(chosen)
            outcomes += [
                Outcome(bool(examples.asked[index]), self._errors(one, places, float(examples.unit_px[index])))
                for index, one, places in zip(chosen, logits.cpu().numpy(), tips, strict=True)
            ]
        found = accuracy(outcomes)
        return total / len(examples), {name: getattr(found, name) for name in self.measures}

    def _errors(self, logits: NDArray[np.float32], tips: FloatArray, unit_px: float) -> FloatArray | None:
        pair = exactly_two(find_peaks(logits, self._settings.least_heat, self._settings.apart_px)[0])
        return None if pair is None else unit_px * pair_errors(pair, tips)


def target_heat(tips: Tensor, size: int, sigma_px: float) -> Tensor:
    """Heat around tips: Gaussians of height 1; where two overlap, the higher.

    Args:
        tips: ``(n, 2, 2)`` float32, column and row; NaN for a tip outside the image.
        size: Side of the heatmap.
        sigma_px: Standard deviation.

    Returns:
        ``(n, size, size)`` float32.
    """
    steps = torch.arange(size, dtype=torch.float32, device=tips.device)
    # A tip outside the image is too far away to warm anything.
    places = torch.nan_to_num(tips, nan=-1e4)
    across, down = (torch.exp(-0.5 * ((steps - places[..., axis, None]) / sigma_px) ** 2) for axis in (0, 1))
    return (down[..., :, None] * across[..., None, :]).amax(dim=1)
