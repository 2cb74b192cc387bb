"""What the trackers of a unit saw, and the silhouettes of their estimates."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from surgbench.camera.change_of_view import ChangeOfView
from surgbench.contract import Mask
from surgbench.geometry import FloatArray
from surgbench.instrument import Instrument
from surgbench.report.drawing import REFERENCE_COLOUR, Colour, Picture, draw_contours, draw_dots, grey, scaled, tint
from surgbench.state import split_arms
from surgbench.tasks.instrument.dataset import InstrumentDataset
from surgbench.tasks.instrument.dataset import Sequence as Recording
from surgbench.tasks.instrument.records import InstrumentRecord
from surgbench.tasks.instrument.seen_masks import SeenMasks, source_of


@dataclass
class Shot:
    """One tracker's estimates on one unit.

    Attributes:
        record: Where they are from.
        title: The row id, with the variant where ids are not enough.
        colour: Of its contours.
    """

    record: InstrumentRecord
    title: str
    colour: Colour
    _places: dict[int, int] = field(init=False)

    def __post_init__(self) -> None:
        self._places = {index: place for place, index in enumerate(self.record.frames.index)}

    def state(self, frame: int) -> list[float] | None:
        """Estimate of a frame, ``None`` where the tracker got no further."""
        place, states = self._places.get(frame), self.record.frames.state
        return None if place is None or place >= len(states) else states[place]

    def mask_error(self, frame: int) -> float | None:
        """``1 - IoU`` of a frame, from the record."""
        place, values = self._places.get(frame), self.record.errors.get("mask_error")
        if place is None or values is None or np.isnan(values[place]).any():
            return None
        return float(np.mean(values[place]))


class Window(NamedTuple):
    """A rectangle of the picture, pixels."""

    left: int
    top: int
    width: int
    height: int


class Scenery:
    """What the trackers of one unit saw, and the silhouettes of their estimates.

    Args:
        dataset: The dataset that the unit is of.
        record: A run on it, whose masks are drawn where no other run is told.
        view: Auxiliary view to look from; the endoscope unless told.
    """

    def __init__(self, dataset: InstrumentDataset, record: InstrumentRecord, view: str | None = None) -> None:
        from surgbench.silhouette import SilhouetteEvaluator

        spec = record.spec
        self.recording: Recording = dataset.sequence(spec.sequence)
        self.kind = spec.mask_kind
        self._arms = [arm for arm in self.recording.arms if arm in spec.arms]
        named = self.recording.entry.instruments
        self.instruments: list[Instrument] = [dataset.instrument(named[arm]) for arm in self._arms]
        self._auxiliary = None if view is None else self.recording.auxiliary(view)
        self.camera = self.recording.camera if self._auxiliary is None else self._auxiliary.camera
        self._dataset, self._record = dataset, record
        self._seen: dict[str, SeenMasks] = {}
        self._evaluator: SilhouetteEvaluator = SilhouetteEvaluator(self.instruments, self.camera)

    @property
    def is_auxiliary(self) -> bool:
        """Whether this is another view than the endoscope's."""
        return self._auxiliary is not None

    def reference(self, frame: int, record: InstrumentRecord | None = None) -> Mask:
        """The mask that a run's tracker saw, empty where there was none.

        Args:
            frame: Which.
            record: The run; the first one unless told.
        """
        run = record or self._record
        source = source_of(run)
        if self._auxiliary is None and source is not None:
            if source not in self._seen:
                self._seen[source] = SeenMasks(self._dataset, run)
            return self._seen[source].mask(frame)
        seen = self._auxiliary or self.recording
        if self.kind not in seen.entry.kinds:
            return np.zeros((self.camera.height, self.camera.width), dtype=bool)
        return seen.mask(self.kind, frame)

    def ground(self, frame: int) -> Picture:
        """The image, or the mask in grey where there is none."""
        image = (self._auxiliary or self.recording).image(frame)
        return grey(self.reference(frame)) if image is None else image

    def points(self, frame: int) -> FloatArray:
        """``(n, 2)`` pixels of what was seen of tips, and of the points that somebody marked."""
        seen: list[FloatArray] = []
        for arm in self._arms:
            if self._auxiliary is not None:
                seen.append(self._auxiliary.keypoints(self.kind, arm)[frame])
                continue
            seen.append(self.recording.keypoints(arm)[frame])
            seen += [marked[frame][None] for marked in self.recording.labels(arm).values()]
        found: FloatArray = np.concatenate(seen)
        known: FloatArray = found[np.isfinite(found).all(axis=1)]
        return known

    def tips(self, state: list[float], frame: int) -> FloatArray:
        """``(n, 2)`` pixels of an estimate's tips that are before the camera."""
        arms = split_arms(self._seen_from_here(state, frame))
        tips = [instrument.tips_cam(arm) for instrument, arm in zip(self.instruments, arms, strict=True)]
        pixels: FloatArray = self.camera.project(np.concatenate(tips))
        return pixels[np.isfinite(pixels).all(axis=1)]

    def silhouette(self, state: list[float], frame: int) -> Mask:
        """What an estimate covers; in an auxiliary view, where that is reported to be."""
        return self._evaluator.mask(self._seen_from_here(state, frame))

    def _seen_from_here(self, state: list[float], frame: int) -> FloatArray:
        T_view_cam = np.eye(4) if self._auxiliary is None else self._auxiliary.T_view_cam(self.kind)[frame]
        seen: FloatArray = ChangeOfView(T_view_cam).states(np.array(state, dtype=np.float64))
        return seen

    @property
    def whole(self) -> Window:
        """The whole picture."""
        return Window(0, 0, self.camera.width, self.camera.height)

    def window(self, frames: Sequence[int]) -> Window:
        """The part of the picture where the reference masks of some frames are, with a margin."""
        seen = np.logical_or.reduce([self.reference(frame) for frame in frames])
        if not seen.any():
            return self.whole
        rows, columns = np.flatnonzero(seen.any(axis=1)), np.flatnonzero(seen.any(axis=0))
        margin = round(SHEET_MARGIN * self.camera.width)
        left, top = max(0, int(columns[0]) - margin), max(0, int(rows[0]) - margin)
        right = min(self.camera.width, int(columns[-1]) + 1 + margin)
        bottom = min(self.camera.height, int(rows[-1]) + 1 + margin)
        return Window(left, top, right - left, bottom - top)

    def panel(
        self, frame: int, shots: Sequence[Shot], scale: float, window: Window | None = None, *, filled: bool = False
    ) -> Picture:
        """One frame with the reference's contour (green, broad) and the estimates' over it (their colours, thin).

        Filled, the estimates are laid over the picture half transparent, with dots at their tips, and only the outline
        of the reference is below them; with no estimate the reference itself is, with dots at what was seen of tips.

        Args:
            frame: Which.
            shots: Whose estimates.
            scale: Pixels of the panel per pixel of the recording.
            window: The part to show; the whole unless told.
            filled: Whether masks are laid over the picture, and points drawn.
        """
        left, top, width, height = window or self.whole
        part = np.s_[top : top + height, left : left + width]
        picture = scaled(self.ground(frame)[part], scale)
        # Where masks are laid over, thin lines will do.
        thickness = max(1, round(picture.shape[1] / 600)) if filled else max(2, round(picture.shape[1] / 400))
        broad = thickness if filled else thickness + 2
        reference = self.reference(frame, shots[0].record if shots else None)
        if filled and not shots:
            tint(picture, reference[part], REFERENCE_COLOUR)
        draw_contours(picture, reference, REFERENCE_COLOUR, broad, scale, (left, top))
        if filled and not shots:
            self._dot(picture, self.points(frame), REFERENCE_COLOUR, scale, (left, top))
        for shot in shots:
            state = shot.state(frame)
            if state is not None:
                silhouette = self.silhouette(state, frame)
                if filled:
                    tint(picture, silhouette[part], shot.colour)
                draw_contours(picture, silhouette, shot.colour, thickness, scale, (left, top))
                if filled:
                    self._dot(picture, self.tips(state, frame), shot.colour, scale, (left, top))
        return picture

    def _dot(self, picture: Picture, pixels: FloatArray, colour: Colour, scale: float, origin: tuple[int, int]) -> None:
        draw_dots(picture, (pixels + 0.5 - origin) * scale - 0.5, colour, max(3, round(picture.shape[1] / 200)))


SHEET_MARGIN = 0.06
