"""Readings that are late: how much by, and where they belong."""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from surgbench.errors import ConfigError, DatasetError
from surgbench.geometry import FloatArray
from surgbench.tasks.instrument.format import ARMS

COLUMNS = ["trajectory", "arm", "frames"]


def read_lags(told: str | None, trajectories: Sequence[str]) -> dict[str, dict[str, float]]:
    """By trajectory and arm, how many frames its readings are late.

    Args:
        told: A number of frames, which may be negative, or a CSV file with the columns trajectory, arm and frames.
        trajectories: Names of those there are; a file may have others, and say them without zeros before.

    Raises:
        ConfigError: It is neither; one line.
        DatasetError: The file is something else; one line.
    """
    if told is None:
        return {}
    try:
        frames = float(told)
    except ValueError:
        return _read_file(Path(told), trajectories)
    if not math.isfinite(frames):
        raise ConfigError(f"--lag: must be a number of frames or a CSV file, not '{told}'")
    return {name: dict.fromkeys(ARMS, frames) for name in trajectories}


def move_readings(readings: FloatArray, lag_frames: float) -> FloatArray:
    """Readings where they belong, linear between two.

    Args:
        readings: ``(frames, n)``, NaN where missing.
        lag_frames: How late they are: what belongs to frame k was read at ``k + lag_frames``.

    Returns:
        The same shape; NaN where nothing was read before or after.

    Example:
        >>> import numpy as np
        >>> from surgbench.exchange.lags import move_readings
        >>> move_readings(np.array([[0.0], [1.0], [4.0]]), 0.5)[:, 0]
        array([0.5, 2.5, nan])
    """
    count = len(readings)
    wanted = np.arange(count) + lag_frames
    before = np.floor(wanted).astype(int)
    share = (wanted - before)[:, None]
    after = np.where(share[:, 0] > 0, before + 1, before)
    inside = (before >= 0) & (after < count)
    first, second = readings[np.clip(before, 0, count - 1)], readings[np.clip(after, 0, count - 1)]
    moved = np.where(share > 0, (1.0 - share) * first + share * second, first)
    return np.where(inside[:, None], moved, np.nan)


def _read_file(path: Path, trajectories: Sequence[str]) -> dict[str, dict[str, float]]:
    try:
        rows = list(csv.reader(path.read_text(encoding="utf-8-sig").splitlines()))
    except (OSError, UnicodeDecodeError):
        raise ConfigError(f"--lag: '{path}' is no number of frames, and no CSV file that can be read") from None
    if not rows or [cell.strip() for cell in rows[0]] != COLUMNS:
        raise DatasetError(f"{path}: line 1 must be '{','.join(COLUMNS)}'")
    names = {name: name for name in trajectories} | {str(int(name)): name for name in trajectories if name.isdecimal()}
    lags: dict[str, dict[str, float]] = {}
    for line, cells in enumerate(rows[1:], start=2):
        if not any(cell.strip() for cell in cells):
            continue
        try:
            name, arm, frames = cells[0].strip(), cells[1].strip(), float(cells[2])
        except (IndexError, ValueError):
            raise DatasetError(f"{path}: line {line}: must be a trajectory, an arm and a number of frames") from None
        if arm not in ARMS or not math.isfinite(frames):
            raise DatasetError(f"{path}: line {line}: must be like '000003,left,12.5'")
        if name in names:
            lags.setdefault(names[name], {})[arm] = frames
    return lags
