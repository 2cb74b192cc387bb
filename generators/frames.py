"""Frames of the instrument task: rendered, corrupted, and written."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from surgbench.camera import Camera
from surgbench.camera.change_of_view import ChangeOfView
from surgbench.dataset.masks import Mask, encode_mask
from surgbench.dataset.writer import DatasetWriter
from surgbench.generators.auxiliary import camera_of
from surgbench.generators.corruption import corrupt
from surgbench.generators.instances import told_apart
from surgbench.generators.looks.pictures import PictureWriter
from surgbench.generators.looks.sequence import EYE, EYE_KINDS, SequenceLook
from surgbench.generators.presets import Corruption, Preset
from surgbench.generators.render import MaskRenderer
from surgbench.generators.sequence import ToldApart
from surgbench.generators.visible import ArmsRenderer
from surgbench.geometry import FloatArray
from surgbench.instrument import Instrument
from surgbench.randomness import generator
from surgbench.tasks.instrument.format import (
    ARMS,
    Arm,
    MaskKind,
    SequenceEntry,
    clean_mask_path,
    observed_path,
    view_folder,
)

KINDS: tuple[MaskKind, ...] = ("left", "right", "both")
VISIBLE_KINDS: tuple[MaskKind, MaskKind] = ("visible_left", "visible_right")


@dataclass(frozen=True)
class Chunk:
    """Frames that one worker renders: consecutive ones of a sequence.

    Attributes:
        entry: The sequence.
        start: First frame.
        states: ``(n, 2, 9)`` true states.
        views: Auxiliary view and arm to ``(n, 4, 4)`` true T_view_cam.
        apart: How the arms are told apart, of the whole sequence; ``None`` where they are not.
        look: What images need, of the whole sequence; ``None`` where there are none.
    """

    entry: SequenceEntry
    start: int
    states: FloatArray
    views: dict[tuple[str, Arm], FloatArray]
    apart: ToldApart | None
    look: SequenceLook | None = None


class FrameWriter:
    """Renders and corrupts frames; one Mitsuba scene per camera and arm, kept over all frames.

    Args:
        preset: Seed, corruption, cameras and what of the arms is wanted.
        instrument: The real one.
        camera: The real one.
        out: The dataset's folder.
        threads: Of Mitsuba; ``None`` leaves them as they are.
        stop: Once true, no further frame is rendered.
        variant: Of Mitsuba, for images.
    """

    def __init__(
        self,
        preset: Preset,
        instrument: Instrument,
        camera: Camera,
        out: Path,
        threads: int | None,
        stop: ctypes.c_bool | None = None,
        variant: str = "scalar_rgb",
    ) -> None:
        self.seed = preset.seed
        self.settings: Corruption = preset.corruption
        self.out = out
        self._stop = stop
        told_apart = preset.instances is not None
        self._arms = ArmsRenderer(instrument, camera, threads, told_apart=told_apart)
        self._auxiliary = [MaskRenderer([instrument], own, threads) for own in camera_of(preset).values()]
        self._pictures = None
        if preset.images is not None:
            third = preset.occluders.third_tool > 0
            self._pictures = PictureWriter(
                preset.images, variant, instrument, camera, preset.dt_s, preset.seed, third=third
            )

    def render(self, chunk: Chunk, progress: Callable[[float], None] = lambda frames: None) -> int:
        """Write a chunk's masks, those that are not there; returns its number of frames."""
        sequence = chunk.entry.id
        writer = DatasetWriter(self.out, chunk_part(sequence, chunk.start))
        for offset, states in enumerate(chunk.states):
            if self._stop is not None and self._stop.value:
                return offset
            frame = chunk.start + offset
            if writer.done(str(frame)) is None:
                about: dict[str, Any] | None = None
                if chunk.apart is None:
                    files = self._frame(sequence, frame, states)
                else:
                    files, about = self._told_apart(sequence, frame, states, chunk.apart)
                for (view, arm), poses in chunk.views.items():
                    own = ChangeOfView(poses[offset]).states(states[ARMS.index(arm)])
                    files |= self._auxiliary_frame(sequence, view, frame, arm, own)
                if chunk.look is not None:
                    files |= self._pictures_of(sequence, frame, states, chunk.look, chunk.apart)
                writer.write(str(frame), files, about)
            progress(1)
        return len(chunk.states)

    def _pictures_of(
        self, sequence: str, frame: int, states: FloatArray, look: SequenceLook, apart: ToldApart | None
    ) -> dict[str, bytes]:
        """A frame's images, and the other eye's masks."""
        assert self._pictures is not None
        third = hidden = None
        if apart is not None:
            third = apart.in_the_way.third_state(frame)
            hidden = apart.in_the_way.hidden(frame, self._arms.camera)
        files: dict[str, bytes] = self._pictures.files(sequence, frame, states, look, third, hidden)
        if look.T_eye_cam is not None:
            seen = ChangeOfView(look.T_eye_cam).states(states.reshape(-1)).reshape(states.shape)
            masks: dict[MaskKind, Mask] = dict(zip(ARMS, self._arms.alone(seen), strict=True))
            masks["both"] = masks["left"] | masks["right"]
            folder = view_folder(sequence, EYE)
            noisy = {kind: self._corrupted(masks[kind], folder, frame, kind) for kind in EYE_KINDS}
            files |= self._files(folder, frame, masks, noisy)
        return files

    def _frame(self, sequence: str, frame: int, states: FloatArray) -> dict[str, bytes]:
        masks: dict[MaskKind, Mask] = dict(zip(ARMS, self._arms.alone(states), strict=True))
        # A ray meets one of the two if it meets either, so that the union needs no rendering of its own.
        masks["both"] = masks["left"] | masks["right"]
        noisy = {kind: self._corrupted(mask, sequence, frame, kind) for kind, mask in masks.items()}
        return self._files(sequence, frame, masks, noisy)

    def _told_apart(
        self, sequence: str, frame: int, states: FloatArray, apart: ToldApart
    ) -> tuple[dict[str, bytes], dict[str, Any]]:
        """A frame's files where what is seen of each arm is told, and how much that is."""
        seen = self._arms.seen(states, apart.in_the_way.third_state(frame))
        clean: dict[MaskKind, Mask] = dict(zip(ARMS, seen.alone, strict=True))
        clean |= {"both": seen.union, **dict(zip(VISIBLE_KINDS, seen.visible, strict=True))}
        hidden = apart.in_the_way.hidden(frame, self._arms.camera)
        shown = {kind: mask & ~hidden for kind, mask in clean.items()}
        if seen.third is not None:
            third = seen.third & ~hidden
            hidden |= seen.third
            shown = {kind: mask & ~third for kind, mask in shown.items()}
            shown["both"] |= third
            if (arm := apart.in_the_way.taken_for(frame)) >= 0:
                shown[VISIBLE_KINDS[arm]] |= third
        noisy = {kind: self._corrupted(mask, sequence, frame, kind) for kind, mask in shown.items()}
        axes: dict[str, str | int] = {"dataset": self.seed, "sequence": sequence, "frame": frame}
        one, other = told_apart(
            np.stack([noisy[kind] for kind in VISIBLE_KINDS]),
            np.stack([shown[kind] for kind in VISIBLE_KINDS]),
            generator(**axes, purpose="instances"),
        )
        pair = (other, one) if apart.swapped[frame] else (one, other)
        noisy |= dict(zip(VISIBLE_KINDS, pair, strict=True))
        shares: dict[str, Any] = dict(zip(ARMS, seen.shares(hidden), strict=True))
        return self._files(sequence, frame, clean, noisy), shares

    def _corrupted(self, mask: Mask, sequence: str, frame: int, kind: str) -> Mask:
        rng = generator(dataset=self.seed, sequence=sequence, frame=frame, kind=kind, purpose="corruption")
        noisy: Mask = corrupt(mask, self.settings, rng)
        return noisy

    def _files(
        self, sequence: str, frame: int, clean: dict[MaskKind, Mask], noisy: dict[MaskKind, Mask]
    ) -> dict[str, bytes]:
        files: dict[str, bytes] = {}
        for kind, mask in clean.items():
            files[clean_mask_path(sequence, kind, frame)] = encode_mask(mask)
            files[observed_path(sequence, kind, frame)] = encode_mask(noisy[kind])
        return files

    def _auxiliary_frame(self, sequence: str, view: str, frame: int, arm: Arm, state: FloatArray) -> dict[str, bytes]:
        mask = self._auxiliary[0].mask(state)
        folder = view_folder(sequence, view)
        axes: dict[str, str | int] = {"sequence": sequence, "view": view, "frame": frame, "kind": arm}
        rng = generator(dataset=self.seed, **axes, purpose="corruption")
        return {
            clean_mask_path(folder, arm, frame): encode_mask(mask),
            observed_path(folder, arm, frame): encode_mask(corrupt(mask, self.settings, rng)),
        }


def chunk_part(sequence: str, start: int) -> str:
    """Name of the part of a dataset that a chunk of a sequence's frames is."""
    return f"{sequence}-{start:06d}"
