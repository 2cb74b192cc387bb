"""Masks beside SurgPose, which has none of its own: those of each arm, as a segmenter wrote them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from surgbench.contract import Mask
from surgbench.errors import DatasetError
from surgbench.exchange.footage_options import FrameOptions, Images
from surgbench.recordings.coding import WHOLE
from surgbench.recordings.frame_masks import FrameMasks, picture_size
from surgbench.recordings.surgpose import ARMS
from surgbench.recordings.video import VIDEO_SUFFIXES
from surgbench.tasks.instrument.footage import Shot
from surgbench.tasks.instrument.format import ARMS as OUR_ARMS
from surgbench.tasks.instrument.format import MaskKind


class ArmMasks:
    """What there is of a trajectory: ``PSM1`` and ``PSM3``, each a folder of pictures, a video, or a JSON file of RLE.

    They lie in ``MASKS/<trajectory>`` where ``--masks`` names a folder, else in the trajectory's own. Frames that lack
    a mask of an arm are left out.

    Attributes:
        frames: That are kept.
        kinds: Of the masks; none where there are no masks.
        lines: What is to be told of them.
    """

    def __init__(
        self, options: FrameOptions, folder: Path, name: str, size: tuple[int, int], numbers: Sequence[int]
    ) -> None:
        place = folder if options.masks is None else options.masks / name
        self.frames = list(range(len(numbers)))
        self.lines: list[str] = []
        self._masks: dict[MaskKind, FrameMasks] = {}
        for arm in OUR_ARMS:
            found = _find(place, ARMS[arm])
            if found is None:
                continue
            half = (size[0] // 2, size[1] // 2)
            own = half if getattr(options, "half", False) and picture_size(found) == half else size
            masks = FrameMasks(found, own, options.told(several=False), numbers, options.masks_from)
            if set(masks.coding.groups) != {WHOLE}:
                raise DatasetError(f"{found}: holds the masks of one arm; leave --instances out")
            self._masks[arm] = masks
            self.frames = sorted(set(self.frames) & set(masks.frames))
            self.lines.append(f"{name}/{found.name}: {len(masks.frames)} masks, {masks.coding.said}")
            self.lines += [f"warning: {line}" for line in masks.coding.warnings]
        self.kinds: tuple[MaskKind, ...] = tuple(self._masks)
        if options.masks is not None and not self._masks:
            raise DatasetError(f"{place}: holds neither PSM1 nor PSM3 (folders of pictures, videos, or JSON files)")
        if not self.frames:
            raise DatasetError(f"{place}: no frame has masks of both arms")
        if len(self.frames) < len(numbers):
            self.lines.append(f"{name}: {len(numbers) - len(self.frames)} frames lack a mask, and are left out")

    def shots(self, images: Images) -> Iterator[Shot]:
        """All kept frames."""
        masks = {arm: own.at(self.frames) for arm, own in self._masks.items()}
        for image in images(self.frames):
            shown: dict[str, Mask] = {arm: next(own)[WHOLE] for arm, own in masks.items()}
            yield Shot(shown, image)


def _find(place: Path, name: str) -> Path | None:
    candidates = [place / f"{name}{suffix}" for suffix in ("", *VIDEO_SUFFIXES, ".json")]
    return next((path for path in candidates if path.exists()), None)
