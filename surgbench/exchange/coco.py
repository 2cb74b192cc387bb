"""COCO: objects become arms, keypoints become tips and labels."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, ClassVar

import numpy as np
from pydantic import Field

from surgbench.contract import Mask, Plugin
from surgbench.errors import ConfigError, DatasetError
from surgbench.exchange.footage_options import Arms, NamedOptions
from surgbench.exchange.masks import check_fps
from surgbench.geometry import FloatArray
from surgbench.pictures import as_rgb
from surgbench.recordings.coco_dataset import (
    TRACK_KEYS,
    CocoDataset,
    CocoImage,
    by_name_or_id,
    find_coco,
    read_coco,
)
from surgbench.recordings.endovis import label_name
from surgbench.recordings.files import read_picture
from surgbench.recordings.names import time_of_frames
from surgbench.tasks.instrument.footage import Footage, Shot
from surgbench.tasks.instrument.format import ARMS, Arm, MaskKind
from surgbench.tasks.instrument.imported import write_import
from surgbench.tasks.instrument.recorded import BOTH

# What surgbench's own export says of an object.
ARM_KEY = "arm"


class CocoImporter(Plugin):
    """A COCO dataset: masks as polygons or RLE, keypoints, pictures."""

    name: ClassVar[str] = "coco"
    summary: ClassVar[str] = "COCO: annotations.json (polygons or RLE, keypoints), pictures, camera.json"
    examples: ClassVar[tuple[str, ...]] = (
        "surgbench import coco annotations.json --camera camera.json --categories driver=left,scissors=right --out data",
    )

    class Config(NamedOptions):
        """Options."""

        fps: Annotated[
            float | None, Field(description="Frames per second; default: 30, or as names that are times.")
        ] = None
        images: Annotated[
            Path | None, Field(description="FOLDER that file_name begins in; default: that of the file, or above it.")
        ] = None
        without_images: Annotated[bool, Field(description="Leave pictures out.")] = False
        categories: Annotated[
            str | None, Field(description="NAMES or ids of each arm's categories, as driver=left,2=right.")
        ] = None
        tracks: Annotated[
            str | None, Field(description="NUMBERS (track_id, instance_id) of each arm's object, as 1=left,2=right.")
        ] = None
        pieces: Annotated[
            bool, Field(description="Several objects of one arm in an image are pieces of one instrument.")
        ] = False
        tips: Annotated[
            str | None, Field(description="NAMES of the two keypoints that are tips; default: those called tip.")
        ] = None
        arm: Annotated[
            Arms,
            Field(
                description="Which arm the only object is; both: all objects are one mask of two; default: left.",
                json_schema_extra={"option": "arms", "also": "arm"},
            ),
        ] = "left"

    def __init__(self, config: Config | None = None) -> None:
        self.config = config or self.Config()

    def frames(self, source: Path) -> int:
        """How many images there are."""
        check_fps(self.config.fps)
        return sum(map(len, read_coco(find_coco(source)).sequences.values()))

    def run(self, source: Path, out: Path, progress: Callable[[float], None]) -> list[str]:
        """Make the dataset; returns what was made of it, line by line."""
        config, lines = self.config, list[str]()
        check_fps(config.fps)
        dataset = read_coco(find_coco(source))
        kind_of = _Kinds(dataset, config)
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
        return [*lines, *kind_of.lines, *said]

    def _footage(
        self,
        dataset: CocoDataset,
        name: str,
        images: list[CocoImage],
        kind_of: _Kinds,
        tips: tuple[str, str] | None,
        lines: list[str],
    ) -> Footage:
        config, folder = self.config, dataset.path.parent
        sizes = {image.size for image in images}
        if len(sizes) > 1:
            raise DatasetError(f"{dataset.path}: sequence '{name}': images are of {len(sizes)} different sizes")
        camera = config.read(folder, images[0].size, lines.append)
        pictures = None if config.without_images else self._pictures(folder, images)
        timing = time_of_frames([image.number for image in images], dataset.path, "auto", config.fps)
        if timing.said is not None:
            lines.append(f"{name}: {timing.said}")
        labels = _labels(dataset, images, kind_of)

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
            tips=None if tips is None else {arm: np.stack([labels[t][arm] for t in tips], 1) for arm in kind_of.arms},
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


class _Kinds:
    """Which arm each object is.

    Args:
        dataset: All objects.
        config: What was told.

    Raises:
        ConfigError: More must be told; one line that names the option.
    """

    def __init__(self, dataset: CocoDataset, config: CocoImporter.Config) -> None:
        self._dataset, self._config = dataset, config
        self.lines: list[str] = []
        objects = dataset.objects
        if not objects:
            raise DatasetError(f"{dataset.path}: holds no annotations")
        self._kind = self._decided(objects)
        found = {kind for one in objects if (kind := self._kind(one)) is not None}
        self.arms: tuple[Arm, ...] = ARMS if BOTH in found else tuple(arm for arm in ARMS if arm in found)
        if not self.arms:
            raise ConfigError(f"{dataset.path}: no object is of either arm; --categories or --tracks says which are")
        shown = any(one.get("segmentation") for one in objects)
        self.kinds: tuple[MaskKind, ...] = () if not shown else (BOTH,) if BOTH in found else self.arms
        for images in dataset.sequences.values():
            for image in images:
                self._check_single(image)

    def of(self, image: CocoImage) -> Iterator[tuple[MaskKind, dict[str, Any]]]:
        """The objects of an image that are instruments."""
        for one in image.objects:
            kind = self._kind(one)
            if kind is not None:
                yield kind, one

    def masks(self, image: CocoImage) -> dict[str, Mask]:
        """An image's mask of each kind."""
        masks = {kind: np.zeros(image.size[::-1], dtype=bool) for kind in self.kinds}
        for kind, one in self.of(image) if self.kinds else ():
            masks[kind] |= self._dataset.mask(image, one)
        return dict(masks)

    def _decided(self, objects: list[dict[str, Any]]) -> Callable[[Mapping[str, Any]], MaskKind | None]:
        config, dataset = self._config, self._dataset
        if config.categories is not None and config.tracks is not None:
            raise ConfigError("--categories and --tracks cannot both tell which arm an object is")
        if config.categories is not None:
            by_category = by_name_or_id(config.categories, "--categories", dataset.categories, ARMS)
            return lambda one: by_category.get(one["category_id"])  # type: ignore[return-value]
        if config.tracks is not None:
            key = next((key for key in TRACK_KEYS if any(key in one for one in objects)), None)
            if key is None:
                raise ConfigError(f"--tracks: objects in {dataset.path} have no {' or '.join(TRACK_KEYS)}")
            tracks = sorted({int(one[key]) for one in objects if key in one})
            by_track = by_name_or_id(config.tracks, "--tracks", dict.fromkeys(tracks, key), ARMS)
            return lambda one: by_track.get(one.get(key, -1))  # type: ignore[return-value]
        if config.arm == BOTH:
            return lambda one: BOTH
        if all(one.get(ARM_KEY) in (*ARMS, BOTH) for one in objects):
            return lambda one: one[ARM_KEY]  # type: ignore[no-any-return]
        used = sorted({one["category_id"] for one in objects})
        if len(used) > 1:
            names = [dataset.categories[number] for number in used]
            raise ConfigError(
                f"{dataset.path}: objects are of {len(names)} categories ({', '.join(names[:8])}); --categories "
                f"{names[0]}=left,{names[1]}=right says which arm each is, --arms both that they are one mask"
            )
        only: Arm = "right" if config.arm == "right" else "left"
        return lambda one: only

    def _check_single(self, image: CocoImage) -> None:
        kinds = [(kind, one["category_id"]) for kind, one in self.of(image)]
        for kind, category in kinds:
            if kind != BOTH and kinds.count((kind, category)) > 1 and not self._config.pieces:
                name = self._dataset.categories[category]
                raise ConfigError(
                    f"{self._dataset.path}: '{image.name}' has {kinds.count((kind, category))} objects '{name}' of one "
                    "arm; --tracks 1=left,2=right tells two instruments apart, --pieces joins parts of one, --arms both "
                    "makes one mask of all"
                )


def _labels(dataset: CocoDataset, images: list[CocoImage], kind_of: _Kinds) -> dict[str, dict[Arm, FloatArray]]:
    """Name to arm to ``(frames, 2)``."""
    if BOTH in kind_of.kinds or not any(one.get("num_keypoints", 1) for one in dataset.objects):
        return {}
    labels = {name: {arm: np.full((len(images), 2), np.nan) for arm in kind_of.arms} for name in dataset.labels}
    for place, image in enumerate(images):
        for kind, one in kind_of.of(image):
            for name, point in dataset.points(one).items():
                if kind == "left" or kind == "right":
                    labels[name][kind][place] = point
    return labels
