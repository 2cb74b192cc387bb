"""One sequence as an importer found it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from surgbench.camera import Camera
from surgbench.contract import Mask
from surgbench.errors import DatasetError
from surgbench.geometry import FloatArray
from surgbench.instrument import Instrument
from surgbench.tasks.instrument.format import Arm, AuxiliaryEntry, MaskKind, SequenceEntry

BOTH: Literal["both"] = "both"


@dataclass(frozen=True)
class Shot:
    """What there is of one frame, as the camera saw it.

    Attributes:
        masks: Kind to ``(height, width)``, for each of :attr:`Footage.kinds`.
        image: ``(height, width, 3)`` RGB; ``None`` where there are none.
        clean: As ``masks``, where they are true; the same unless told.
    """

    masks: Mapping[str, Mask] = field(default_factory=dict)
    image: NDArray[np.uint8] | None = None
    clean: Mapping[str, Mask] | None = None


@dataclass(frozen=True)
class SecondView:
    """What a further camera, which stays where it is, saw of a sequence without true states.

    Attributes:
        camera: Lens included.
        T_view_cam: ``(4, 4)`` from the frame of the sequence's camera to this one's, metres.
        masks: Makes an iterator over the masks of all frames: arm to ``(height, width)``, of the arms that the
            sequence has masks of.
        tips: As :attr:`Footage.tips`.
    """

    camera: Camera
    T_view_cam: FloatArray
    masks: Callable[[], Iterator[Mapping[str, Mask]]]
    tips: Mapping[Arm, FloatArray] | None = None


@dataclass(frozen=True)
class Footage:
    """One sequence as an importer found it; pixels are those of its camera, lens included.

    Attributes:
        id: Of the sequence.
        camera: Lens included.
        times_s: ``(frames,)`` increasing.
        names: Of the frames in the recording.
        shots: Makes an iterator over all frames.
        arms: Left before right.
        kinds: Of the shots' masks: arms, or ``both``; none where there are no masks.
        images: Whether the shots have images.
        tips: Arm to ``(frames, 2, 2)``, NaN where missing; ``None`` where there are none.
        joints: Arm to ``(frames, 3)`` readings, likewise.
        arm_joints: Arm to ``(frames, 6)`` readings, likewise.
        labels: Name to arm to ``(frames, 2)`` marked points.
        states: Arm to ``(frames, 9)`` true states.
        views: Name to what a further camera saw.
        speed: How fast the instruments move.
        halved: The dataset has pictures of half the size.
        dt_s: Seconds from frame to frame where there are no two, or where they are ``regular``; else the median counts.
        regular: ``dt_s`` is known better than from the times.
    """

    id: str
    camera: Camera
    times_s: FloatArray
    names: Sequence[str]
    shots: Callable[[], Iterator[Shot]]
    arms: tuple[Arm, ...]
    kinds: tuple[MaskKind, ...] = ()
    images: bool = False
    tips: Mapping[Arm, FloatArray] | None = None
    joints: Mapping[Arm, FloatArray] | None = None
    arm_joints: Mapping[Arm, FloatArray] | None = None
    labels: Mapping[str, Mapping[Arm, FloatArray]] = field(default_factory=dict)
    states: Mapping[Arm, FloatArray] | None = None
    views: Mapping[str, SecondView] = field(default_factory=dict)
    speed: Literal["nominal", "fast"] = "nominal"
    halved: bool = False
    dt_s: float = 1.0 / 30.0
    regular: bool = False

    @property
    def all_kinds(self) -> tuple[MaskKind, ...]:
        """Of the masks that are written: with two arms their union too."""
        return (*self.kinds, BOTH) if len(self.kinds) == 2 else self.kinds

    def entry(self, names: Mapping[Camera, str], instruments: Mapping[Arm, Instrument]) -> SequenceEntry:
        """What the manifest says of it.

        Args:
            names: Of the cameras of what is written.
            instruments: Of each arm.
        """
        steps = np.diff(self.times_s)
        return SequenceEntry(
            id=self.id,
            frames=len(self.times_s),
            dt_s=float(np.median(steps)) if len(steps) and not self.regular else self.dt_s,
            speed=self.speed,
            camera=names[written(self.camera, halved=self.halved)],
            arms=self.arms,
            instruments={arm: instruments[arm].name for arm in self.arms},
            kinds=self.all_kinds,
            images=self.images,
            keypoints=self.tips is not None,
            readings=self.joints is not None,
            arm_joints=self.arm_joints is not None,
            labels=tuple(self.labels),
            truth=self.states is not None,
            source_frames=tuple(self.names),
            auxiliary={
                name: AuxiliaryEntry(
                    camera=names[written(view.camera, halved=self.halved)],
                    kinds=self.all_kinds,
                    keypoints=view.tips is not None,
                )
                for name, view in self.views.items()
            },
        )


def written(camera: Camera, *, halved: bool) -> Camera:
    """The camera of what is written of a recording: without a lens, and where asked for of half the size."""
    return half(camera.pinhole) if halved else camera.pinhole


def half(camera: Camera) -> Camera:
    """The camera of pictures whose pixels were joined two by two.

    Raises:
        DatasetError: Its size is odd.
    """
    if camera.width % 2 or camera.height % 2:
        raise DatasetError(f"{camera.width}x{camera.height} pixels cannot be halved; leave --half out")
    changes = {"width": camera.width // 2, "height": camera.height // 2, "fx": camera.fx / 2, "fy": camera.fy / 2}
    return camera.model_copy(update={**changes, "cx": camera.cx / 2 - 0.25, "cy": camera.cy / 2 - 0.25})
