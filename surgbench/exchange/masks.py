"""Recordings of masks become datasets without ground truth."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import Field

from surgbench.camera.options import CameraOptions
from surgbench.contract import Mask, Plugin
from surgbench.dataset.storage import check_new
from surgbench.errors import ConfigError
from surgbench.exchange.jaws import check_jaws
from surgbench.exchange.mask_options import MaskOptions
from surgbench.geometry import FloatArray
from surgbench.instrument import load_instrument
from surgbench.instrument.arms import load_arm
from surgbench.pictures import as_rgb
from surgbench.recordings.beside import BesideOptions
from surgbench.recordings.coding import WHOLE, Coding, Told, read_coding
from surgbench.recordings.files import read_picture
from surgbench.recordings.folder import Recording, find_masks, open_masks, read_recording, recording_folder
from surgbench.recordings.names import Stamps
from surgbench.recordings.shares import Nearness, Shares
from surgbench.tasks.instrument.footage import BOTH, Footage, Shot
from surgbench.tasks.instrument.format import ARMS, ROBOT_ARM, Arm, MaskKind
from surgbench.tasks.instrument.imported import write_import

SEQUENCE_ID = "000"
# From one picture in a quarter of an hour to what no camera of a robot reaches.
_SLOWEST_FPS, _FASTEST_FPS = 0.001, 100_000.0

Arms = Literal["left", "right", "both"]


def import_masks(
    source: Path,
    out: Path,
    *,
    name: str | None = None,
    fps: float | None = None,
    stamps: Stamps = "auto",
    instrument: str = "large_needle_driver",
    arm: Arms = "left",
    told: Told | None = None,
    single_images: bool = False,
    optics: CameraOptions | None = None,
    beside: BesideOptions | None = None,
    progress: Callable[[float], None] = lambda frames: None,
    say: Callable[[str], None] = lambda line: None,
) -> int:
    """Turn a folder of masks into a dataset without ground truth.

    Args:
        source: Holds ``masks/`` (PNG, JPEG), ``masks.mp4`` or the like, or ``masks.json`` (RLE); a camera file;
            where they exist ``images/``, ``joints.csv`` (:func:`surgbench.recordings.readings.read_joints`) and
            ``tips.csv`` (:func:`surgbench.recordings.tips.read_tips`). Or the file itself that holds the masks.
        out: The dataset's folder: new or empty. It appears when the import is complete.
        name: The dataset's name; the source folder's unless told.
        fps: Frames per second; 30, or as a video says, unless told.
        stamps: What numbers in file names count.
        instrument: Built-in name or instrument file.
        arm: Which arm the masks show; ``both``: two instruments in one mask.
        told: What is known of how the masks are coded; with ``instances`` each arm gets masks of its own.
        single_images: The masks are unrelated: each becomes a sequence of its own with one frame.
        optics: The camera's file, and what it does not say; the one in the folder unless told.
        beside: What ``joints.csv`` and ``tips.csv`` do not say.
        progress: Takes the number of frames just done.
        say: Takes what was made of the recording, line by line; warnings begin with ``warning:``.

    Returns:
        Number of frames.

    Raises:
        SurgbenchError: Something in the source is missing or wrong, ``out`` holds something, or the disk is full;
            one line that names it.
    """
    check_fps(fps)
    told = told or Told(several=arm == BOTH)
    check_new(out)
    model = load_instrument(instrument)
    if told.instances and arm == "right" and "left" in told.instances:
        raise ConfigError("--arms right, and --instances has a left one too; leave --arms away")
    arms = arms_of(arm, told)
    recording = read_recording(
        source, model, optics, beside, arms=arms, single_images=single_images, stamps=stamps, fps=fps
    )
    coding = read_coding(recording.masks, told)
    robot_arm = load_arm((beside or BesideOptions()).robot_arm) if recording.arm_joints is not None else None
    jaws_said = check_jaws(recording, coding, model, arms)
    reading = _Reading(recording, coding, arms)
    count = len(recording.numbers)
    summary = f"{count} masks, {coding.said}"
    write_import(
        out,
        [reading.footage([index], f"{number:06d}") for index, number in enumerate(recording.numbers)]
        if single_images
        else [reading.footage(list(range(count)), SEQUENCE_ID)],
        name=name or recording_folder(source).resolve().name,
        instruments=dict.fromkeys(arms, model),
        configuration={
            "importer": "masks",
            "masks": summary,
            "fps": recording.timing.fps,
            "arm": arm if coding.groups.keys() == {WHOLE} else "-".join(coding.groups),
            "single_images": single_images,
            **(beside.given if beside is not None else {}),
            **({} if robot_arm is None else {ROBOT_ARM: robot_arm.model_dump(mode="json")}),
        },
        progress=progress,
        tell=False,
    )
    for line in (f"{summary}, {reading.shares.said}", *recording.notes, *jaws_said):
        say(line)
    for line in (*coding.warnings, *reading.shares.warnings(one_arm=len(arms) == 1), *reading.nearness.warnings()):
        say(f"warning: {line}")
    return count


class _Reading:
    """Sequences of a recording's frames, which are read once, in order.

    Attributes:
        shares: How much of the masks read so far is instrument.
        nearness: Whether the tips lie where it is.
    """

    def __init__(self, recording: Recording, coding: Coding, arms: tuple[Arm, ...]) -> None:
        self._recording, self._coding, self._arms = recording, coding, arms
        self._kinds: tuple[MaskKind, ...] = (BOTH,) if len(arms) > 1 and coding.groups.keys() == {WHOLE} else arms
        self._pictures = recording.masks.pictures()
        self.shares = Shares()
        self.nearness = Nearness(recording.camera.width, recording.camera.height)

    def footage(self, part: list[int], sequence_id: str) -> Footage:
        """A sequence of some frames, by their places, which come after those of the sequences before."""
        recording = self._recording
        return Footage(
            id=sequence_id,
            camera=recording.camera,
            times_s=recording.timing.times_s[part],
            names=[recording.masks.names[index] for index in part],
            shots=lambda: map(self._shot, part),
            arms=self._arms,
            kinds=self._kinds,
            images=recording.images is not None,
            tips=self._of(recording.tips, part),
            joints=self._of(recording.joints, part),
            arm_joints=self._of(recording.arm_joints, part),
            dt_s=recording.timing.dt_s,
            regular=True,
        )

    def _of(self, values: dict[str, FloatArray] | None, part: list[int]) -> dict[Arm, FloatArray] | None:
        return None if values is None else {arm: values[arm][part] for arm in self._arms}

    def _shot(self, index: int) -> Shot:
        recording = self._recording
        found = self._coding.masks(next(self._pictures))
        self.shares.add(np.logical_or.reduce(list(found.values())), recording.numbers[index])
        for arm, tips in (recording.tips or {}).items():
            self.nearness.add(found[WHOLE if WHOLE in found else arm], tips[index])
        masks: dict[str, Mask] = {kind: found[WHOLE if WHOLE in found else kind] for kind in self._kinds}
        if recording.images is None:
            return Shot(masks)
        camera = recording.camera
        return Shot(masks, as_rgb(read_picture(recording.images[index], camera.width, camera.height)))


def check_fps(fps: float | None) -> None:
    """Refuse what is no number of frames per second.

    Raises:
        ConfigError: It is none.
    """
    if fps is not None and not (math.isfinite(fps) and fps > 0):
        raise ConfigError(f"--fps: must be greater than 0, not {fps:g}")
    if fps is not None and not _SLOWEST_FPS <= fps <= _FASTEST_FPS:
        raise ConfigError(f"--fps: {fps:g} frames per second; plausible is {_SLOWEST_FPS:g} to {_FASTEST_FPS:g}")


def arms_of(arm: Arms, told: Told) -> tuple[Arm, ...]:
    """The arms that a recording's masks show, left before right."""
    if told.instances:
        return tuple(one for one in ARMS if one in told.instances)
    return ARMS if arm == BOTH else (arm,)


