"""Pictures with the masks of their instruments, which networks learn from: made by presets, or a user's datasets."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from surgbench.cli.progress import progress
from surgbench.config import Count, Section
from surgbench.contract import Mask
from surgbench.dataset.open import open_as
from surgbench.errors import DatasetError
from surgbench.generation import GenerationPlan, GenerationRequest
from surgbench.generators.dispatch import plan_preset
from surgbench.generators.resumable import generate
from surgbench.randomness import seed_from
from surgbench.tasks.instrument.dataset import InstrumentDataset, Sequence


class PictureSource(Section):
    """Where pictures come from: a preset, or a dataset that is there.

    Attributes:
        preset: Its name, or a file.
        sequences: How many, each of another look.
        frames: Of each.
        set: Keys of the preset with their values, as ``--set`` takes them.
        dataset: The folder of a dataset with images, in place of all that.
    """

    preset: str | None = None
    sequences: Count = 8
    frames: Annotated[int, Field(ge=2)] = 4
    set: dict[str, Any] = Field(default_factory=dict)
    dataset: str | None = None

    @model_validator(mode="after")
    def _one(self) -> PictureSource:
        if (self.preset is None) == (self.dataset is None):
            raise ValueError("needs either 'preset' or 'dataset'")
        if self.dataset is not None and self.model_fields_set - {"dataset"}:
            raise ValueError("'dataset' takes no other key beside it")
        return self

    def plan(self, name: str, part: str, seed: int) -> GenerationPlan | None:
        """What its preset makes for a part of a training; ``None`` of a dataset that is there.

        Args:
            name: Of the source.
            part: No two parts have a look or a motion in common.
            seed: Of the training.

        Raises:
            SurgbenchError: There is no such preset, or a setting has a value that will not do; one line.
        """
        if self.preset is None:
            return None
        drawn = int(seed_from(purpose="training pictures", seed=seed, part=part, source=name) % 2**31)
        told = {"name": f"{part}-{name}", **self.set}
        plan: GenerationPlan = plan_preset(self.preset, GenerationRequest(self.sequences, self.frames, drawn, set=told))
        return plan


@dataclass(frozen=True)
class Picture:
    """A picture and what is to be found in it.

    Attributes:
        image: ``(height, width, 3)`` uint8 RGB.
        mask: ``(height, width)`` bool: where an instrument shows.
        name: Sequence and frame, for messages.
    """

    image: NDArray[np.uint8]
    mask: Mask
    name: str


def make_pictures(
    sources: dict[str, PictureSource], part: str, seed: int, folder: Path, jobs: int, say: Callable[[str], None]
) -> list[Path]:
    """Generate what presets make; what is there already stays, and what is half there is finished.

    Args:
        sources: By name.
        part: Of the training.
        seed: Of the training.
        folder: Where datasets are made, each in a folder of its part and name.
        jobs: Processes.
        say: Told what is going to be made.

    Returns:
        The folders of the datasets, of the user's own too.

    Raises:
        SurgbenchError: As for :func:`surgbench.generators.resumable.generate`.
    """
    folders = []
    for name, source in sources.items():
        plan = source.plan(name, part, seed)
        if plan is None:
            folders.append(Path(str(source.dataset)))
            continue
        folders.append(folder / f"{part}-{name}")
        with progress(f"{part} {name}", plan.frames) as bar:
            generate(plan, folders[-1], jobs=jobs, say=say, progress=bar)
    return folders


def identities(sources: dict[str, PictureSource], part: str, seed: int) -> dict[str, Any]:
    """What decides the bytes of the pictures, by source: what a preset makes, or the hash of a dataset.

    Raises:
        SurgbenchError: A preset is wrong, or there is no such dataset; one line.
    """
    found: dict[str, Any] = {}
    for name, source in sources.items():
        plan = source.plan(name, part, seed)
        found[name] = open_as(InstrumentDataset, str(source.dataset)).hash if plan is None else plan.marker
    return found


def pictures(path: Path | str) -> Iterator[Picture]:
    """The pictures of a dataset, one after the other.

    Raises:
        DatasetError: It has no images, or a file is missing or damaged; one line.
    """
    dataset = open_as(InstrumentDataset, path)
    for sequence in dataset.sequences:
        yield from pictures_of(sequence)


def pictures_of(sequence: Sequence) -> Iterator[Picture]:
    """The pictures of one sequence.

    What shows of the instruments is the truth in generated data, where arms that are not rendered are left out; in a
    recording it is what somebody has marked.

    Raises:
        DatasetError: It has no images, or a file is missing or damaged; one line.
    """
    if not sequence.entry.images:
        raise DatasetError(f"{sequence.root}: sequence '{sequence.id}' has no images to learn from")
    read = sequence.clean_mask if sequence.entry.truth else sequence.mask
    look = sequence.look()
    shown = tuple(look["arms"]) if look is not None else sequence.arms
    kinds: tuple[str, ...] = shown
    if shown == sequence.arms:
        kinds = sequence.instance_kinds or (("both",) if "both" in sequence.entry.kinds else shown)
    for frame in range(sequence.frames):
        image = sequence.image(frame)
        assert image is not None
        masks = [read(kind, frame) for kind in kinds]
        yield Picture(image, np.logical_or.reduce(masks), f"sequence {sequence.id}, frame {frame}")
