"""What is asked for: rows, and what all rows of a run share."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field

from surgbench.config import MOST_REPEATS, Count, Section
from surgbench.kinds import NAME_PATTERN
from surgbench.processes.memory import Size

Device = Literal["cpu", "cuda"]


class RowRequest(Section):
    """One row of a suite, as a file or the command line asks for it. Each task adds what it takes besides.

    Attributes:
        tracker: Registered name or ``FILE.py:Class``.
        row_id: Name in the tables; unless told, made of the tracker's name and of what the task takes besides.
        options: Plug-in name to its options, for example ``{"cmaes": {"iterations": 5}}``.
        sequences: Only so many units, spread evenly over the dataset's from the first to the last.
        frames: Only the first so many frames of each.
    """

    tracker: str
    row_id: Annotated[str, Field(pattern=f"^{NAME_PATTERN}$")] | None = None
    options: dict[str, dict[str, Any]] = Field(default={})
    sequences: Count | None = None
    frames: Count | None = None


class Conditions(Section):
    """What all rows of a run share.

    Attributes:
        timeout_s: The longest wait for one answer of a tracker.
        memory: How much its process and what that starts may use together, as ``2GB``; whatever there is unless told.
    """

    arms: Literal["single", "dual"] = "single"
    seed: Annotated[int, Field(ge=0)] = 0
    repeats: Annotated[Count, Field(le=MOST_REPEATS)] = 1
    timeout_s: Annotated[float, Field(gt=0)] = 120.0
    memory: Size | None = None
    device: Device = "cpu"


class FileRequest(Section):
    """What is asked of a file of estimates that another program made.

    Attributes:
        name: Of the row.
        time_column: Holds the milliseconds that each frame took.
        arms: Each arm was tracked alone, or pairs in one mask; what the dataset has, unless told.
        frames: Only the first so many frames of each sequence.
        joints: They were made with joint readings.
    """

    name: Annotated[str, Field(pattern=f"^{NAME_PATTERN}$")]
    time_column: str | None = None
    arms: Literal["single", "dual"] | None = None
    frames: Count | None = None
    joints: bool = False
