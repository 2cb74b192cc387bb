"""Numbers in file names: which of them counts frames, or is the time, and when each frame was taken."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from surgbench.errors import ConfigError, DatasetError
from surgbench.geometry import FloatArray

Stamps = Literal["auto", "frames", "s", "ms", "us", "ns"]

PER_SECOND = {"s": 1, "ms": 10**3, "us": 10**6, "ns": 10**9}
# 2000 to 2100, seconds since 1970: numbers that all lie in it are no count of frames.
_EPOCH_S = (946_684_800, 4_102_444_800)
# Seconds with a fraction, or seconds and nanoseconds as ROS writes them (1403636579_763555584); else any number.
_NUMBER = re.compile(r"(\d{9,10})\.(\d{1,9})(?!\d)|(\d{9,10})_(\d{9})(?!\d)|(\d+)")
# A number this many steps away, and further than this many times all that the others span, belongs to no recording.
_STRAY_STEPS, _STRAY_SPANS = 1000, 10
_TOO_LARGE = 2**63
# No more than one in so many numbers: a recording in two takes has many on both sides of a long gap.
_FEW = 20


@dataclass(frozen=True)
class Timing:
    """When the frames of a recording were taken.

    Attributes:
        times_s: ``(frames,)`` seconds since the first.
        dt_s: Seconds from one to the next: the median.
        fps: Counted frames per second; ``None`` where names are times.
        said: What is to be told of it, one line; ``None`` where frames follow one another.
    """

    times_s: FloatArray
    dt_s: float
    fps: float | None
    said: str | None = None


def number_files(paths: Iterable[Path]) -> dict[int, Path]:
    """Files by the number in their names, in the order of the numbers.

    Of several numbers in a name it is the last that tells all files apart, so that ``seq01_000_mask.png`` is frame 0 of
    files that all begin with ``seq01``. Seconds with a fraction count nanoseconds.

    Raises:
        DatasetError: A name has no number, or one that nothing counts, or two have the same.
    """
    files = sorted(paths)
    numbers = [[_value(match) for match in _NUMBER.finditer(path.stem)] for path in files]
    for path, found in zip(files, numbers, strict=True):
        if not found:
            raise DatasetError(f"{path}: its name must hold the frame's number, for example 000012{path.suffix}")
    place = -1
    if len({len(found) for found in numbers}) == 1:
        telling = [k for k in range(len(numbers[0])) if len({found[k] for found in numbers}) == len(files)]
        place = telling[-1] if telling else -1
    numbered: dict[int, Path] = {}
    for path, found in zip(files, numbers, strict=True):
        if found[place] >= _TOO_LARGE:
            raise DatasetError(f"{path}: its number is too large for a frame's or a time in ns")
        if found[place] in numbered:
            raise DatasetError(f"{path}: is frame {found[place]}, and so is {numbered[found[place]].name}")
        numbered[found[place]] = path
    return dict(sorted(numbered.items()))


def check_stray(paths: dict[int, Path]) -> None:
    """See that no single number lies far from all others.

    Args:
        paths: From :func:`number_files`.

    Raises:
        DatasetError: One does; it is named.
    """
    numbers = list(paths)
    if len(numbers) < 3:
        return
    gaps = np.diff(np.array(numbers, dtype=np.float64))
    widest, step = int(np.argmax(gaps)), float(np.median(gaps))
    before, after = numbers[: widest + 1], numbers[widest + 1 :]
    span = max(before[-1] - before[0], after[-1] - after[0])
    few = min(len(before), len(after)) <= max(1, len(numbers) // _FEW)
    if not few or gaps[widest] <= max(_STRAY_STEPS * step, _STRAY_SPANS * span):
        return
    stray, others = (after[0], before) if len(after) <= len(before) else (before[-1], after)
    raise DatasetError(
        f"{paths[stray]}: its number is far from those of the other files ({others[0]} to {others[-1]}); rename it or "
        "move it away (unrelated pictures are imported with --single-images)"
    )


def time_of_frames(numbers: Sequence[int], place: Path, stamps: Stamps = "auto", fps: float | None = None) -> Timing:
    """When frames with these numbers were taken. Memory does not depend on how large the numbers are.

    Args:
        numbers: Increasing.
        place: Where they are from, for the message.
        stamps: What they count: frames, or parts of a second. ``auto``: frames, unless all are times since 1970.
        fps: Counted frames per second; 30 unless told.

    Raises:
        ConfigError: Frames per second are told of numbers that are times.
    """
    unit = stamp_unit(numbers) if stamps == "auto" else stamps
    if unit != "frames" and fps is not None:
        raise ConfigError(
            f"--fps: the names in {place} are times in {unit}; without --fps they count as such, and with "
            "--stamps frames as frames"
        )
    rate = 30.0 if fps is None else fps
    count_s = 1.0 / rate if unit == "frames" else 1.0 / PER_SECOND[unit]
    offsets = np.array([number - numbers[0] for number in numbers], dtype=np.float64)
    times_s = offsets * count_s
    steps = np.diff(offsets)
    if len(steps) == 0:
        return Timing(times_s, 1.0 / rate, rate if unit == "frames" else None)
    step = float(np.median(steps))
    return Timing(
        times_s, step * count_s, rate if unit == "frames" else None, _said(numbers, steps, step, unit, count_s)
    )


def stamp_unit(numbers: Sequence[int]) -> Literal["frames", "s", "ms", "us", "ns"]:
    """What numbers count, by their size."""
    for unit in ("s", "ms", "us", "ns"):
        earliest, latest = (second * PER_SECOND[unit] for second in _EPOCH_S)
        if all(earliest <= number < latest for number in numbers):
            return unit
    return "frames"


def _said(numbers: Sequence[int], steps: FloatArray, step: float, unit: str, count_s: float) -> str | None:
    if unit == "frames":
        if step == 1.0 and (steps == 1.0).all():
            return None
        every = "" if step == 1.0 else f", one in {step:g}"
        words = f"frames {numbers[0]} to {numbers[-1]}{every}, {step * count_s:.4g} s apart"
    else:
        words = f"names are times in {unit}, {step * count_s:.4g} s apart"
    longer = np.flatnonzero(steps > 1.5 * step)
    if len(longer):
        first = int(longer[np.argmax(steps[longer])])
        words += f"; {len(longer)} gaps, the longest of {steps[first] * count_s:.4g} s after {numbers[first]}"
    return words


def number_of(cell: str) -> int | None:
    """The number that a name would have that is no more than a time: seconds with a fraction count nanoseconds."""
    match = _NUMBER.fullmatch(cell)
    return None if match is None or match[5] is not None or not (match[2] or match[4]).strip("0") else _value(match)


def _value(match: re.Match[str]) -> int:
    seconds, fraction, ros_seconds, nanoseconds, plain = match.groups()
    if plain is not None:
        return int(plain)
    if seconds is not None:
        return int(seconds) * PER_SECOND["ns"] + int(fraction.ljust(9, "0"))
    return int(ros_seconds) * PER_SECOND["ns"] + int(nanoseconds)
