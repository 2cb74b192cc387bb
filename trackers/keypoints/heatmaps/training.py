"""Trains the heatmap network on labelled masks; an interrupted training goes on where its last epoch ended.

Everything random comes from the seed and the number of the epoch, so that a resumed training sees what an uninterrupted
one would have seen.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field
from torch import Tensor
from torch.nn import functional

from surgbench.config import Count, Positive, Section
from surgbench.errors import SurgbenchError
from surgbench.files import sha256_file, write_atomic
from surgbench.geometry import FloatArray
from surgbench.keypoints.accuracy import Accuracy, Outcome, accuracy, pair_errors
from surgbench.randomness import generator, seed_from
from surgbench.report.field import count, number
from surgbench.report.frame import csv_text, to_frame
from surgbench.trackers.keypoints.heatmaps.checkpoint import Progress, keep, resume
from surgbench.trackers.keypoints.heatmaps.model import WEIGHTS, load_network, save_network
from surgbench.trackers.keypoints.heatmaps.network import HeatmapNetwork, NetworkSettings
from surgbench.trackers.keypoints.heatmaps.patches import Patches
from surgbench.trackers.keypoints.heatmaps.peaks import exactly_two, find_peaks

STATE = "training.safetensors"
LOG = "log.csv"
FIELDS = (
    *count("epoch"),
    *number("learning_rate", "training_loss", "validation_loss", "detected_percent", "median_error_px"),
    *number("p95_error_px", "false_pair_percent"),
    *count("seconds"),
)
# A narrower network is trained with its channels first: the gradient of a short cut's weights, a 1 x 1 convolution of
# stride 2, comes out wrong in oneDNN with channels last and fewer than a vector register holds (8 with AVX2, 16 with
# AVX-512), and it writes where it must not (https://github.com/uxlfoundation/oneDNN/issues/6035).
LEAST_CHANNELS_LAST = 16


class TrainingSettings(Section):
    """How the network is trained.

    Attributes:
        epochs: At most so many passes over the masks.
        patience: It stops after so many epochs in which the validation loss did not fall.
        batch: Masks a step.
        learning_rate: Its peak; it rises at first and falls along a cosine (Loshchilov and Hutter, ICLR
            2017).
        warm_up: Share of the steps in which it rises.
        weight_decay: Of AdamW (Loshchilov and Hutter, ICLR 2019).
        sigma_px: Standard deviation of a tip's heat, pixels of the network's picture.
        least_heat: What a peak must reach when the validation masks are measured.
        apart_px: As the detector's.
        bfloat16: Whether the network is trained in mixed precision.
    """

    epochs: Count = 14
    patience: Count = 8
    batch: Count = 64
    learning_rate: Positive = 1.2e-3
    warm_up: Annotated[float, Field(ge=0, le=1)] = 0.1
    weight_decay: Annotated[float, Field(ge=0)] = 0.02
    sigma_px: Positive = 1.25
    least_heat: Annotated[float, Field(gt=0, lt=1)] = 0.36
    apart_px: Annotated[int, Field(ge=1, le=64)] = 2
    bfloat16: bool = True


class Training:
    """One training, in a folder.

    Args:
        folder: Where the best weights so far, the log, and what a resumed training needs are written after every epoch.
        network: Size of the network.
        settings: How it is trained.
        seed: Of the first weights, and of the order and looks of the masks.
        device: ``"cpu"`` or ``"cuda"``.
        identity: What else the result depends on, as JSON can hold it: a folder with another one is not gone on with.
        start: A model of the same size whose weights are the first; random ones unless told.

    Raises:
        SurgbenchError: The folder holds a training with other settings, or a damaged one, or the start is no model of
            this size; one line.
    """

    def __init__(
        self,
        folder: Path,
        network: NetworkSettings,
        settings: TrainingSettings,
        seed: int,
        device: str,
        identity: dict[str, Any],
        start: Path | None = None,
    ) -> None:
        self._folder, self._size, self._settings, self._seed, self._device = folder, network, settings, seed, device
        whole = {"network": network.model_dump(), "training": settings.model_dump(), "seed": seed, **identity}
        if start is not None:
            whole["start"] = sha256_file(start)
        self._identity = json.dumps(whole, sort_keys=True)
        with torch.random.fork_rng():
            torch.manual_seed(seed_from(purpose="first weights", seed=seed) % 2**63)
            self._network = HeatmapNetwork(network)
        if start is not None:
            weights, size = load_network(start)
            if size != network:
                raise SurgbenchError(f"{start}: a network of {size}, not of {network}")
            self._network.load_state_dict(weights.state_dict())
        self._format = torch.channels_last if network.width >= LEAST_CHANNELS_LAST else torch.contiguous_format
        self._network.to(device, memory_format=self._format)
        # The same steps in the same order whatever the learning rate is now: it is set before each.
        self._optimiser = torch.optim.AdamW(self._network.parameters(), lr=0.0, weight_decay=settings.weight_decay)
        self._state = Progress()
        self._log: list[dict[str, Any]] = []
        if (folder / STATE).exists():
            self._state, self._log = resume(folder / STATE, self._identity, self._network, self._optimiser)

    @property
    def epoch(self) -> int:
        """How many epochs are done."""
        return int(self._state.epoch)

    @property
    def done(self) -> bool:
        """Whether all epochs are done, or the validation loss has not fallen for too long."""
        waited = self._state.epoch - 1 - self._state.best_epoch
        return bool(self._state.epoch >= self._settings.epochs or waited >= self._settings.patience)

    def run(
        self, training: Patches, validation: Patches, progress: Callable[[float], None], say: Callable[[str], None]
    ) -> None:
        """Train to the end.

        Args:
            training: What is learnt.
            validation: What says when to stop, and which epoch's weights are kept.
            progress: Told the share of an epoch that was done, so that all add up to the number of epochs.
            say: Told a line after every epoch.

        Raises:
            SurgbenchError: The loss is no longer finite.
        """
        while not self.done:
            begin = time.monotonic()
            rate, loss = self._learn(training, progress)
            validation_loss, found = self._validate(validation)
            if not np.isfinite(loss + validation_loss):
                raise SurgbenchError(
                    f"training diverged in epoch {self._state.epoch + 1}: the loss is not finite; lower learning_rate"
                )
            row = {
                "epoch": self._state.epoch,
                "learning_rate": float(f"{rate:.3g}"),
                "training_loss": round(loss, 4),
                "validation_loss": round(validation_loss, 4),
                "detected_percent": _short(found.detected_percent),
                "median_error_px": _short(found.median_error_px),
                "p95_error_px": _short(found.p95_error_px),
                "false_pair_percent": _short(found.false_pair_percent),
                "seconds": round(time.monotonic() - begin),
            }
            self._log.append(row)
            if validation_loss < self._state.best_loss:
                self._state.best_loss, self._state.best_epoch = validation_loss, self._state.epoch
                save_network(self._folder / WEIGHTS, self._network, self._size)
            self._state.epoch += 1
            self._write_log()
            keep(self._folder / STATE, self._identity, self._network, self._optimiser, self._state, self._log)
            say(
                f"epoch {self._state.epoch}: loss {loss:.3f}, validation {validation_loss:.3f}, "
                f"detected {row['detected_percent']} %, median {row['median_error_px']} px, "
                f"false pairs {row['false_pair_percent']} %"
            )

    def _learn(self, patches: Patches, progress: Callable[[float], None]) -> tuple[float, float]:
        """One pass; the last learning rate and the mean loss."""
        settings = self._settings
        rng = generator(purpose="epoch", seed=self._seed, epoch=self._state.epoch)
        order = rng.permutation(len(patches))
        steps = max(len(order) // settings.batch, 1)
        self._network.train()
        total, rate = 0.0, 0.0
        for step in range(steps):
            rate = self._rate((self._state.epoch * steps + step) / (settings.epochs * steps))
            for group in self._optimiser.param_groups:
                group["lr"] = rate
            chosen = order[step * settings.batch : (step + 1) * settings.batch]
            pictures, tips = patches.looks(chosen, rng)
            loss = self._loss(self._logits(pictures), tips)
            self._optimiser.zero_grad()
            loss.backward()
            self._optimiser.step()
            total += float(loss.detach())
            progress(1.0 / steps)
        return rate, total / steps

    def _rate(self, share: float) -> float:
        """The learning rate when this share of all steps is done."""
        warm_up = self._settings.warm_up
        if share < warm_up:
            return self._settings.learning_rate * (0.04 + 0.96 * share / warm_up)
        turn = np.pi * (share - warm_up) / max(1.0 - warm_up, 1e-9)
        return self._settings.learning_rate * 0.5 * (1.0 + float(np.cos(turn)))

    def _logits(self, pictures: NDArray[np.uint8]) -> Tensor:
        batch = torch.from_numpy(pictures).to(self._device)[:, None].float() / 255.0
        with torch.autocast(self._device, torch.bfloat16, enabled=self._settings.bfloat16):
            logits: Tensor = self._network(batch.contiguous(memory_format=self._format))
        return logits.float()

    def _loss(self, logits: Tensor, tips: FloatArray) -> Tensor:
        """Cross entropy of heat and target, summed over pixels; its mean over masks."""
        target = target_heat(torch.from_numpy(tips).float().to(self._device), logits.shape[-1], self._settings.sigma_px)
        return functional.binary_cross_entropy_with_logits(logits, target, reduction="sum") / len(logits)

    def _validate(self, patches: Patches) -> tuple[float, Accuracy]:
        self._network.eval()
        total, outcomes = 0.0, []
        with torch.inference_mode():
            order = np.arange(len(patches))
            for chosen in np.split(order, range(self._settings.batch, len(order), self._settings.batch)):
                pictures, tips = patches.looks(chosen, None)
                logits = self._logits(pictures)
                total += float(self._loss(logits, tips)) * len(chosen)
                outcomes += [
                    Outcome(bool(patches.asked[index]), self._errors(one, places, float(patches.unit_px[index])))
                    for index, one, places in zip(chosen, logits.cpu().numpy(), tips, strict=True)
                ]
        return total / len(patches), accuracy(outcomes)

    def _errors(self, logits: NDArray[np.float32], tips: FloatArray, unit_px: float) -> FloatArray | None:
        pair = exactly_two(find_peaks(logits, self._settings.least_heat, self._settings.apart_px)[0])
        return None if pair is None else unit_px * pair_errors(pair, tips)

    def _write_log(self) -> None:
        write_atomic(self._folder / LOG, csv_text(to_frame(self._log, FIELDS)).encode())


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


def _short(value: float | None) -> float | None:
    return None if value is None else round(value, 3)
