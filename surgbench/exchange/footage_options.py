"""What importers of frames with masks beside them may be told, and how the two come together."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from surgbench.camera.options import CameraOptions
from surgbench.contract import Mask
from surgbench.exchange.mask_options import MaskOptions
from surgbench.instrument import Instrument, load_instrument
from surgbench.recordings.coding import WHOLE
from surgbench.recordings.frame_masks import FrameMasks
from surgbench.tasks.instrument.footage import BOTH, Shot
from surgbench.tasks.instrument.format import ARMS, Arm, MaskKind

Arms = Literal["left", "right", "both"]
Images = Callable[[Sequence[int]], Iterator[NDArray[np.uint8]]]


class NamedOptions(CameraOptions):
    """Of any recording."""

    name: Annotated[str | None, Field(description="The dataset's name; the recording's unless told.")] = None
    instrument: Annotated[
        str, Field(description="Instrument: a name, or an instrument file; default: large_needle_driver.")
    ] = "large_needle_driver"

    def instruments(self) -> dict[Arm, Instrument]:
        """The same one for both arms.

        Raises:
            SurgbenchError: It is unknown, or its file is wrong; one line.
        """
        model = load_instrument(self.instrument)
        return dict.fromkeys(ARMS, model)

    def configuration(self, importer: str) -> dict[str, Any]:
        """What the manifest keeps of what was told: all but names, and where files lay."""
        files = {field for field in type(self).model_fields if isinstance(getattr(self, field), Path)}
        left_out = {"name", "instrument", *files}
        return {"importer": importer, **self.model_dump(mode="json", exclude=left_out, exclude_defaults=True)}


class FrameOptions(NamedOptions, MaskOptions):
    """Of frames, and masks that lie beside them."""

    masks: Annotated[
        Path | None, Field(description="Masks: a folder of pictures, a video, or a JSON file of RLE; default: none.")
    ] = None
    masks_from: Annotated[
        int | None, Field(ge=0, description="What the names of the masks call the first frame; default: by their last.")
    ] = None


class Masked:
    """Frames with their masks, as an importer of :class:`FrameOptions` has them.

    Args:
        options: What was told.
        place: Where the masks lie; ``None`` where there are none.
        size: Width and height of the frames.
        numbers: Of the frames, increasing.
        arms: That the recording shows.

    Attributes:
        frames: Places in ``numbers`` of the frames that are kept: those that have a mask, or all.
        kinds: Of the masks.
        lines: What is to be told of them.
    """

    def __init__(
        self,
        options: FrameOptions,
        place: Path | None,
        size: tuple[int, int],
        numbers: Sequence[int],
        arms: tuple[Arm, ...],
    ) -> None:
        self.frames = list(range(len(numbers)))
        self.kinds: tuple[MaskKind, ...] = ()
        self.lines: list[str] = []
        self._masks: FrameMasks | None = None
        if place is None:
            return
        told = options.told(several=len(arms) == 2)
        self._masks = FrameMasks(place, size, told, numbers, options.masks_from)
        self.frames = self._masks.frames
        coding = self._masks.coding
        own = tuple(arm for arm in ARMS if arm in coding.groups)
        self.kinds = own or (arms if len(arms) == 1 else (BOTH,))
        self.lines.append(f"{place.name}: {len(self.frames)} masks, {coding.said}")
        lacking = len(numbers) - len(self.frames)
        if lacking:
            self.lines.append(f"{lacking} of {len(numbers)} frames have no mask, and are left out")
        self.lines += [f"warning: {line}" for line in coding.warnings]

    def shots(self, frames: Sequence[int], images: Images | None) -> Iterator[Shot]:
        """Some of the kept frames.

        Args:
            frames: Their places, increasing.
            images: Gives the images of some places; ``None`` where there are none.
        """
        pictures = iter(()) if images is None else images(frames)
        masks = iter(()) if self._masks is None else self._masks.at(frames)
        for _ in frames:
            shown = {} if self._masks is None else self._by_kind(next(masks))
            yield Shot(shown, None if images is None else next(pictures))

    def _by_kind(self, groups: dict[str, Mask]) -> dict[str, Mask]:
        if WHOLE in groups:
            return {self.kinds[0]: groups[WHOLE]}
        return {kind: groups[kind] for kind in self.kinds}


def arms_shown(arms: Arms, options: MaskOptions) -> tuple[Arm, ...]:
    """The arms that a recording shows, left before right."""
    named = options.told(several=True).instances
    if named:
        return tuple(arm for arm in ARMS if arm in named)
    return ARMS if arms == BOTH else (arms,)
