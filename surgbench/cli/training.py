"""A training file, and what it makes: masks from the generator, a network of the keypoint source, and its accuracy."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from surgbench.cli.progress import Bar, progress
from surgbench.cli.training_folder import (
    load_file,
    refuse_other_content,
    write_accuracy,
    write_curve,
    write_settings,
)
from surgbench.config import Count, Section
from surgbench.files import sha256_file
from surgbench.generators.tip_masks import TipMasks, TipMaskSettings, in_published_space
from surgbench.instrument import load_instrument
from surgbench.keypoints.accuracy import accuracy, outcome
from surgbench.trackers.keypoints.heatmaps.detector import TipDetector
from surgbench.trackers.keypoints.heatmaps.model import load_network
from surgbench.trackers.keypoints.heatmaps.network import NetworkSettings
from surgbench.trackers.keypoints.heatmaps.patches import cut_patches
from surgbench.trackers.keypoints.heatmaps.training import Training, TrainingSettings
from surgbench.trackers.learning.weights import WEIGHTS

# What the curve shows beside the losses.
SHARES = {"detected_percent": "detected %", "false_pair_percent": "false pair %"}
ERRORS = {"median_error_px": "median error, px", "p95_error_px": "95 % error, px"}


class Counts(Section):
    """How many masks are learnt, how many say when to stop, and how many the accuracy is measured on."""

    training: Count = 60_000
    validation: Count = 1_000
    test: Count = 2_000


class KeypointTraining(Section):
    """A training file; the defaults are those of the model that comes with the package."""

    seed: Annotated[int, Field(ge=0)] = 0
    masks: Counts = Counts()
    data: TipMaskSettings = TipMaskSettings()
    network: NetworkSettings = NetworkSettings()
    training: TrainingSettings = TrainingSettings()

    def part(self, name: str) -> TipMasks:
        """The masks of a part: training or validation, as ``data`` says, or test. No mask or instrument is in two."""
        data = in_published_space(self.data) if name == "test" else self.data
        return TipMasks(data, getattr(self.masks, name), self.seed, name)


def load_training(reference: str, seed: int | None, masks: int | None, epochs: int | None) -> KeypointTraining:
    """A training file by name or path, with the command line's options over it.

    Raises:
        NotFoundError: No such file.
        ConfigError: An unknown key or a wrong value; one line.
    """
    changes = {"seed": seed, "masks.training": masks, "training.epochs": epochs}
    return load_file(KeypointTraining, reference, changes)


def train(
    settings: KeypointTraining, out: Path, start: Path | None, device: str, jobs: int, say: Callable[[str], None]
) -> dict[str, Any]:
    """Make the masks, train, and measure; goes on with an interrupted training of the same settings.

    Returns:
        What is written to ``accuracy.json``.

    Raises:
        SurgbenchError: The folder holds another training or model, ``start`` is no model of this size, there is no such
            instrument, or the training diverges.
    """
    load_instrument(settings.data.instrument)
    refuse_other_content(out)
    size = settings.network.input_px
    identity = {"data": settings.data.model_dump(mode="json"), "masks": settings.masks.model_dump()}
    training = Training(out, settings.network, settings.training, settings.seed, device, identity, start)
    begun = {} if start is None else {"start_sha256": sha256_file(start)}
    write_settings(out, settings.model_dump(mode="json") | begun)
    if training.epoch:
        say(f"{out}: goes on after {training.epoch} epochs")
    if not training.done:
        parts = [settings.part(name) for name in ("training", "validation")]
        with progress("masks", sum(map(len, parts))) as bar:
            learnt, held_out = (cut_patches(part, size, jobs, bar) for part in parts)
        with progress("epochs", settings.training.epochs) as bar:
            bar(training.epoch)
            training.run(learnt, held_out, bar, say)
    write_curve(out, say, training.measures, "validation masks", SHARES, ERRORS)
    network, _ = load_network(out / WEIGHTS)
    heat, apart = settings.training.least_heat, settings.training.apart_px
    detector = TipDetector(network, settings.network, heat, apart, device)
    test = settings.part("test")
    with progress("test masks", len(test)) as bar:
        found = _measure(detector, test, bar)
    result = {"seed": settings.seed, "test_masks": len(test), **found}
    write_accuracy(out, result)
    return result


def _measure(detector: TipDetector, masks: TipMasks, bar: Bar) -> dict[str, Any]:
    outcomes = []
    for example in masks:
        pair = detector.detect(example.mask)
        outcomes.append(outcome(example, None if pair is None else np.asarray(pair)))
        bar(1)
    return accuracy(outcomes).as_dict()
