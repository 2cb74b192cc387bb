"""What was found of runs, as a table: for reading, and as rows with every digit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from surgbench.geometry import rotation_vector
from surgbench.handeye.estimate import HandEye
from surgbench.report.field import count, number, text

if TYPE_CHECKING:
    from rich.console import Console

FIELDS = (
    *text("row_id", "unit", "arm"),
    *count("repeat", "frames"),
    *number("lag_frames", "lag_low_frames", "lag_high_frames", "lag_s"),
    *number("rotation_rad", "rotation_p90_rad", "translation_m", "translation_p90_m"),
    *number("motion_rad", "motion_m", "resolution_frames"),
    *number(*(f"cam_base_{name}" for name in ("rx_rad", "ry_rad", "rz_rad", "x_m", "y_m", "z_m"))),
    *number(*(f"stretch_{name}" for name in ("yaw_rad", "pitch_rad", "insertion_m", "roll_rad"))),
    *text("note"),
)


@dataclass(frozen=True)
class Judged:
    """One arm of one run.

    Attributes:
        row_id: Of the run.
        unit: What was tracked.
        arm: Which arm.
        repeat: Of the run.
        dt_s: Seconds between frames.
        found: What was found; ``None`` where there is no saying.
        note: Why there is none, one line.
    """

    row_id: str
    unit: str
    arm: str
    repeat: int
    dt_s: float
    found: HandEye | None
    note: str = ""

    def row(self) -> dict[str, Any]:
        """Values of ``FIELDS``."""
        about = {"row_id": self.row_id, "unit": self.unit, "arm": self.arm, "repeat": self.repeat}
        if self.found is None:
            return {**about, "note": self.note}
        found, (low, high) = self.found, self.found.lag_interval_frames
        transform = [*rotation_vector(found.T_cam_base[:3, :3]), *found.T_cam_base[:3, 3]]
        names = [field.key for field in FIELDS]
        numbers = [
            *(found.frames, found.lag_frames, low, high, found.lag_frames * self.dt_s),
            *(np.median(found.rotation_rad), np.percentile(found.rotation_rad, 90)),
            *(np.median(found.translation_m), np.percentile(found.translation_m, 90)),
            *(found.motion.rotation_rad, found.motion.translation_m, found.motion.resolution_frames),
            *transform,
            *found.stretch,
        ]
        values = (None if not np.isfinite(value) else float(value) for value in numbers)
        return {**about, **dict(zip(names[len(about) : -1], values, strict=True)), "frames": found.frames}


def print_judged(judged: Sequence[Judged], console: Console) -> None:
    """Print one line for each run and arm, and what the lags mean.

    Args:
        judged: All of them.
        console: Where to.
    """
    from rich import box
    from rich.table import Table
    from rich.text import Text

    sheet = Table(box=box.SIMPLE_HEAD, padding=0, pad_edge=False)
    names = ("row", "unit")
    headings = ("frames", "lag\nframes", "rot.\n°", "90 %\n°", "trans.\nmm", "90 %\nmm", "motion\n°, mm")
    for heading in (*names, *headings):
        is_name = heading in names
        sheet.add_column(Text(heading), justify="left" if is_name else "right", no_wrap=not is_name, overflow="fold")
    for one in judged:
        if one.found is not None:
            unit = one.unit if one.unit.endswith(one.arm) else f"{one.unit} {one.arm}"
            sheet.add_row(*map(Text, (one.row_id, unit, *_cells(one.found))))
    console.print(sheet)
    for line in (
        "lag: above 0 the readings are late, with its interval of 95 %; rot., trans.: what is left, the median.",
        "The hand-eye transform and all digits: --format csv or json.",
    ):
        console.print(Text(line), soft_wrap=True)


def _cells(found: HandEye) -> tuple[str, ...]:
    low, high = found.lag_interval_frames
    turned, moved = np.degrees(found.rotation_rad), 1e3 * found.translation_m
    return (
        str(found.frames),
        f"{found.lag_frames:+.2f} ± {(high - low) / 2:.2f}",
        *(f"{value:.2f}" for one in (turned, moved) for value in (np.median(one), np.percentile(one, 90))),
        f"{np.degrees(found.motion.rotation_rad):.0f}, {1e3 * found.motion.translation_m:.0f}",
    )
