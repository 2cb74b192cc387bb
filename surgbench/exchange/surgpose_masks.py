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

    Frames that lack a mask of an arm are left out.

    Args:
        options: What was told of them.
        place: The folder that holds them; the trajectory's own unless one was told, and then there may be none.
        name: The trajectory.
        size: Width and height of the pictures.
        numbers: Of the frames.

    Attributes:
        frames: That are kept.
        kinds: Of the masks; none where there are no masks.
        lines: What is to be told of them.
    """

    def __init__(
        self, options: FrameOptions, place: Path, name: str, size: tuple[int, int], numbers: Sequence[int]
    ) -> None:
        self.place = place
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
        if not self.frames:
            raise DatasetError(f"{place}: no frame has masks of both arms")

    def must_be_there(self) -> None:
        """Where somebody said that they are.

        Raises:
            DatasetError: There are none; one line.
        """
        if not self._masks:
            raise DatasetError(
                f"{self.place}: holds neither PSM1 nor PSM3 (folders of pictures, videos, or JSON files)"
            )

    def keep_as(self, other: ArmMasks) -> None:
        """Keep only frames that another camera's masks have too.

        Raises:
            DatasetError: Those are of other arms, or there is no such frame; one line.
        """
        if other.kinds != self.kinds:
            own, theirs = (" and ".join(ARMS[arm] for arm in one._masks) or "none" for one in (self, other))
            raise DatasetError(f"{other.place}: has masks of {theirs}, {self.place} of {own}; both need the same")
        self.frames = other.frames = sorted(set(self.frames) & set(other.frames))
        if not self.frames:
            raise DatasetError(f"{other.place}: has masks of none of the frames that {self.place} has masks of")

    def masks(self) -> Iterator[dict[str, Mask]]:
        """Of each kept frame, by arm."""
        of_arms = {arm: own.at(self.frames) for arm, own in self._masks.items()}
        for _ in self.frames:
            yield {arm: next(own)[WHOLE] for arm, own in of_arms.items()}

    def shots(self, images: Images) -> Iterator[Shot]:
        """All kept frames."""
        # A video may end early; who writes them counts.
        return (Shot(masks, image) for image, masks in zip(images(self.frames), self.masks(), strict=False))


def _find(place: Path, name: str) -> Path | None:
    candidates = [place / f"{name}{suffix}" for suffix in ("", *VIDEO_SUFFIXES, ".json")]
    return next((path for path in candidates if path.exists()), None)
