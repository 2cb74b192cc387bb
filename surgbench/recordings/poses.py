"""Recorded poses of one thing over time, as any file has them: put in order, doubted, and told apart from nonsense."""

from __future__ import annotations

from array import array
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from surgbench.errors import ConfigError, DatasetError
from surgbench.geometry import FloatArray
from surgbench.recordings.names import PER_SECOND, stamp_unit

LengthUnit = Literal["m", "mm"]
TimeUnit = Literal["s", "ms", "us", "ns"]

FIELDS = ("time", "x", "y", "z", "qx", "qy", "qz", "qw")
# At 1 kHz more than an hour; what is held of each row is below 300 bytes.
MOST_ROWS = 4_000_000
# What a robot's tool does within a recording, far beyond what one does: other numbers are in another unit.
FARTHEST_M, WIDEST_M = 10.0, 1.0
# A median step outside of this, seconds, is in another unit.
STEPS_S = (1e-4, 1.0)
# The norm of a quaternion may be this far from 1 before it is told.
NORM_SLACK = 0.01


@dataclass(eq=False)
class RawPoses:
    """Rows as they stand in a file.

    Attributes:
        place: The file, and the topic where it has some; for messages.
        row: What a row is called there.
        values: Eight numbers of each row, in the order of ``FIELDS``; NaN where there is none.
        numbers: Where each row stands in the file.
        unit: Of the position, as far as the file says.
        time_unit: Of the time, likewise.
        lines: What is to be told of how it was read.
    """

    place: str
    row: str
    values: array[float] = field(default_factory=lambda: array("d"))
    numbers: array[int] = field(default_factory=lambda: array("q"))
    unit: LengthUnit | None = None
    time_unit: TimeUnit | None = None
    lines: list[str] = field(default_factory=list)

    def append(self, number: int, values: list[float]) -> None:
        """Take a row in.

        Raises:
            DatasetError: There are too many.
        """
        if len(self.numbers) >= MOST_ROWS:
            raise DatasetError(f"{self.place}: has more than {MOST_ROWS:,} {self.row}s; cut it into pieces")
        self.values.extend(values)
        self.numbers.append(number)


@dataclass(frozen=True, eq=False)
class RecordedPoses:
    """Poses over time, in order, every one whole.

    Attributes:
        place: As :class:`RawPoses` has it.
        row: Likewise.
        numbers: ``(n,)`` where each stands in the file.
        times_s: ``(n,)`` increasing, from 0.
        position_m: ``(n, 3)``.
        quaternion: ``(n, 4)`` x, y, z, w, of unit length.
        lines: What is to be told of it, warnings as such.
    """

    place: str
    row: str
    numbers: np.ndarray
    times_s: FloatArray
    position_m: FloatArray
    quaternion: FloatArray
    lines: tuple[str, ...]

    @property
    def step_s(self) -> float:
        """From one to the next: the median."""
        return float(np.median(np.diff(self.times_s)))


