"""Whether a recording's jaw readings are half the opening or all of it: its masks are asked where nobody says so."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from surgbench.camera.undistortion import Undistortion
from surgbench.contract import Mask
from surgbench.errors import DatasetError
from surgbench.instrument import Instrument
from surgbench.metrics import OUT_OF_VIEW_SHARE
from surgbench.recordings.coding import WHOLE, Coding
from surgbench.recordings.folder import Recording
from surgbench.recordings.frame_masks import picked
from surgbench.recordings.readings import Jaw, UntoldJaw
from surgbench.tasks.instrument.format import Arm
from surgbench.tasks.instrument.jaw_evidence import JawEvidence, JawFrame, weigh_jaw

# Frames that are looked at, and those of them that show most of the instrument, which are asked.
LOOKED_AT, ASKED = 24, 6

_IS: dict[Jaw, str] = {"half": "each jaw's angle from the midline", "full": "the whole angle between the jaws"}
_OTHER: dict[Jaw, Jaw] = {"half": "full", "full": "half"}


def check_jaws(recording: Recording, coding: Coding, instrument: Instrument, arms: Sequence[Arm]) -> list[str]:
    """Hold the jaw's readings against the masks, where the recording does not say what they are.

    Args:
        recording: Its :attr:`Recording.jaws` are doubted.
        coding: What its masks mean.
        instrument: Of all arms.
        arms: That the masks show.

    Returns:
        A line for each arm that was doubted.

    Raises:
        DatasetError: The masks contradict, or do not tell; one line that names the option.
    """
    return [_check(recording, coding, instrument, arm, jaw, len(arms)) for arm, jaw in recording.jaws.items()]


def _check(recording: Recording, coding: Coding, instrument: Instrument, arm: str, jaw: UntoldJaw, arms: int) -> str:
    frames = [] if arms > 1 and arm not in coding.groups else _frames(recording, coding, arm, jaw)
    found = weigh_jaw(instrument, recording.camera.pinhole, frames)
    taken, other = _IS[jaw.taken], _IS[_OTHER[jaw.taken]]
    title = f"{jaw.path.name}: '{jaw.column}'" if arms == 1 else f"{jaw.path.name}, {arm} arm: '{jaw.column}'"
    if found.verdict == "taken":
        return f"{title}: the masks fit {taken} better ({_said(found)})"
    place = jaw.path.with_name(title)
    if found.verdict == "other":
        raise DatasetError(
            f"{place}: the masks fit {other} better than {taken} ({_said(found)}): --jaw {_OTHER[jaw.taken]}, else "
            f"--jaw {jaw.taken}"
        )
    if jaw.taken == "full":  # the dVRK's name for it says so
        return f"{title}: the masks do not tell whether it is {other}"
    raise DatasetError(f"{place}: {_IS['half']} (--jaw half), or {_IS['full']} (--jaw full)? The masks do not tell")


def _said(found: JawEvidence) -> str:
    low, high = sorted((found.error, found.other))
    return f"{low:.1%} off, else {high:.1%}, in {found.frames} frames"


def _frames(recording: Recording, coding: Coding, arm: str, jaw: UntoldJaw) -> list[JawFrame]:
    """Frames with the jaws well open that show most of the instrument."""
    apart = np.abs(jaw.joints - jaw.otherwise)[:, 2]
    wide = np.flatnonzero(apart >= np.nanmax(apart) / 2)  # a frame without a reading is none
    places = wide[np.unique(np.linspace(0, len(wide) - 1, LOOKED_AT).astype(int))].tolist()
    lens = Undistortion(recording.camera)
    shown: list[tuple[float, int, Mask]] = []
    for place, picture in zip(places, picked(recording.masks.pictures(), places), strict=True):
        masks = coding.masks(picture)
        mask = masks[WHOLE if WHOLE in masks else arm]
        straight = lens(np.where(mask, 255, 0).astype(np.uint8), cv2.INTER_NEAREST) > 127
        if straight.mean() >= OUT_OF_VIEW_SHARE:
            shown.append((float(straight.mean()), place, straight))
    shown.sort(key=lambda one: -one[0])
    return [JawFrame(mask, jaw.joints[place], jaw.otherwise[place]) for _, place, mask in shown[:ASKED]]
