"""COCO: objects become arms, keypoints become tips and labels."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated, ClassVar

import numpy as np
from pydantic import Field

from surgbench.contract import Plugin
from surgbench.errors import ConfigError, DatasetError
from surgbench.exchange.coco_arms import ArmOptions, ObjectArms
from surgbench.exchange.footage_options import NamedOptions
from surgbench.exchange.masks import check_fps
from surgbench.geometry import FloatArray
from surgbench.pictures import as_rgb
from surgbench.recordings.coco_dataset import (
    CocoDataset,
    CocoImage,
    read_coco,
)
from surgbench.recordings.endovis import label_name
from surgbench.recordings.files import read_picture
from surgbench.recordings.json_file import find_json
from surgbench.recordings.names import Timing, time_of_frames
from surgbench.tasks.instrument.footage import Footage, Shot
from surgbench.tasks.instrument.format import Arm
from surgbench.tasks.instrument.imported import write_import


class CocoImporter(Plugin):
    """A COCO dataset: masks as polygons or RLE, keypoints, pictures."""

    name: ClassVar[str] = "coco"
    summary: ClassVar[str] = "COCO: annotations.json (polygons or RLE, keypoints), pictures, camera.json"
    examples: ClassVar[tuple[str, ...]] = (
        "surgbench import coco annotations.json --camera camera.json --categories driver=left,scissors=right --out d",
    )

    class Config(NamedOptions, ArmOptions):
        """Options."""

        fps: Annotated[
            float | None, Field(description="Frames per second; default: 30, or as names that are times.")
        ] = None
        images: Annotated[
            Path | None, Field(description="FOLDER that file_name begins in; default: that of the file, or above it.")
        ] = None
        without_images: Annotated[bool, Field(description="Leave pictures out.")] = False
        tips: Annotated[
            str | None, Field(description="NAMES of the two keypoints that are tips; default: those called tip.")
        ] = None

    def __init__(self, config: Config | None = None) -> None:
        self.config = config or self.Config()

    def frames(self, source: Path) -> int:
        """How many images there are."""
        check_fps(self.config.fps)
        return sum(map(len, self._read(source).sequences.values()))

    def run(self, source: Path, out: Path, progress: Callable[[float], None]) -> list[str]:
        """Make the dataset; returns what was made of it, line by line."""
        config, lines = self.config, list[str]()
        check_fps(config.fps)
        dataset = self._read(source)
        kind_of = ObjectArms(dataset, config)
        tips = self._tips(dataset)
        if dataset.labels and tips is None:
            lines.append(
                f"keypoints {', '.join(dataset.labels)}: none are called tips; --tips NAME,NAME says which are"
            )
        footages = []
        for name, images in dataset.sequences.items():
            footages.append(self._footage(dataset, name, images, kind_of, tips, lines))
        said = write_import(
            out,
            footages,
            name=config.name or dataset.path.resolve().parent.name,
            instruments=config.instruments(),
            configuration=config.configuration(self.name),
            progress=progress,
        )
        return [*lines, *said]

    @staticmethod
    def _read(source: Path) -> CocoDataset:
        return read_coco(find_json(source, "coco", "annotations.json", folders=(".", "annotations")))

    def _footage(
        self,
        dataset: CocoDataset,
        name: str,
        images: list[CocoImage],
        kind_of: ObjectArms,
        tips: tuple[str, str] | None,
        lines: list[str],
    ) -> Footage:
        config, folder = self.config, dataset.path.parent
        sizes = {image.size for image in images}
        if len(sizes) > 1:
            raise DatasetError(f"{dataset.path}: sequence '{name}': images are of {len(sizes)} different sizes")
        camera = config.read(folder, images[0].size, lines.append)
        pictures = None if config.without_images else self._pictures(folder, images)
        told = [image.time_s for image in images if image.time_s is not None]
        if config.fps is None and 1 < len(told) == len(images) and (np.diff(told) > 0).all():
            timing = Timing(np.array(told) - told[0], float(np.median(np.diff(told))), None)
        else:
            timing = time_of_frames([image.number for image in images], dataset.path, "auto", config.fps)
        if timing.said is not None:
            lines.append(f"{name}: {timing.said}")
        labels = kind_of.points(images, hidden=True)
        seen = kind_of.points(images, hidden=False)

        def shots() -> Iterator[Shot]:
            for place, image in enumerate(images):
                picture = None if pictures is None else read_picture(pictures[place], camera.width, camera.height)
                yield Shot(kind_of.masks(image), None if picture is None else as_rgb(picture))

        return Footage(
            id=name,
            camera=camera,
            times_s=timing.times_s,
            names=[Path(image.name).stem for image in images],
            shots=shots,
            arms=kind_of.arms,
            kinds=kind_of.kinds,
            images=pictures is not None,
            tips=tips_of(seen, tips, kind_of.arms),
            labels=labels,
            dt_s=timing.dt_s,
        )

    def _pictures(self, folder: Path, images: list[CocoImage]) -> list[Path] | None:
        told = self.config.images
        places = [told] if told is not None else [folder, folder / "images", folder.parent, folder.parent / "images"]
        for place in places:
            there = [(place / image.name).is_file() for image in images]
            if all(there):
                return [place / image.name for image in images]
            if any(there) or told is not None:
                missing = images[there.index(False)].name
                raise DatasetError(f"{place / missing}: missing; --without-images leaves pictures out")
        return None

    def _tips(self, dataset: CocoDataset) -> tuple[str, str] | None:
        told = self.config.tips
        names = dataset.labels
        if told is None:
            called = [name for name in names if "tip" in name]
            return (called[0], called[1]) if len(called) == 2 else None
        wanted = [label_name(part.strip()) for part in told.split(",")]
        if len(set(wanted)) != 2 or not set(wanted) <= set(names):
            raise ConfigError(f"--tips: must be two of the keypoints {', '.join(names) or '(there are none)'}")
        return wanted[0], wanted[1]


def tips_of(
    points: dict[str, dict[Arm, FloatArray]], tips: tuple[str, str] | None, arms: tuple[Arm, ...]
) -> dict[Arm, FloatArray] | None:
    """``(frames, 2, 2)`` of each arm; ``None`` where there are none."""
    if tips is None or not points:
        return None
    return {arm: np.stack([points[tip][arm] for tip in tips], axis=1) for arm in arms}
