"""Estimates that another program made, from a CSV file."""

from __future__ import annotations

import csv
import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from surgbench.errors import DatasetError, unknown_name
from surgbench.geometry import FloatArray
from surgbench.tasks.instrument.dataset import InstrumentDataset
from surgbench.tasks.instrument.dataset import Sequence as RecordedSequence
from surgbench.tasks.instrument.format import Arm
from surgbench.tasks.instrument.pose_table import DEVIATION_COLUMNS, PoseTable

SEPARATORS = ",;\t"
TRUE, FALSE = ("1", "1.0", "true", "yes"), ("0", "0.0", "false", "no", "")
STAMP = "timestamp_s"
# A stamp is of the frame that is nearer than this share of a step: rounded, but not between two.
STAMP_SHARE = 0.1
HOW_TO_CALL = "the columns that 'surgbench export --format csv' writes"


@dataclass(frozen=True)
class ArmEstimates:
    """What was estimated of one arm in one sequence, frame by frame from the first.

    Attributes:
        states: ``(frames, 9)``.
        confidence: ``(frames,)``, 1 where none is told.
        lost: ``(frames,)`` bool.
        deviations: ``(frames, 9)`` standard deviations; ``None`` where they are not told.
        time_ms: ``(frames,)``; ``None`` where it is not told.
    """

    states: FloatArray
    confidence: FloatArray
    lost: NDArray[np.bool_]
    deviations: FloatArray | None
    time_ms: FloatArray | None


@dataclass(frozen=True)
class EstimatesFile:
    """A file of estimates.

    Attributes:
        name: The file's.
        sha256: Of its bytes.
        arms: Sequence and arm to its estimates.
    """

    name: str
    sha256: str
    arms: dict[tuple[str, Arm], ArmEstimates]


def read_estimates(
    path: Path, dataset: InstrumentDataset, frames: int | None = None, time_column: str | None = None
) -> EstimatesFile:
    """Read a file of estimates that were made on a dataset.

    Args:
        path: CSV with a header: ``sequence``, ``arm``, ``frame``, the columns of
            :mod:`surgbench.tasks.instrument.pose_table`, and where they are known ``confidence`` and ``lost`` (0 or 1).
            Other columns are passed over. What the dataset has only one of need not be named. ``timestamp_s`` must be
            the frames' times, and may stand in the place of ``frame``.
        dataset: Its sequences, arms and frames are those of the file.
        frames: Only the first so many of each sequence are wanted.
        time_column: Holds the milliseconds that each frame took.

    Returns:
        Every arm of the file with all of its frames.

    Raises:
        DatasetError: A column, frame or number is missing, unknown, there twice, or means something else than it says;
            one line.
    """
    try:
        data = path.read_bytes()
        text = data.decode("utf-8-sig")
    except FileNotFoundError:
        raise DatasetError(f"{path}: no such file; expected estimates as CSV ({HOW_TO_CALL})") from None
    except (OSError, UnicodeDecodeError) as error:
        raise DatasetError(f"{path}: cannot be read as text ({error})") from None
    header, rows, lines = _cells(path, text)
    places = _places(path, header, rows, lines, dataset)
    kept = [row for row, (_, _, frame) in enumerate(places) if frames is None or frame < frames]
    rows, lines, places = [rows[row] for row in kept], [lines[row] for row in kept], [places[row] for row in kept]
    groups = _groups(path, places, lines, dataset, frames)
    table = PoseTable(str(path), header, _numbers(rows, len(header)), lines)
    states = table.states()
    table.check_place(states[:, 3:6])
    times = None if time_column is None else table.numbers(time_column)
    if times is not None and (times < 0).any():
        line = lines[int(np.argmax(times < 0))]
        raise DatasetError(f"{path}: line {line}: '{time_column}' is {times.min():g} ms; must not be less than 0")
    confidence = table.column("confidence")
    confidence = np.ones(len(rows)) if confidence is None else np.nan_to_num(confidence, nan=1.0)
    lost = _flags(path, header, rows, lines)
    deviations = _deviations(path, table, lines)
    arms = {
        key: ArmEstimates(
            states[order],
            confidence[order],
            lost[order],
            None if deviations is None else deviations[order],
            None if times is None else times[order],
        )
        for key, order in groups.items()
    }
    return EstimatesFile(path.name, hashlib.sha256(data).hexdigest(), arms)


