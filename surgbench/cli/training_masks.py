"""A training file of the mask source `learned`, and what it makes: pictures, a network, and its accuracy."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field, field_validator

from surgbench.cli.progress import progress
from surgbench.cli.training_folder import (
    load_file,
    refuse_other_content,
    write_accuracy,
    write_curve,
    write_settings,
)
from surgbench.cli.training_pictures import PictureSource, identities, make_pictures
from surgbench.config import Count, Section
from surgbench.errors import SurgbenchError
from surgbench.files import sha256_file
from surgbench.trackers.learning.weights import WEIGHTS
from surgbench.trackers.masks.unet.looks import LookSettings, Pictures
from surgbench.trackers.masks.unet.model import Segmenter, load_network
from surgbench.trackers.masks.unet.network import NetworkSettings
from surgbench.trackers.masks.unet.pictures import pictures
from surgbench.trackers.masks.unet.training import Training, TrainingSettings, overlap

DATA = "data"
OVERLAPS = {"iou": "mean IoU", "worst_iou": "worst IoU"}


class MaskTraining(Section):
    """A training file; the defaults of what is not data are those of the model that comes with the package.

    Attributes:
        seed: Of the pictures, the first weights, and the order and looks of the pictures.
        set: Keys of presets with their values, put over every preset of ``data``.
        data: What is learnt, by name.
        validation: What says when to stop; so many sequences of each preset of ``data`` unless told.
        validation_sequences: See there.
        test: What the accuracy is measured on.
        network: Size of the network.
        looks: How pictures are changed while they are learnt.
        training: How the network is trained.
    """

    seed: Annotated[int, Field(ge=0)] = 0
    set: dict[str, Any] = Field(default_factory=dict)
    data: Annotated[dict[str, PictureSource], Field(min_length=1)]
    validation: dict[str, PictureSource] = Field(default_factory=dict)
    validation_sequences: Count = 2
    test: Annotated[dict[str, PictureSource], Field(min_length=1)]
    network: NetworkSettings = NetworkSettings()
    looks: LookSettings = LookSettings()
    training: TrainingSettings = TrainingSettings()

    @field_validator("data", "validation", "test")
    @classmethod
    def _names(cls, value: dict[str, PictureSource]) -> dict[str, PictureSource]:
        for name in value:
            if not name.replace("-", "").replace("_", "").isalnum():
                raise ValueError(f"'{name}' is no name: letters, digits, - and _")
        return value

    def part(self, name: str) -> dict[str, PictureSource]:
        """The sources of a part: training, validation or test."""
        if name == "test":
            return self.test
        if name == "validation" and self.validation:
            return self.validation
        fewer = {} if name == "training" else {"sequences": self.validation_sequences}
        return {
            key: source
            if source.preset is None
            else source.model_copy(update={**fewer, "set": {**self.set, **source.set}})
            for key, source in self.data.items()
            if name == "training" or source.preset is not None
        }


def load_training(reference: str, changes: Mapping[str, Any]) -> MaskTraining:
    """A training file by name or path, with the command line's options over it.

    Raises:
        NotFoundError: No such file.
        ConfigError: An unknown key or a wrong value; one line.
    """
    return load_file(MaskTraining, reference, changes)


def train(
    settings: MaskTraining, out: Path, start: Path | None, device: str, jobs: int, say: Callable[[str], None]
) -> dict[str, Any]:
    """Make the pictures, train, and measure; goes on with an interrupted training of the same settings.

    Returns:
        What is written to ``accuracy.json``.

    Raises:
        SurgbenchError: The folder holds another training or model, ``start`` is no model of this size, a preset or
            dataset is wrong, or the training diverges; one line.
    """
    refuse_other_content(out, [DATA])
    if not settings.part("validation"):
        raise SurgbenchError("'validation': is needed where 'data' has no preset")
    parts = {name: settings.part(name) for name in ("training", "validation", "test")}
    # Whatever else decides what is learnt; that of the test pictures is not among it.
    shown = {name: identities(parts[name], name, settings.seed) for name in ("training", "validation")}
    identity = {"data": shown, "looks": settings.looks.model_dump(mode="json")}
    training = Training(out, settings.network, settings.training, settings.seed, device, identity, start)
    begun = {} if start is None else {"start_sha256": sha256_file(start)}
    write_settings(out, settings.model_dump(mode="json") | begun)
    if training.epoch:
        say(f"{out}: goes on after {training.epoch} epochs")

    def made(part: str) -> list[Path]:
        return make_pictures(parts[part], part, settings.seed, out / DATA, jobs, say)

    if not training.done:
        learnt, held_out = (_read(made(part), settings) for part in ("training", "validation"))
        with progress("epochs", settings.training.epochs) as bar:
            bar(training.epoch)
            training.run(learnt, held_out, bar, say)
    write_curve(out, say, training.measures, "validation pictures", OVERLAPS)
    result: dict[str, Any] = {"seed": settings.seed}
    for name, folder in zip(parts["test"], made("test"), strict=True):
        result[name] = measure(out / WEIGHTS, folder, device)
    write_accuracy(out, result)
    return result


def measure(weights: Path, dataset: Path | str, device: str = "cpu") -> dict[str, Any]:
    """How well a model finds instruments in the pictures of a dataset, as the mask source does.

    Args:
        weights: The model.
        dataset: Its folder.
        device: Where it is asked.

    Returns:
        ``pictures``: how many; ``iou``: their mean intersection over union; ``worst_iou``, and ``worst``: the least,
        and of which picture.

    Raises:
        SurgbenchError: The model or the dataset is wrong; one line.
    """
    network, size = load_network(weights)
    found: list[tuple[float, str]] = []
    segmenters: dict[tuple[int, ...], Segmenter] = {}
    for picture in pictures(dataset):
        height, width = picture.mask.shape
        if (width, height) not in segmenters:
            segmenters[width, height] = Segmenter(network, size, width, height, device)
        logits = segmenters[width, height].logits(picture.image)
        found.append((overlap(logits > 0, picture.mask), picture.name))
    worst = min(found)
    return {
        "pictures": len(found),
        "iou": round(float(np.mean([value for value, _ in found])), 4),
        "worst_iou": round(worst[0], 4),
        "worst": worst[1],
    }


def _read(folders: Iterable[Path], settings: MaskTraining) -> Pictures:
    """All pictures of datasets, in memory."""
    shown = [picture for folder in folders for picture in pictures(folder)]
    return Pictures(
        [picture.image for picture in shown],
        [np.where(picture.mask, np.uint8(255), np.uint8(0)) for picture in shown],
        settings.network.input_px,
        settings.looks,
    )
