"""What trackers are shown of a unit of a dataset, and its truth."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from surgbench.contract import Mask, Observation, Scene, View, no_image
from surgbench.geometry import FloatArray
from surgbench.instrument import Instrument
from surgbench.keypoints.found import Tips
from surgbench.metrics import OUT_OF_VIEW_SHARE
from surgbench.state import STATE_SIZE
from surgbench.tasks.instrument.asked import Masks, Readings
from surgbench.tasks.instrument.dataset import InstrumentDataset, InstrumentUnit, Sequence


class UnitData:
    """A unit's frames as observations, and its truth.

    Args:
        dataset: The dataset.
        unit: One of its units.
        readings: Which joint readings observations hold.
        view: Auxiliary view that observations hold besides the endoscope's.
        masks: Whether the endoscope's view holds, of a pair, ``instances`` besides the union.
        true_masks: Views hold the true masks, of what shows.
    """

    def __init__(
        self,
        dataset: InstrumentDataset,
        unit: InstrumentUnit,
        readings: Readings,
        view: str | None = None,
        masks: Masks = "union",
        *,
        true_masks: bool = False,
    ) -> None:
        self.unit = unit
        self._true_masks = true_masks
        self.sequence: Sequence = dataset.sequence(unit.sequence)
        self.camera = self.sequence.camera
        self.instruments: tuple[Instrument, ...] = tuple(
            dataset.instrument(self.sequence.entry.instruments[arm]) for arm in unit.arms
        )
        self._keypoints = [self.sequence.keypoints(arm) for arm in unit.arms]
        self.truth = self._stack([self.sequence.states(arm) for arm in unit.arms])
        self._joints = self._joint_readings(readings)
        # From the same encoders as the joints' readings, and never better than those.
        self._kinematics = None if readings == "none" else self._stack([self.sequence.kinematics(a) for a in unit.arms])
        self._tells_apart = masks == "instances" and len(unit.arms) == 2
        self._auxiliary = None if view is None else self.sequence.auxiliary(view)
        self._limits = self.scene().joint_limits

    @staticmethod
    def _stack(per_arm: list[FloatArray | None]) -> FloatArray | None:
        """``(T, arms, ...)`` from one ``(T, ...)`` per arm."""
        present = [values for values in per_arm if values is not None]
        return np.stack(present, axis=1) if len(present) == len(per_arm) else None

    def _joint_readings(self, readings: Readings) -> FloatArray | None:
        if readings == "none":
            return None
        if readings == "true":
            return None if self.truth is None else self.truth[:, :, 6:]
        return self._stack([self.sequence.readings(arm) for arm in self.unit.arms])

    @property
    def frames(self) -> int:
        """Number of frames."""
        return self.sequence.frames

    def first_seen(self, frames: int) -> int | None:
        """The first of so many frames in whose mask an instrument shows, where tracking begins; ``None``: in none.

        Without masks it is the first.

        What counts is the mask that trackers see: fewer pixels than :data:`surgbench.metrics.OUT_OF_VIEW_SHARE` of all
        are nothing to start from.
        """
        if not self.has_masks:
            return 0 if frames else None
        for frame in range(frames):
            if self.mask(frame).mean() >= OUT_OF_VIEW_SHARE:
                return frame
        return None

    @property
    def has_masks(self) -> bool:
        """Whether the dataset has masks of the unit; a video alone has none."""
        return self.unit.kind in self.sequence.entry.kinds

    def mask(self, frame: int) -> Mask:
        """The dataset's mask of a frame, or the true one where views hold that; empty where there are none."""
        if not self.has_masks:
            return np.zeros((self.camera.height, self.camera.width), dtype=bool)
        return self.true_mask(frame) if self._true_masks else self.sequence.mask(self.unit.kind, frame)

    def true_mask(self, frame: int) -> Mask:
        """What truly shows of the unit's arms in a frame: of one arm of a pair without what the other one hides.

        Raises:
            DatasetError: There is no truth.
        """
        arms, kinds = self.unit.arms, self.sequence.entry.kinds
        kind = f"visible_{arms[0]}"
        return self.sequence.clean_mask(kind if len(arms) == 1 and kind in kinds else self.unit.kind, frame)

    def scene(self) -> Scene:
        """What stays the same over the sequence."""
        bases = [base for arm in self.unit.arms if (base := self.sequence.T_cam_base(arm)) is not None]
        cameras = [(self.camera, np.eye(4))]
        if self._auxiliary is not None:
            cameras.append((self._auxiliary.camera, self._auxiliary.T_view_cam(self.unit.kind)[0]))
        nothing = (None,) * len(self.unit.arms)
        return Scene(
            instruments=self.instruments,
            views=tuple(
                View(camera, T_view_cam, np.zeros((camera.height, camera.width), dtype=bool), keypoints=nothing)
                for camera, T_view_cam in cameras
            ),
            limits=tuple(instrument.search_limits for instrument in self.instruments),
            dt_s=self.sequence.dt_s,
            arms=len(self.unit.arms),
            speed=self.sequence.speed,
            T_cam_base=np.stack(bases) if bases else None,
        )

    def observation(self, frame: int) -> Observation:
        """What a tracker may know of a frame; ``start`` is the engine's to fill in."""
        keypoints = _seen(self._keypoints, frame)
        image = self.sequence.image_reader(frame) or no_image
        joints = None
        if self._joints is not None and not np.isnan(self._joints[frame]).any():
            clipped = self._limits.clip(self._joints[frame])
            joints = clipped[0] if len(clipped) == 1 else clipped
        kinematics = None
        if self._kinematics is not None and not np.isnan(self._kinematics[frame]).any():
            kinematics = self._kinematics[frame]
        view = View(self.camera, np.eye(4), self.mask(frame), self._alone(frame), keypoints=keypoints, image=image)
        return Observation(
            index=frame,
            timestamp_s=float(self.sequence.timestamps_s[frame]),
            views=(view, *self._further_views(frame)),
            start=np.zeros(STATE_SIZE * len(self.unit.arms)),
            joints=joints,
            kinematics=kinematics,
        )

    def _alone(self, frame: int) -> tuple[Mask, ...] | None:
        kinds = self.sequence.instance_kinds
        if not self._tells_apart or kinds is None:
            return None
        read: Callable[[str, int], Mask] = self.sequence.clean_mask if self._true_masks else self.sequence.mask
        return tuple(read(kind, frame) for kind in kinds)

    def _further_views(self, frame: int) -> tuple[View, ...]:
        view, kind = self._auxiliary, self.unit.kind
        if view is None:
            return ()
        keypoints = _seen([view.keypoints(kind, arm) for arm in self.unit.arms], frame)
        image = view.image_reader(frame) or no_image
        T_view_cam = view.T_view_cam(kind)[frame]
        mask = view.clean_mask(kind, frame) if self._true_masks else view.mask(kind, frame)
        return (View(view.camera, T_view_cam, mask, keypoints=keypoints, image=image),)


def _seen(keypoints: list[FloatArray], frame: int) -> Tips:
    """Of each arm the tips of a frame: both, one where the other is not known, or ``None``."""
    known = [arm[frame][~np.isnan(arm[frame]).any(axis=1)] for arm in keypoints]
    return tuple(tips if len(tips) else None for tips in known)
