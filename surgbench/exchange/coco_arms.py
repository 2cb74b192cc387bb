"""Which arm each object of a COCO dataset is."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from surgbench.config import Section
from surgbench.contract import Mask
from surgbench.errors import ConfigError, DatasetError
from surgbench.exchange.footage_options import Arms
from surgbench.geometry import FloatArray
from surgbench.recordings.coco_dataset import CocoDataset, CocoImage, by_name_or_id
from surgbench.recordings.coco_video import TRACK_KEYS
from surgbench.tasks.instrument.footage import BOTH
from surgbench.tasks.instrument.format import ARMS, Arm, MaskKind

# What surgbench's own export says of an object.
ARM_KEY = "arm"


class ArmOptions(Section):
    """What may be told of them."""

    categories: Annotated[
        str | None, Field(description="NAMES or ids of each arm's categories, as driver=left,2=right.")
    ] = None
    tracks: Annotated[
        str | None, Field(description="NUMBERS (track_id, instance_id) of each arm's object, as 1=left,2=right.")
    ] = None
    pieces: Annotated[
        bool, Field(description="Several objects of one arm in an image are pieces of one instrument.")
    ] = False
    arm: Annotated[
        Arms,
        Field(
            description="Which arm the only object is; both: all objects are one mask of two; default: left.",
            json_schema_extra={"option": "arms", "also": "arm"},
        ),
    ] = "left"


class ObjectArms:
    """Which arm each object is.

    Args:
        dataset: All objects.
        config: What was told.

    Attributes:
        arms: That there are, left before right.
        kinds: Of the masks; none where objects have no masks.

    Raises:
        ConfigError: More must be told; one line that names the option.
    """

    def __init__(self, dataset: CocoDataset, config: ArmOptions) -> None:
        self._dataset, self._config = dataset, config
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
        masks: dict[str, Mask] = {kind: np.zeros(image.size[::-1], dtype=bool) for kind in self.kinds}
        for kind, one in self.of(image) if self.kinds else ():
            masks[kind] |= self._dataset.mask(image, one)
        return masks

    def points(self, images: Sequence[CocoImage], *, hidden: bool) -> dict[str, dict[Arm, FloatArray]]:
        """Keypoints of some images: name to arm to ``(images, 2)``; empty where there are none.

        Args:
            images: In order.
            hidden: Those that are marked though something hides them too.
        """
        dataset = self._dataset
        if BOTH in self.kinds or not any(one.get("keypoints") for one in dataset.objects):
            return {}
        points = {name: {arm: np.full((len(images), 2), np.nan) for arm in self.arms} for name in dataset.labels}
        for place, image in enumerate(images):
            for kind, one in self.of(image):
                for name, point in dataset.points(one, hidden=hidden).items():
                    if kind == "left" or kind == "right":
                        points[name][kind][place] = point
        return points

    def _decided(self, objects: list[dict[str, Any]]) -> Callable[[Mapping[str, Any]], MaskKind | None]:
        config, dataset = self._config, self._dataset
        if config.categories is not None and config.tracks is not None:
            raise ConfigError("--categories and --tracks cannot both tell which arm an object is")
        if config.categories is not None:
            by_category = by_name_or_id(config.categories, "--categories", dataset.categories, ARMS)
            return lambda one: by_category.get(one["category_id"])  # type: ignore[return-value]
        if config.tracks is not None:
            key = _track_key(objects)
            if key is None:
                raise ConfigError(f"--tracks: objects in {dataset.path} have no {' or '.join(TRACK_KEYS)}")
            tracks = {one[key] for one in objects if isinstance(one.get(key), int | str)}
            by_track = by_name_or_id(config.tracks, "--tracks", dict.fromkeys(sorted(tracks, key=str), key), ARMS)
            return lambda one: by_track.get(one.get(key))  # type: ignore[return-value]
        if config.arm == BOTH:
            return lambda one: BOTH
        if all(one.get(ARM_KEY) in (*ARMS, BOTH) for one in objects):
            return lambda one: one[ARM_KEY]
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
                key = _track_key(image.objects) if self._config.tracks is None else None
                first, second, *_ = (*(one.get(key) for one in image.objects if key in one), None, None)
                tracks = "" if second is None else f"--tracks {first}=left,{second}=right tells two instruments apart, "
                raise ConfigError(
                    f"{self._dataset.path}: '{image.name}' has {kinds.count((kind, category))} objects "
                    f"'{self._dataset.categories[category]}' of one arm; {tracks}--pieces joins parts of one, --arms "
                    "both makes one mask of all"
                )


def _track_key(objects: Sequence[Mapping[str, Any]]) -> str | None:
    """What follows objects from image to image, where something does."""
    return next((key for key in TRACK_KEYS if any(key in one for one in objects)), None)