def put_in_order(raw: RawPoses, unit: LengthUnit | None = None, time_unit: TimeUnit | None = None) -> RecordedPoses:
    """What a file's rows mean.

    Rows without a pose are left out, rows of one time are one. Units are as told, as the file says, or metres, and for
    the time seconds, or parts of one since 1970.

    Args:
        raw: The rows.
        unit: Of positions.
        time_unit: Of times.

    Raises:
        DatasetError: There are too few, a time is none or goes backwards, a quaternion is zero, a number is infinite;
            one line that names the row.
        ConfigError: The numbers are in another unit than the one taken; the line says what to add.
    """
    values = np.frombuffer(raw.values, dtype=np.float64).reshape(-1, len(FIELDS))
    numbers = np.frombuffer(raw.numbers, dtype=np.int64)
    lines = list(raw.lines)

    def where(bad: np.ndarray) -> str:
        return f"{raw.place}: {raw.row} {numbers[int(np.argmax(bad))]}"

    if (bad := np.asarray(~np.isfinite(values[:, 0]))).any():
        raise DatasetError(f"{where(bad)}: its time is not a finite number")
    if (bad := np.asarray(np.isinf(values).any(axis=1))).any():
        raise DatasetError(f"{where(bad)}: its pose is not finite")
    if (bad := np.diff(values[:, 0], prepend=-np.inf) < 0).any():
        back = float(-np.diff(values[:, 0])[int(np.argmax(bad)) - 1])
        raise DatasetError(f"{where(bad)}: time goes backwards, by {back:g}; sort the rows, or split the recording")
    whole = np.asarray(~np.isnan(values).any(axis=1))
    if not whole.all():
        lines.append(f"{int((~whole).sum())} of {len(whole)} {raw.row}s have no pose, and are left out")
    values, numbers = values[whole], numbers[whole]
    later = np.diff(values[:, 0], prepend=-np.inf) > 0
    if not later.all():
        again = np.flatnonzero(~later)
        other = int((values[again] != values[again - 1]).any(axis=1).sum())
        lines.append(f"{len(again)} {raw.row}s have the time of the one before, and are left out")
        if other:
            has = "has" if other == 1 else "have"
            lines.append(f"warning: {other} of those {has} another pose than the {raw.row} before")
        values, numbers = values[later], numbers[later]
    if len(values) < 2:
        raise DatasetError(
            f"{raw.place}: has {len(values)} {'pose' if len(values) == 1 else 'poses'}; a motion needs two at least"
        )
    length = np.linalg.norm(values[:, 4:], axis=1)
    if (bad := length < 1e-6).any():
        raise DatasetError(f"{where(bad)}: its quaternion is zero")
    off = int((np.abs(length - 1.0) > NORM_SLACK).sum())
    if off:
        lines.append(
            f"warning: {off} of {len(length)} quaternions are not of unit length, and were made so; is --columns right?"
        )
    times_s = _seconds(values[:, 0], raw, time_unit, lines)
    position_m = _metres(values[:, 1:4], raw, unit, lines)
    return RecordedPoses(
        raw.place, raw.row, numbers, times_s, position_m, values[:, 4:] / length[:, None], tuple(lines)
    )


def _seconds(times: FloatArray, raw: RawPoses, told: TimeUnit | None, lines: list[str]) -> FloatArray:
    guessed = stamp_unit([int(times[0]), int(times[-1])])
    unit = told or raw.time_unit or ("s" if guessed == "frames" else guessed)
    steps = np.diff(times)
    # Before they are divided, so that times from 0 on come out as they are written.
    seconds = (times - times[0]) / PER_SECOND[unit]
    step_s = float(np.median(steps)) / PER_SECOND[unit]
    if not STEPS_S[0] <= step_s <= STEPS_S[1]:
        fitting = [one for one, per in PER_SECOND.items() if STEPS_S[0] <= float(np.median(steps)) / per <= STEPS_S[1]]
        hint = f"; are they in {fitting[0]}? --time-unit {fitting[0]}" if fitting and told is None else ""
        raise ConfigError(f"{raw.place}: {raw.row}s are {step_s:g} s apart (median), taken in {unit}{hint}")
    lines.append(f"{len(times)} poses over {seconds[-1]:.3f} s, {1e3 * step_s:.4g} ms apart (median)")
    return np.asarray(seconds)


def _metres(position: FloatArray, raw: RawPoses, told: LengthUnit | None, lines: list[str]) -> FloatArray:
    unit = told or raw.unit or "m"
    metres = position / 1e3 if unit == "mm" else np.array(position)
    extent = float(np.ptp(metres, axis=0).max())
    farthest = float(np.abs(metres).max())
    if extent > WIDEST_M or farthest > FARTHEST_M:
        what = f"extends over {extent:.3g} m" if extent > WIDEST_M else f"is {farthest:.3g} m from its frame's origin"
        hint = "; did you give millimetres? --unit mm" if unit == "m" else "; is one of its rows wrong?"
        raise ConfigError(f"{raw.place}: the motion {what}{hint}")
    if extent < 1e-3:
        doubt = "; are these metres? --unit m" if unit == "mm" else ""
        lines.append(f"warning: the motion extends over {1e3 * extent:.2g} mm only{doubt}")
    return np.asarray(metres)
