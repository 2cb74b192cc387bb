"""What a recording has in place of truth: in which frames its masks show an instrument, marked tips, joint readings."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from surgbench import metrics
from surgbench.geometry import FloatArray
from surgbench.references import reference_joint_errors, reference_tip_error
from surgbench.tasks.instrument.records import ABSENT, REFERENCE_JOINTS, REFERENCE_KEYPOINTS, REFERENCE_TIPS
from surgbench.tasks.instrument.units import UnitData


def absent_from_masks(data: UnitData, frames: int) -> NDArray[np.bool_]:
    """In which of a unit's first frames the mask shows no instrument, ``(frames, arms)``.

    That is by the share of :data:`surgbench.metrics.OUT_OF_VIEW_SHARE`, so that a few stray pixels are none. In a pair
    each arm's own mask decides where there is one, else the pair's.
    """
    sequence, unit = data.sequence, data.unit
    least = metrics.OUT_OF_VIEW_SHARE * data.camera.width * data.camera.height
    kinds = [arm if arm in sequence.entry.kinds else unit.kind for arm in unit.arms]
    absent = np.zeros((frames, len(kinds)), dtype=bool)
    for frame in range(frames):
        pixels = {kind: int(sequence.mask(kind, frame).sum()) for kind in set(kinds)}
        absent[frame] = [pixels[kind] < least for kind in kinds]
    return absent


def reference_errors(data: UnitData, states: FloatArray, absent: NDArray[np.bool_]) -> dict[str, FloatArray]:
    """Errors against a recording's tips and readings, as far as it has them, and where the instrument is absent.

    Args:
        data: A unit without truth.
        states: ``(T, arms, 9)`` estimates.
        absent: ``(T, arms)``, from :func:`absent_from_masks`; these frames count in no error.

    Returns:
        ``ABSENT`` to ``(T,)`` ones and zeros: 1 where no arm shows. ``REFERENCE_TIPS``, ``REFERENCE_KEYPOINTS`` and
        ``REFERENCE_JOINTS`` to ``(T, arms)``, NaN where there is nothing to be held against; left out where the
        recording has no such thing.
    """
    frames = len(states)
    errors: dict[str, FloatArray] = {ABSENT: np.asarray(absent.all(axis=1), dtype=np.float64)}
    arms = list(zip(data.unit.arms, data.instruments, strict=True))
    if data.sequence.entry.keypoints:
        pairs = [
            tuple(
                places[..., : len(instrument.spec.tips), :]
                for places in (
                    data.camera.project(instrument.tips_cam(states[:, place])),
                    data.sequence.keypoints(arm)[:frames],
                )
            )
            for place, (arm, instrument) in enumerate(arms)
        ]
        for name, error in ((REFERENCE_TIPS, reference_tip_error), (REFERENCE_KEYPOINTS, metrics.keypoint_error)):
            per_arm = [error(estimated, marked) for estimated, marked in pairs]
            errors[name] = np.where(absent, np.nan, np.stack(per_arm, axis=1))
    readings = [data.sequence.readings(arm) for arm in data.unit.arms]
    if all(one is not None for one in readings):
        joints = [
            reference_joint_errors(
                states[:, place], one[:frames], instrument.search_limits, instrument.observed, instrument.symmetry
            )
            for place, ((_, instrument), one) in enumerate(zip(arms, readings, strict=True))
            if one is not None
        ]
        of_all = np.where(absent[..., None], np.nan, np.stack(joints, axis=1))
        errors |= {name: of_all[..., joint] for joint, name in enumerate(REFERENCE_JOINTS)}
    return errors
