"""The worst moments of a table's rows, drawn: where the tips were farthest from the truth, whatever the sequence."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple, cast

import numpy as np

from surgbench.records.reader import read_record
from surgbench.report.drawing import (
    ESTIMATE_COLOURS,
    REFERENCE_COLOUR,
    Picture,
    below,
    beside,
    legend,
    save_png,
    side_label,
    strip,
    write_note,
)
from surgbench.reproduce.results import RECORDS, BlockWork, RowWork
from surgbench.reproduce.table import Table
from surgbench.tasks.instrument.columns import TIPS
from surgbench.tasks.instrument.dataset import InstrumentDataset
from surgbench.tasks.instrument.records import InstrumentRecord
from surgbench.tasks.instrument.scenery import Scenery, Shot

WORST_PNG = "worst.png"
PANEL_WIDTH, TEXT_PX, GAP = 420, 13, 4
# Moments of one sequence are at least so many frames apart, or all would be of one.
APART = 60


class Moment(NamedTuple):
    """A frame of a record, and how far the worse arm's tips are off, metres."""

    record: InstrumentRecord
    frame: int
    tip_error_m: float


def worst_moments(records: Sequence[InstrumentRecord], count: int) -> list[Moment]:
    """The worst of all frames, worst first, those of one record at least :data:`APART` frames apart.

    Args:
        records: Of one row.
        count: How many at most.
    """
    found: list[Moment] = []
    for record in records:
        errors = record.errors.get(TIPS.key)
        if errors is None:
            continue
        worst = np.nan_to_num(errors.reshape(len(errors), -1), nan=0.0).max(axis=1)
        for place in np.argsort(-worst, kind="stable"):
            frame = record.frames.index[place]
            own = [one for one in found if one.record is record]
            if len(own) < count and all(abs(one.frame - frame) >= APART for one in own):
                found.append(Moment(record, frame, float(worst[place])))
    return sorted(found, key=lambda one: -one.tip_error_m)[:count]


def draw_worst(table: Table, blocks: Sequence[BlockWork], out: Path, path: Path) -> bool:
    """Draw the table's worst moments; ``False`` where none of their rows was run."""
    assert table.worst is not None
    wanted = table.worst
    work = next(work for work in blocks if work.block.name == wanted.block)
    dataset = cast(InstrumentDataset, work.dataset)
    lines: list[Picture] = []
    entries = [("reference mask, as the trackers saw it", REFERENCE_COLOUR)]
    for number, id_ in enumerate(wanted.rows):
        row = next(one for one in work.rows if one.row.id == id_)
        colour = ESTIMATE_COLOURS[number % len(ESTIMATE_COLOURS)]
        moments = worst_moments(_records(row, out), wanted.moments)
        if moments:
            lines.append(_line(dataset, row.row.label, moments, wanted.moments, colour))
            entries.append((row.row.label, colour))
    if not lines:
        return False
    save_png(path, below([*lines, legend(entries, lines[0].shape[1], TEXT_PX)], GAP))
    return True


def _records(row: RowWork, out: Path) -> list[InstrumentRecord]:
    read = (read_record(out / RECORDS / job.path) for job in row.jobs)
    return [record for record in read if isinstance(record, InstrumentRecord) and record.frames.state]


def _line(
    dataset: InstrumentDataset, label: str, moments: Sequence[Moment], count: int, colour: tuple[int, int, int]
) -> Picture:
    panels: list[Picture] = []
    for moment in moments:
        scenery = Scenery(dataset, moment.record)
        panel = scenery.panel(moment.frame, [Shot(moment.record, label, colour)], PANEL_WIDTH / scenery.camera.width)
        note = f"{moment.record.spec.unit}, frame {moment.frame}: tips {1000 * moment.tip_error_m:.1f} mm off"
        write_note(panel, note, TEXT_PX)
        panels.append(panel)
    height, width = panels[0].shape[:2]
    panels += [strip(width, height)] * (count - len(panels))
    return beside([side_label(label, height, TEXT_PX), beside(panels, GAP)])