class MasksImporter(Plugin):
    """A folder of masks with its camera; what it may hold besides, :func:`import_masks` says."""

    name: ClassVar[str] = "masks"
    summary: ClassVar[str] = (
        "masks/ (PNG, JPEG), masks.mp4 or masks.json and a camera file; images/, joints.csv, tips.csv"
    )
    examples: ClassVar[tuple[str, ...]] = (
        "surgbench import masks recordings/parts --label 10,20,30 --out data/parts",
        "surgbench import masks recordings/two --instances 1=left,2=right --out data/two",
    )

    class Config(MaskOptions, CameraOptions, BesideOptions):
        """Options."""

        name: Annotated[str | None, Field(description="The dataset's name; the source folder's unless told.")] = None
        fps: Annotated[float | None, Field(description="Frames per second; default: 30, or as a video says.")] = None
        stamps: Annotated[
            Stamps, Field(description="What numbers in file names count; auto: frames, or times since 1970.")
        ] = "auto"
        instrument: Annotated[
            str, Field(description="Instrument: a name, or an instrument file; default: large_needle_driver.")
        ] = "large_needle_driver"
        arm: Annotated[
            Arms,
            Field(
                description="Which arm the masks show; both: two instruments in one mask; default: left.",
                json_schema_extra={"option": "arms", "also": "arm"},
            ),
        ] = "left"
        single_images: Annotated[
            bool, Field(description="The masks are unrelated: each becomes a sequence of one frame.")
        ] = False

    def __init__(self, config: Config | None = None) -> None:
        self.config = config or self.Config()

    def frames(self, source: Path) -> int:
        """How many masks there are."""
        check_fps(self.config.fps)
        return len(open_masks(find_masks(source)).numbers)

    def run(self, source: Path, out: Path, progress: Callable[[float], None]) -> list[str]:
        """Make the dataset; returns what was made of the recording, line by line."""
        config, lines = self.config, list[str]()
        import_masks(
            source,
            out,
            name=config.name,
            fps=config.fps,
            stamps=config.stamps,
            instrument=config.instrument,
            arm=config.arm,
            told=self._told(),
            single_images=config.single_images,
            optics=config,
            beside=config,
            progress=progress,
            say=lines.append,
        )
        return lines

    def _told(self) -> Told:
        return self.config.told(several=self.config.arm == BOTH)
