"""Ground truth and estimates over time, as in the paper's Fig. 5, and below them the errors. Needs Matplotlib."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from surgbench.files import write_atomic
from surgbench.geometry import FloatArray, wrap_angle
from surgbench.metrics import choose_twin
from surgbench.records.reader import read_record
from surgbench.report.figures import check_matplotlib
from surgbench.reproduce.results import RECORDS, BlockWork
from surgbench.reproduce.table import Picture, Table
from surgbench.state import ANGLES, STATE_SIZE, Symmetry
from surgbench.tasks.instrument.dataset import InstrumentDataset
from surgbench.tasks.instrument.format import Arm
from surgbench.tasks.instrument.records import InstrumentRecord

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Okabe and Ito's, apart for colour-blind eyes too; different dashes where printed in grey.
COLOURS = ("#E69F00", "#CC79A7", "#56B4E9", "#0072B2", "#D55E00")
TRUTH_COLOUR = "black"
PANELS = (
    (r"$\alpha$ [rad]", 0, 1.0),
    (r"$\beta$ [rad]", 1, 1.0),
    (r"$\gamma$ [rad]", 2, 1.0),
    ("x [mm]", 3, 1000.0),
    ("y [mm]", 4, 1000.0),
    ("z [mm]", 5, 1000.0),
    ("q1, wrist pitch [rad]", 6, 1.0),
    ("q2, wrist yaw [rad]", 7, 1.0),
    ("q3, half jaw angle [rad]", 8, 1.0),
)
ERROR_PANELS = (
    ("rotation error [rad]", "rotation_error_rad", 1.0),
    ("tip error [mm]", "tip_error_m", 1000.0),
    ("mask error", "mask_error", 1.0),
)
# Errors jump from frame to frame; what matters is where they stay high.
SMOOTHED_FRAMES = 15
# Limits around the truth, so that a row that is far off does not flatten all others.
MARGIN, LEAST_SPAN = 0.6, {1.0: 0.2, 1000.0: 20.0}


@dataclass(frozen=True)
class Line:
    """One row's estimates: label and record."""

    label: str
    record: InstrumentRecord


def draw(table: Table, blocks: Sequence[BlockWork], out: Path, path: Path) -> bool:
    """Draw a table's figure from its records.

    Args:
        table: With a figure.
        blocks: The finished work.
        out: The table's own folder.
        path: PNG to write.

    Returns:
        ``False`` where none of the figure's rows was run on its unit.

    Raises:
        SurgbenchError: Matplotlib is not installed.
    """
    check_matplotlib()
    assert table.figure is not None
    work = next(work for work in blocks if work.block.name == table.figure.block)
    lines = _lines(work, table.figure, out)
    if not lines:
        return False
    buffer = io.BytesIO()
    figure = _figure(cast(InstrumentDataset, work.dataset), table.figure, lines)
    figure.savefig(buffer, format="png", dpi=130, metadata={"Software": None})
    write_atomic(path, buffer.getvalue())
    return True


def _lines(work: BlockWork, figure: Picture, out: Path) -> list[Line]:
    by_id = {row.row.id: row for row in work.rows}
    lines = []
    for id_ in figure.rows:
        for job in by_id[id_].jobs:
            if job.unit.id == figure.unit and job.repeat == 0:
                record = read_record(out / RECORDS / job.path)
                if isinstance(record, InstrumentRecord) and record.frames.state:
                    lines.append(Line(by_id[id_].row.label, record))
    return lines


def _figure(dataset: InstrumentDataset, wanted: Picture, lines: list[Line]) -> Figure:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    spec = lines[0].record.spec
    sequence = dataset.sequence(spec.sequence)
    arm: Arm = "left" if spec.arms[0] == "left" else "right"
    truth = sequence.states(arm)
    assert truth is not None
    frames = max(len(line.record.frames.state) for line in lines)
    symmetry = dataset.instrument(sequence.entry.instruments[arm]).symmetry
    truth, time = truth[:frames].copy(), sequence.timestamps_s[:frames]
    truth[:, ANGLES] = np.unwrap(truth[:, ANGLES], axis=0)

    figure = Figure(figsize=(15, 12), layout="constrained")
    FigureCanvasAgg(figure)  # no display, no global state
    axes: Any = figure.subplots(4, 3, sharex=True)
    for place, (name, component, scale) in enumerate(PANELS):
        panel: Axes = axes[place // 3, place % 3]
        for colour, line in zip(COLOURS, lines, strict=False):
            states = _near(line.record.frames.states[:, :STATE_SIZE], truth, symmetry)
            panel.plot(time[: len(states)], scale * states[:, component], color=colour, label=line.label, lw=1.1)
        panel.plot(time, scale * truth[:, component], color=TRUTH_COLOUR, label="ground truth", lw=1.6, ls=(0, (4, 2)))
        panel.set_ylim(*_range(scale * truth[:, component], scale))
        panel.set_ylabel(name)
    for panel, (name, error, scale) in zip(axes[3], ERROR_PANELS, strict=True):
        for colour, line in zip(COLOURS, lines, strict=False):
            values = _smooth(line.record.errors[error].reshape(len(line.record.frames.state), -1)[:, 0])
            panel.plot(time[: len(values)], scale * values, color=colour, lw=0.9)
        panel.set_yscale("log")
        panel.set_ylabel(name)
        panel.set_xlabel("time [s]")
    for panel in axes.flat:
        panel.grid(color="0.9", lw=0.6)
        panel.set_axisbelow(True)
        panel.margins(x=0.01)
        for side in ("top", "right"):
            panel.spines[side].set_visible(False)
    handles, labels = axes[0, 0].get_legend_handles_labels()
    order = [len(handles) - 1, *range(len(handles) - 1)]
    figure.legend(
        [handles[i] for i in order],
        [labels[i] for i in order],
        loc="outside upper center",
        ncols=len(handles),
        frameon=False,
        title=f"{dataset.name}, sequence {spec.sequence} ({sequence.speed} speed), {arm} arm: estimates over time; "
        f"last row: errors, running mean of {SMOOTHED_FRAMES} frames",
    )
    return figure


def _near(states: FloatArray, truth: FloatArray, symmetry: Symmetry) -> FloatArray:
    """States after the twin rule, their angles within half a turn of the truth's."""
    truth = truth[: len(states)]
    chosen = choose_twin(states, truth, symmetry)
    chosen[:, ANGLES] = truth[:, ANGLES] + wrap_angle(chosen[:, ANGLES] - truth[:, ANGLES])
    return chosen


def _smooth(values: FloatArray) -> FloatArray:
    """Running mean, of as many frames as there are at the ends."""
    window = np.ones(min(SMOOTHED_FRAMES, len(values)))
    return np.convolve(values, window, "same") / np.convolve(np.ones(len(values)), window, "same")


def _range(truth: FloatArray, scale: float) -> tuple[float, float]:
    low, high = float(truth.min()), float(truth.max())
    margin = MARGIN * max(high - low, LEAST_SPAN[scale])
    return low - margin, high + margin