def _cells(path: Path, text: str) -> tuple[list[str], list[list[str]], list[int]]:
    """Header, rows and the line of each row; empty lines and those that begin with ``#`` are passed over."""
    lines = [(number, line) for number, line in enumerate(text.splitlines(), start=1) if line.strip(" ,;\t")]
    lines = [(number, line) for number, line in lines if not line.lstrip().startswith("#")]
    if len(lines) < 2:
        raise DatasetError(f"{path}: holds no estimates; expected a header and a row per arm and frame ({HOW_TO_CALL})")
    separator = max(SEPARATORS, key=lines[0][1].count)
    table = [[cell.strip() for cell in cells] for cells in csv.reader([line for _, line in lines], delimiter=separator)]
    header = table[0]
    for name in header:
        if header.count(name) > 1:
            raise DatasetError(f"{path}: line {lines[0][0]}: the column '{name}' is there twice")
    for (number, _), cells in zip(lines[1:], table[1:], strict=True):
        if len(cells) != len(header):
            raise DatasetError(f"{path}: line {number} has {len(cells)} values; expected {len(header)}, as its header")
    return header, table[1:], [number for number, _ in lines[1:]]


def _places(
    path: Path, header: list[str], rows: list[list[str]], lines: list[int], dataset: InstrumentDataset
) -> list[tuple[str, Arm, int]]:
    """Sequence, arm and frame of each row."""
    ids = [sequence.id for sequence in dataset.sequences]
    # A table that was read and written by another program may have lost zeros: 000 became 0.
    known = {**{str(int(one)): one for one in ids if one.isdecimal()}, **{one: one for one in ids}}
    arms = {sequence.id: sequence.arms for sequence in dataset.sequences}
    at = {name: header.index(name) for name in ("sequence", "arm", "frame", STAMP) if name in header}
    for name, only in (("sequence", len(ids) == 1), ("arm", all(len(own) == 1 for own in arms.values()))):
        if name not in at and not only:
            raise DatasetError(f"{path}: has no column '{name}', and '{dataset.name}' has more than one")
    if "frame" not in at and STAMP not in at:
        raise DatasetError(f"{path}: has no column 'frame' (from 0), nor '{STAMP}' (seconds from the first frame)")
    found = []
    for cells, line in zip(rows, lines, strict=True):
        asked = cells[at["sequence"]] if "sequence" in at else ids[0]
        if asked not in known:
            raise DatasetError(f"{path}: line {line}: {unknown_name('sequence', asked, ids)}")
        sequence = known[asked]
        arm = cells[at["arm"]].lower() if "arm" in at else arms[sequence][0]
        if arm not in arms[sequence]:
            raise DatasetError(f"{path}: line {line}: {unknown_name('arm', arm, arms[sequence])}")
        stamp = cells[at[STAMP]] if STAMP in at else ""
        stamped = _stamped(path, line, stamp, dataset.sequence(sequence)) if stamp or "frame" not in at else None
        if "frame" not in at:
            assert stamped is not None
            found.append((sequence, arm, stamped))
            continue
        frame = cells[at["frame"]].removesuffix(".0")
        if not frame.isdecimal() or int(frame) >= dataset.length(sequence):
            last = dataset.length(sequence) - 1
            raise DatasetError(f"{path}: line {line}: 'frame' is {frame or 'empty'}; '{sequence}' has 0 to {last}")
        if stamped is not None and stamped != int(frame):
            raise DatasetError(
                f"{path}: line {line}: frame {frame} has the {STAMP} of frame {stamped} of '{sequence}'; mend or leave "
                "out one of the columns"
            )
        found.append((sequence, arm, int(frame)))
    return found


