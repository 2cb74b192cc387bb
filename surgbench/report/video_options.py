"""What is asked of videos and contact sheets."""

from __future__ import annotations

from dataclasses import dataclass

SHEET_COLUMNS = 5


@dataclass(frozen=True)
class VideoOptions:
    """What to draw.

    Attributes:
        units: Unit ids; empty for all.
        rows: Row ids; empty for all.
        columns: Columns of the contact sheet.
        samples: Draw the candidates of each iteration, too; of runs that have none, the sheet's moments in full size.
        overlay: Put all trackers into one panel of the video.
        side_by_side: What was observed comes first, and masks are laid over the pictures, with tips and marked points.
        fps: Of the video; ``None`` for as fast as it was.
        every: Every so many frames are drawn; ``None`` for what suits the task.
    """

    units: tuple[str, ...] = ()
    rows: tuple[str, ...] = ()
    columns: int = SHEET_COLUMNS
    samples: bool = False
    overlay: bool = False
    side_by_side: bool = False
    fps: float | None = None
    every: int | None = None
