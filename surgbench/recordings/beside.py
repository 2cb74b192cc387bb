"""What lies beside a recording's masks, ``joints.csv`` and ``tips.csv``, and what importers may be told of it."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field

from surgbench.camera import Camera
from surgbench.config import Section
from surgbench.geometry import FloatArray
from surgbench.instrument import Instrument
from surgbench.instrument.arms import DEFAULT_ARM
from surgbench.recordings.arm_columns import Whose, parse_arm_names
from surgbench.recordings.readings import AngleUnit, Jaw, Readings, UntoldJaw, read_joints
from surgbench.recordings.tips import Tips, TipsUnit, read_tips

JOINTS_FILE, TIPS_FILE = "joints.csv", "tips.csv"


class RobotArmOption(Section):
    """Which robot's joints a recording has."""

    robot_arm: Annotated[
        str,
        Field(
            description="ARM: Whose six joints the recording has: a name (surgbench list arms), or an arm's file; "
            "default: classic_400006."
        ),
    ] = DEFAULT_ARM


class BesideOptions(RobotArmOption):
    """What the files do not say of themselves; the base of an importer's options."""

    joints_unit: Annotated[
        AngleUnit | None,
        Field(description="Unit of the angles in joints.csv; default: as its columns' names say, else rad."),
    ] = None
    jaw: Annotated[
        Jaw | None,
        Field(
            description="The jaw in joints.csv: half, each jaw's angle from the midline, or full, the angle between "
            "both, as the dVRK has it; default: as the masks say, with half for a column q3 and full for a column jaw."
        ),
    ] = None
    arm_names: Annotated[
        str | None,
        Field(
            description="NAMES of the arms in joints.csv and tips.csv, in its columns (PSM1_yaw) or in a column arm, "
            "as PSM1=right,PSM3=left."
        ),
    ] = None
    joints_arm: Annotated[
        bool, Field(description="Keep all six joints of the arm that joints.csv has, for a hand-eye estimate.")
    ] = False
    tips_unit: Annotated[
        TipsUnit | None, Field(description="Unit of tips.csv: px, or fraction of the picture; default: px.")
    ] = None

    @property
    def given(self) -> dict[str, str | bool]:
        """Those that were given, as a dataset's configuration has them."""
        fields = set(BesideOptions.model_fields) - set(RobotArmOption.model_fields)
        return self.model_dump(include=fields, exclude_defaults=True)


@dataclass(frozen=True)
class Beside:
    """Readings and tips of a recording, each by arm, or ``None`` where there are none.

    Attributes:
        joints: ``(frames, 3)`` q1, q2, q3, rad, q3 from the midline.
        arm_joints: ``(frames, 6)`` the arm's joints, rad and (insertion) m.
        tips: ``(frames, 2, 2)`` pixels of the recording's pictures, NaN where a tip was not marked.
        notes: A line for each file, and arm where there are two, that says how it was read.
        jaws: By arm, what is left to be doubted of its jaw.
    """

    joints: dict[str, FloatArray] | None
    arm_joints: dict[str, FloatArray] | None
    tips: dict[str, FloatArray] | None
    notes: tuple[str, ...]
    jaws: dict[str, UntoldJaw]


def read_beside(
    source: Path,
    numbers: Sequence[int],
    camera: Camera,
    instrument: Instrument,
    options: BesideOptions,
    *,
    arms: Sequence[str] = ("left",),
    maskless: Collection[int] = (),
) -> Beside:
    """Read ``joints.csv`` and ``tips.csv`` of a folder, as far as they are there.

    Args:
        source: The folder.
        numbers: The recording's frames.
        camera: Of the recording's pictures.
        instrument: Of the arms whose joints and tips they are.
        options: What is told of them.
        arms: That the recording shows; with two, tables say whose a column or a row is (``left_q1``).
        maskless: Frames without a mask, whose rows are left out.

    Raises:
        DatasetError: Something in them is wrong or is not what it is taken for; one line.
    """
    readings: dict[str, Readings] = {}
    tips: dict[str, Tips] = {}
    names = parse_arm_names(options.arm_names)
    for arm in arms:
        whose = Whose(arm, len(arms) > 1, names)
        read = read_joints(
            source / JOINTS_FILE,
            numbers,
            instrument,
            unit=options.joints_unit,
            jaw=options.jaw,
            arm=options.joints_arm,
            whose=whose,
            maskless=maskless,
        )
        marked = read_tips(source / TIPS_FILE, numbers, camera, options.tips_unit, whose=whose, maskless=maskless)
        readings |= {} if read is None else {arm: read}
        tips |= {} if marked is None else {arm: marked}
    points = {arm: one.points for arm, one in tips.items()}
    unseen = np.full((len(numbers), 2, 2), np.nan)
    return Beside(
        _of_all({arm: one.joints for arm, one in readings.items()}),
        _of_all({arm: one.arm for arm, one in readings.items()}),
        {arm: unseen if one is None else one for arm, one in points.items()}
        if any(one is not None for one in points.values())
        else None,
        (*(one.note for one in readings.values()), *(one.note for one in tips.values())),
        {arm: one.jaw for arm, one in readings.items() if one.jaw is not None},
    )


def _of_all(by_arm: dict[str, FloatArray | None]) -> dict[str, FloatArray] | None:
    """``None`` unless every arm has it."""
    found = {arm: values for arm, values in by_arm.items() if values is not None}
    return found if found and len(found) == len(by_arm) else None
