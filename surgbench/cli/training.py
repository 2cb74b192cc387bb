"""A training file, and what it makes: masks from the generator, a network of the keypoint source, and its accuracy."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from surgbench.cli.progress import Bar, progress
from surgbench.config import Count, Section, locate, parse_model, read_yaml
from surgbench.errors import SurgbenchError
from surgbench.extras import not_installed
from surgbench.files import PARTIAL_SUFFIX, sha256_file, write_atomic
from surgbench.generators.tip_masks import TipMasks, TipMaskSettings, in_published_space
from surgbench.instrument import load_instrument
from surgbench.keypoints.accuracy import accuracy, outcome
from surgbench.trackers.keypoints.heatmaps.curve import draw_curve
from surgbench.trackers.keypoints.heatmaps.detector import TipDetector
from surgbench.trackers.keypoints.heatmaps.model import WEIGHTS, load_network
from surgbench.trackers.keypoints.heatmaps.network import NetworkSettings
from surgbench.trackers.keypoints.heatmaps.patches import cut_patches
from surgbench.trackers.keypoints.heatmaps.training import LOG, STATE, Training, TrainingSettings

CONFIG = "config.json"
ACCURACY = "accuracy.json"
CURVE = "curve.png"


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
    path = locate("training", "training file", reference)
    content = read_yaml(path, "training")
    parse_model(KeypointTraining, content, str(path))
    changed: dict[str, Any] = dict(content)
    if seed is not None:
        changed["seed"] = seed
    if masks is not None:
        changed["masks"] = {**(content.get("masks") or {}), "training": masks}
    if epochs is not None:
        changed["training"] = {**(content.get("training") or {}), "epochs": epochs}
    return parse_model(KeypointTraining, changed, "command line")


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
    _refuse_other_content(out)
    size = settings.network.input_px
    identity = {"data": settings.data.model_dump(mode="json"), "masks": settings.masks.model_dump()}
    training = Training(out, settings.network, settings.training, settings.seed, device, identity, start)
    written = settings.model_dump(mode="json") | ({} if start is None else {"start_sha256": sha256_file(start)})
    config = (json.dumps(written, indent=1) + "\n").encode()
    if (out / WEIGHTS).exists() and not ((out / CONFIG).exists() and (out / CONFIG).read_bytes() == config):
        raise SurgbenchError(f"{out}: holds a model of other settings; give another folder, or remove it")
    write_atomic(out / CONFIG, config)
    if training.epoch:
        say(f"{out}: goes on after {training.epoch} epochs")
    if not training.done:
        parts = [settings.part(name) for name in ("training", "validation")]
        with progress("masks", sum(map(len, parts))) as bar:
            learnt, held_out = (cut_patches(part, size, jobs, bar) for part in parts)
        with progress("epochs", settings.training.epochs) as bar:
            bar(training.epoch)
            training.run(learnt, held_out, bar, say)
    if not draw_curve(out / LOG, out / CURVE):
        say(f"{out / CURVE}: left out, for {not_installed(['matplotlib'])}")
    network, _ = load_network(out / WEIGHTS)
    heat, apart = settings.training.least_heat, settings.training.apart_px
    detector = TipDetector(network, settings.network, heat, apart, device)
    test = settings.part("test")
    with progress("test masks", len(test)) as bar:
        found = _measure(detector, test, bar)
    result = {"seed": settings.seed, "test_masks": len(test), **found}
    write_atomic(out / ACCURACY, (json.dumps(result, indent=1) + "\n").encode())
    return result


def _refuse_other_content(out: Path) -> None:
    """Raise where a folder holds what no training has written."""
    own = {WEIGHTS, CONFIG, ACCURACY, CURVE, LOG, STATE}
    names = sorted(path.name for path in out.iterdir()) if out.is_dir() else []
    strangers = [name for name in names if name not in own and not name.endswith(PARTIAL_SUFFIX)]
    if strangers:
        raise SurgbenchError(f"{out}: holds something else ('{strangers[0]}'); --out needs a new or empty folder")


def _measure(detector: TipDetector, masks: TipMasks, bar: Bar) -> dict[str, Any]:
    outcomes = []
    for example in masks:
        pair = detector.detect(example.mask)
        outcomes.append(outcome(example, None if pair is None else np.asarray(pair)))
        bar(1)
    return accuracy(outcomes).as_dict()
