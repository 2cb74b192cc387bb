"""What lies beside a recording's masks, ``joints.csv`` and ``tips.csv``, and what importers may be told of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from pydantic import Field

from surgbench.camera import Camera
from surgbench.config import Section
from surgbench.exchange.readings import AngleUnit, Jaw, Readings, read_joints
from surgbench.exchange.tips import Tips, TipsUnit, read_tips
from surgbench.instrument import Instrument

JOINTS_FILE, TIPS_FILE = "joints.csv", "tips.csv"


class BesideOptions(Section):
    """What the files do not say of themselves; the base of an importer's options."""

    joints_unit: Annotated[
        AngleUnit | None,
        Field(description="Unit of the angles in joints.csv; default: as its columns' names say, else rad."),
    ] = None
    jaw: Annotated[
        Jaw | None,
        Field(
            description="The jaw in joints.csv: half, each jaw's angle from the midline, or full, the angle between "
            "both, as the dVRK has it; default: half for a column q3, full for a column jaw."
        ),
    ] = None
    joints_arm: Annotated[
        bool, Field(description="Keep all six joints of the arm that joints.csv has, for a hand-eye estimate.")
    ] = False
    tips_unit: Annotated[
        TipsUnit | None, Field(description="Unit of tips.csv: px, or fraction of the picture; default: px.")
    ] = None


@dataclass(frozen=True)
class Beside:
    """Readings and tips of a recording, each ``None`` where there are none."""

    readings: Readings | None
    tips: Tips | None

    @property
    def notes(self) -> tuple[str, ...]:
        """A line for each file that says how it was read."""
        return tuple(one.note for one in (self.readings, self.tips) if one is not None)

    @property
    def flags(self) -> dict[str, bool]:
        """What a :class:`~surgbench.tasks.instrument.format.SequenceEntry` says of them."""
        return {
            "keypoints": self.tips is not None and self.tips.points is not None,
            "readings": self.readings is not None and self.readings.joints is not None,
            "arm_joints": self.readings is not None and self.readings.arm is not None,
        }


def read_beside(
    source: Path, numbers: Sequence[int], camera: Camera, instrument: Instrument, options: BesideOptions
) -> Beside:
    """Read ``joints.csv`` and ``tips.csv`` of a folder, as far as they are there.

    Args:
        source: The folder.
        numbers: The recording's frames.
        camera: Of the recording's pictures.
        instrument: Of the arm whose joints and tips they are.
        options: What is told of them.

    Raises:
        DatasetError: Something in them is wrong or is not what it is taken for; one line.
    """
    readings = read_joints(
        source / JOINTS_FILE,
        numbers,
        instrument,
        unit=options.joints_unit,
        jaw=options.jaw,
        arm=options.joints_arm,
    )
    return Beside(readings, read_tips(source / TIPS_FILE, numbers, camera, options.tips_unit))
