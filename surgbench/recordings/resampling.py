"""Recorded poses at even times: straight lines and even turns between them, and nothing where there was nothing."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from surgbench.errors import DatasetError
from surgbench.geometry import FloatArray, rigid_transform
from surgbench.recordings.poses import RecordedPoses

# Of one motion: 3.5 hours at 12.6 ms.
MOST_SAMPLES = 1_000_000
# Unless told, time without a pose is a gap from this many of the recording's own steps on, and from this long on.
GAP_STEPS, GAP_S = 5.0, 0.1
# A sample this near to a row, as a share of the step, is at it: what rounding moves times by.
AT_ROW = 1e-6


def usual_gap_s(poses: RecordedPoses) -> float:
    """From how long on time without a pose is a gap, unless that is told."""
    return max(GAP_S, GAP_STEPS * poses.step_s)


def resample(poses: RecordedPoses, dt_s: float, gap_s: float) -> tuple[FloatArray, list[str]]:
    """Poses every ``dt_s``, from the first one on.

    Between two rows the position goes along a straight line and the rotation about one axis at an even rate (slerp).
    Between rows farther apart than ``gap_s`` nothing was measured.

    Args:
        poses: In order.
        dt_s: Seconds between samples.
        gap_s: Longest time between rows that is bridged.

    Returns:
        ``(T, 4, 4)``, NaN within gaps, and what is to be told of them.

    Raises:
        DatasetError: There would be too many, or fewer than two.
    """
    times = poses.times_s
    steps = np.diff(times)
    count = int(np.floor(times[-1] / dt_s + AT_ROW)) + 1
    if count > MOST_SAMPLES or count < 2:
        longest = int(np.argmax(steps))
        samples = "1 sample" if count == 1 else f"{count:,} samples"
        raise DatasetError(
            f"{poses.place}: lasts {times[-1]:.6g} s, {samples} of {dt_s:g} s; a trial has 2 to {MOST_SAMPLES:,} "
            f"(the longest time without a pose is {steps[longest]:.6g} s, after {poses.row} "
            f"{poses.numbers[longest]})"
        )
    wanted = np.minimum(dt_s * np.arange(count), times[-1])
    position = np.stack([np.interp(wanted, times, poses.position_m[:, k]) for k in range(3)], axis=1)
    rotation = Slerp(times, Rotation.from_quat(poses.quaternion))(wanted).as_matrix()
    result = rigid_transform(rotation, position)
    before = np.clip(np.searchsorted(times, wanted, side="right") - 1, 0, len(steps) - 1)
    slack = AT_ROW * dt_s
    inside = (wanted > times[before] + slack) & (wanted < times[before + 1] - slack)
    result[inside & (steps[before] > gap_s + slack)] = np.nan
    wide = np.flatnonzero(steps > gap_s + slack)
    if not len(wide):
        return result, []
    longest = int(wide[np.argmax(steps[wide])])
    gaps = "1 gap" if len(wide) == 1 else f"{len(wide)} gaps"
    line = (
        f"{gaps} longer than {gap_s:g} s, together {steps[wide].sum():.3g} s, count as not measured; the "
        f"longest, of {steps[longest]:.3g} s, is after {poses.row} {poses.numbers[longest]}"
    )
    return result, [line]
