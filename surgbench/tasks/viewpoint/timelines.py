"""Errors, rules and latencies of runs over time, one picture for each trial. Needs Matplotlib."""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from surgbench.errors import NotFoundError
from surgbench.files import write_atomic
from surgbench.report.figures import check_matplotlib
from surgbench.report.recorded import UnitRuns, choose_runs, titles
from surgbench.tasks.viewpoint.dataset import ViewpointDataset
from surgbench.tasks.viewpoint.records import ViewpointRecord
from surgbench.tasks.viewpoint.rule_flags import RULE_NAMES, RuleFlags, rule_flags, spans
from surgbench.viewpoint.placement import CONSTRAINTS

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Job = UnitRuns[ViewpointDataset, ViewpointRecord]
# Okabe and Ito's, apart for colour-blind eyes too.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#333333")
# When they begin again.
DASHES = ("-", (0, (4, 1.5)), (0, (1, 1)))
# The article's: red, green, blue, orange, cyan.
RULE_COLOURS = ("#D62728", "#2CA02C", "#1F77B4", "#FF9E1B", "#17BECF")
BROKEN = "#B00020"
CONSTRAINED = "0.93"
PANELS = (
    ("VVA [deg]\nview off the ring", "vva_deg"),
    ("FD [mm]\ndistance off", "fd_mm"),
    ("PF [deg]\nout of level", "pf_deg"),
    ("AN [deg]\noff the normal", "an_deg"),
    ("PN [mm]\noff the naive place", "pn_mm"),
)
LATENCY = "latency [ms]\nof a step"
# Panels hold all but this share of the values.
ABOVE_SHARE = 0.002
DPI = 110


def draw_plots(
    records: Sequence[ViewpointRecord],
    dataset_path: Path | None,
    out: Path,
    progress: Callable[[str, float], Any],
) -> list[Path]:
    """Draw ``<trial>.png`` for every trial that was run.

    Args:
        records: Of one or more rows; those of other repeats than the first are passed over.
        dataset_path: Where the dataset is, if not where the records say.
        out: Folder.
        progress: As of :meth:`surgbench.task.Task.draw`.

    Returns:
        The files written.

    Raises:
        SurgbenchError: Matplotlib is not installed, the dataset is not there, or none of the runs did a step.
    """
    check_matplotlib()
    jobs = choose_runs(ViewpointDataset, records, (), (), dataset_path)
    written = []
    with progress("plots drawn", len(jobs)) as advance:
        for job in jobs:
            done = [record for record in job.records if record.frames.index]
            if done:
                path = out / f"{job.name}.png"
                _draw(Job(job.name, job.dataset, tuple(done)), path)
                written.append(path)
            advance(1)
    if not written:
        raise NotFoundError("none of these runs did a step that could be drawn")
    return written


def _draw(job: Job, path: Path) -> None:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    names, flags = titles(job.records), [rule_flags(record.frames) for record in job.records]
    entry = job.dataset.sequence(job.records[0].spec.sequence).entry
    heights = [1.0] * (len(PANELS) + 1) + [0.25 + 0.42 * len(names)]
    figure = Figure(figsize=(15, 1.55 * sum(heights) + 1.0), layout="constrained")
    FigureCanvasAgg(figure)  # no display, no global state
    panels = np.ravel(figure.subplots(len(heights), 1, sharex=True, height_ratios=heights))
    longest = max(range(len(flags)), key=lambda number: len(flags[number].naive))
    constrained = np.asarray(flags[longest].naive.any(axis=1))
    for panel, (label, error) in zip(panels, PANELS, strict=False):
        curves = [record.errors.get(error, np.array([])) for record in job.records]
        _curves(panel, curves, names, entry.dt_s, label, constrained)
    latencies = [np.array(record.frames.latency_ms, dtype=np.float64) for record in job.records]
    timing = panels[len(PANELS)]
    _curves(timing, latencies, names, entry.dt_s, LATENCY, constrained)
    known = np.concatenate(latencies)
    if (known > 0).any():
        timing.set_yscale("log")
        timing.set_ylim(np.nanquantile(known[known > 0], 0.001) / 1.5, np.nanmax(known) * 1.5)
    _rules(panels[-1], flags, names, entry.dt_s)
    panels[-1].set_xlabel("time [s]")
    panels[-1].set_xlim(0, len(constrained) * entry.dt_s)
    handles, labels = panels[0].get_legend_handles_labels()
    title = f"{job.dataset.name}, trial {entry.id}; grey: rules speak against the naive pose"
    figure.legend(handles, labels, loc="outside upper center", ncols=min(len(handles), 10), frameon=False, title=title)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=DPI, metadata={"Software": None})
    write_atomic(path, buffer.getvalue())


def _curves(
    panel: Axes,
    curves: Sequence[NDArray[np.float64]],
    names: Sequence[str],
    dt_s: float,
    label: str,
    constrained: NDArray[np.bool_],
) -> None:
    for begin, end in spans(constrained):
        panel.axvspan(begin * dt_s, end * dt_s, color=CONSTRAINED, lw=0, zorder=0)
    for number, (values, name) in enumerate(zip(curves, names, strict=True)):
        colour, dashes = COLOURS[number % len(COLOURS)], DASHES[number // len(COLOURS) % len(DASHES)]
        panel.plot(dt_s * np.arange(len(values)), values, color=colour, ls=dashes, lw=0.8, label=name)
    together = np.concatenate(list(curves))
    together = together[np.isfinite(together)]
    panel.set_ylim(0, 1.1 * max(float(np.quantile(together, 1 - ABOVE_SHARE)), 1e-3) if len(together) else 1)
    panel.set_ylabel(label, fontsize=9)
    _tidy(panel)


def _rules(panel: Axes, flags: Sequence[RuleFlags], names: Sequence[str], dt_s: float) -> None:
    """A band for each controller, a lane in it for each rule: pale where it is active, dark red where it was broken."""
    lanes = len(CONSTRAINTS)
    for number, own in enumerate(flags):
        shown = own.active if own.told else own.naive
        for lane in range(lanes):
            place = number + 0.08 + 0.84 * lane / lanes, 0.84 / lanes * 0.9
            for mask, colour, alpha in (
                (shown[:, lane], RULE_COLOURS[lane], 0.4),
                (own.broken[:, lane], BROKEN, 1.0),
            ):
                bars = [(begin * dt_s, (end - begin) * dt_s) for begin, end in spans(np.asarray(mask))]
                panel.broken_barh(bars, place, color=colour, alpha=alpha, lw=0)
            panel.text(
                1.004, place[0] + place[1] / 2, RULE_NAMES[CONSTRAINTS[lane]], color=RULE_COLOURS[lane], fontsize=6,
                va="center", transform=panel.get_yaxis_transform(),
            )  # fmt: skip
    panel.set_yticks([number + 0.5 for number in range(len(names))])
    panel.set_yticklabels(
        [f"{name}{'' if own.told else '*'}" for name, own in zip(names, flags, strict=True)], fontsize=8
    )
    panel.set_ylim(len(names), 0)
    panel.set_title(
        "rules active for the controller (*: it does not say; those against the naive pose); dark red: broken by more "
        "than 0.5 mm or 0.5 deg",
        fontsize=8,
        loc="left",
    )
    _tidy(panel)


def _tidy(panel: Axes) -> None:
    panel.grid(axis="x", color="0.85", lw=0.5)
    panel.set_axisbelow(True)
    for side in ("top", "right"):
        panel.spines[side].set_visible(False)