def _stamped(path: Path, line: int, cell: str, sequence: RecordedSequence) -> int:
    """The frame whose time a stamp is."""
    times_s = sequence.timestamps_s
    try:
        off = np.abs(times_s - float(cell))
    except ValueError:
        raise DatasetError(f"{path}: line {line}: '{STAMP}' must be a number, not '{cell}'") from None
    step_s = float(np.diff(times_s).min()) if len(times_s) > 1 else sequence.dt_s
    nearest = int(np.argmin(off))
    if not off[nearest] <= STAMP_SHARE * step_s:
        raise DatasetError(
            f"{path}: line {line}: '{STAMP}' is {cell}, which is no frame's; the nearest of '{sequence.id}' is "
            f"{nearest}, at {times_s[nearest]:.6g} s from the first; a column that counts otherwise has another name, "
            "beside a column 'frame'"
        )
    return nearest


def _groups(
    path: Path,
    places: list[tuple[str, Arm, int]],
    lines: list[int],
    dataset: InstrumentDataset,
    frames: int | None,
) -> dict[tuple[str, Arm], list[int]]:
    """Of each sequence and arm its rows in the order of frames, all of them."""
    found: dict[tuple[str, Arm], dict[int, int]] = {}
    for row, (sequence, arm, frame) in enumerate(places):
        own = found.setdefault((sequence, arm), {})
        if frame in own:
            raise DatasetError(
                f"{path}: line {lines[row]}: frame {frame} of the {arm} arm of '{sequence}' is there twice "
                f"(line {lines[own[frame]]})"
            )
        own[frame] = row
    for (sequence, arm), own in found.items():
        wanted = min(dataset.length(sequence), frames or dataset.length(sequence))
        for frame in range(wanted):
            if frame not in own:
                hint = f"or score the first {frame} with --frames {frame}" if frame else "frames count from 0"
                raise DatasetError(
                    f"{path}: frame {frame} of the {arm} arm of '{sequence}' is missing (it has {wanted}); a frame "
                    f"without an estimate repeats the last one, with lost 1; {hint}"
                )
    return {key: [own[frame] for frame in sorted(own)] for key, own in found.items()}


def _numbers(rows: list[list[str]], columns: int) -> FloatArray:
    """Cells as numbers, NaN for what is none: whether that matters depends on the column."""

    def number(cell: str) -> float:
        try:
            return float(cell)
        except ValueError:
            return np.nan

    return np.array([[number(cell) for cell in cells] for cells in rows], dtype=np.float64).reshape(-1, columns)


def _flags(path: Path, header: list[str], rows: list[list[str]], lines: Sequence[int]) -> NDArray[np.bool_]:
    """The column ``lost``; not lost where it is not there."""
    if "lost" not in header:
        return np.zeros(len(rows), dtype=bool)
    cells = [row[header.index("lost")].lower() for row in rows]
    for cell, line in zip(cells, lines, strict=True):
        if cell not in (*TRUE, *FALSE):
            raise DatasetError(f"{path}: line {line}: 'lost' must be 0 or 1, not '{cell}'")
    return np.array([cell in TRUE for cell in cells], dtype=bool)


def _deviations(path: Path, table: PoseTable, lines: Sequence[int]) -> FloatArray | None:
    """``(rows, 9)`` standard deviations, all NaN in rows that have none; ``None`` where no row has."""
    columns = [table.column(name) for name in DEVIATION_COLUMNS]
    there = [column for column in columns if column is not None]
    if not there:
        return None
    if len(there) < len(columns):
        missing = next(name for name, column in zip(DEVIATION_COLUMNS, columns, strict=True) if column is None)
        raise DatasetError(f"{path}: has no column '{missing}'; of standard deviations all nine are needed, or none")
    values = np.stack(there, axis=1)
    known = np.isfinite(values)
    wrong = (known.any(axis=1) & ~known.all(axis=1)) | (np.where(known, values, 1.0) <= 0).any(axis=1)
    if wrong.any():
        line = lines[int(np.argmax(wrong))]
        raise DatasetError(f"{path}: line {line}: the standard deviations must be nine numbers above 0, or none")
    return values if known.any() else None
