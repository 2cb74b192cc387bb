"""Datasets that networks learn from: made by presets, or a user's own."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, model_validator

from surgbench.cli.progress import progress
from surgbench.config import Count, Section
from surgbench.dataset.open import open_dataset
from surgbench.generation import GenerationPlan, GenerationRequest
from surgbench.generators.dispatch import plan_preset
from surgbench.generators.resumable import generate
from surgbench.processes.pool import ProcessPool
from surgbench.randomness import seed_from


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
            generate(plan, folders[-1], workers=ProcessPool(jobs), say=say, progress=bar)
    return folders


def identities(sources: dict[str, PictureSource], part: str, seed: int) -> dict[str, Any]:
    """What decides the bytes of the pictures, by source: what a preset makes, or the hash of a dataset.

    Raises:
        SurgbenchError: A preset is wrong, or there is no such dataset; one line.
    """
    found: dict[str, Any] = {}
    for name, source in sources.items():
        plan = source.plan(name, part, seed)
        found[name] = open_dataset(str(source.dataset)).hash if plan is None else plan.marker
    return found
