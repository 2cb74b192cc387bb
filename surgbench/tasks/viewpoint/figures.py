"""The article's figures, from records. Needs Matplotlib.

Errors over time with the rules that were active, the path in space, and where the feature was in the pictures, over
time too.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from surgbench.files import write_atomic
from surgbench.tasks.viewpoint.draw import EDGES
from surgbench.tasks.viewpoint.picture_rows import found_pixels
from surgbench.tasks.viewpoint.records import ViewpointRecord
from surgbench.viewpoint.contract import ViewpointScene
from surgbench.viewpoint.placement import CONSTRAINTS, naive_pose
from surgbench.viewpoint.trial import Trial

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Okabe and Ito's, apart for colour-blind eyes too.
COLOURS = ("black", "#0072B2", "#D55E00", "#E69F00", "#CC79A7", "#56B4E9")
# The article's: red, green, blue, orange, cyan.
RULE_COLOURS = ("#D62728", "#2CA02C", "#1F77B4", "#FF9E1B", "#17BECF")
RULE_NAMES = ("no-go zone", "below floor", "orientation", "proximity", "joint limit")
# Figs. 4 a to c and 5 a and b of the article.
PANELS = (
    ("VVA [deg]", "vva_deg"),
    ("FD [mm]", "fd_mm"),
    ("PF [deg]", "pf_deg"),
    ("AN [deg]", "an_deg"),
    ("PN [mm]", "pn_mm"),
)
FEATURE_COLOUR, NAIVE_COLOUR, CAMERA_COLOUR, ZONE_COLOUR = "#1F77B4", "#2CA02C", "#D62728", "0.5"
EYES = ("left", "right")
DPI = 130


@dataclass(frozen=True)
class Line:
    """One controller's course: label and record."""

    label: str
    record: ViewpointRecord


def draw_timeline(lines: Sequence[Line], dt_s: float, path: Path, title: str) -> None:
    """Errors over time, and bars for the rules that were active in the view of the first controller.

    Of one that tells of none, bars are for those that speak against the naive pose.

    Args:
        lines: Of one trial.
        dt_s: Seconds between steps.
        path: PNG to write.
        title: Over the figure.
    """
    first = lines[0].record.frames
    bars = first.active if any(first.active) else first.rules
    title += (
        f"; bars: rules active for '{lines[0].label}'" if any(first.active) else "; bars: rules against the naive pose"
    )
    figure, axes = _figure(15, 12, len(PANELS), 1, sharex=True)
    for panel, (name, error) in zip(axes, PANELS, strict=True):
        for colour, line in zip(COLOURS, lines, strict=False):
            values = line.record.errors[error]
            panel.plot(dt_s * np.arange(len(values)), values, color=colour, lw=0.9, label=line.label)
        panel.set_ylabel(name)
        panel.set_ylim(bottom=0)
        _bars(panel, np.array(bars, dtype=int), dt_s)
        panel.margins(x=0.005)
    axes[-1].set_xlabel("time [s]")
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=len(handles), frameon=False, title=title)
    _save(figure, path)


def _bars(panel: Axes, rules: Any, dt_s: float) -> None:
    """A row of bars for each rule, above the errors."""
    for bit, (name, colour) in enumerate(zip(RULE_NAMES, RULE_COLOURS, strict=True)):
        _bar(panel, (rules >> bit) & 1, dt_s, bit, name, colour)


def _bar(panel: Axes, flags: Any, dt_s: float, row: int, name: str, colour: str) -> None:
    """Bars where ``(T,)`` flags are set, and their name, in a row above the panel."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], np.asarray(flags, dtype=bool), [False]]).astype(int)))
    spans = [(dt_s * start, dt_s * (end - start)) for start, end in edges.reshape(-1, 2)]
    transform = panel.get_xaxis_transform()
    panel.broken_barh(spans, (1.02 + 0.075 * row, 0.05), color=colour, clip_on=False, transform=transform, lw=0)
    panel.text(1.004, 1.01 + 0.075 * row, name, transform=panel.transAxes, color=colour, fontsize=7, va="bottom")


def draw_paths(lines: Sequence[Line], trial: Trial, scene: ViewpointScene, path: Path) -> None:
    """Feature, naive camera and camera in space, with the no-go zone, one panel for each controller (Fig. 5 c)."""
    columns = min(3, len(lines))
    rows = -(-len(lines) // columns)
    figure, axes = _figure(5.2 * columns, 4.9 * rows, rows, columns, subplot_kw={"projection": "3d"})
    feature = 1e3 * trial.T_world_feature[:, :3, 3]
    naive = 1e3 * naive_pose(trial.T_world_feature, scene.distance_m)[:, :3, 3]
    corners = 1e3 * scene.workspace.zone.corners
    centre = corners.mean(axis=0)
    for panel, line in zip(np.ravel(axes), lines, strict=False):
        camera = 1e3 * (scene.T_world_base @ scene.arm.forward(np.array(line.record.frames.joints)))[:, :3, 3]
        panel.plot(*(naive - centre).T, color=NAIVE_COLOUR, lw=0.5, alpha=0.7, label="naive pose")
        panel.plot(*(camera - centre).T, color=CAMERA_COLOUR, lw=0.9, label="camera")
        panel.plot(*(feature - centre).T, color=FEATURE_COLOUR, lw=1.2, label="ring")
        for a, b in EDGES:
            panel.plot(*(corners[[a, b]] - centre).T, color=ZONE_COLOUR, lw=0.9)
        panel.set_title(line.label, fontsize=10)
        panel.set(xlabel="x [mm]", ylabel="y [mm]", zlabel="z [mm]")
        panel.set_aspect("equal")
        panel.set_box_aspect(None, zoom=0.8)  # so that no label is cut off
        panel.view_init(elev=22, azim=-60)
    for panel in np.ravel(axes)[len(lines) :]:
        panel.set_visible(False)
    handles, labels = np.ravel(axes)[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=3, frameon=False)
    _save(figure, path)


def draw_centroids(lines: Sequence[Line], width: int, height: int, path: Path, title: str) -> None:
    """Where the feature was in the left and right pictures, as densities, by geometry (Figs. 6 c and d).

    Args:
        lines: Of one trial.
        width: Of a picture, pixels.
        height: Of a picture.
        path: PNG to write.
        title: Over the figure.
    """
    figure, axes = _figure(3.2 * len(lines), 5.6, 2, len(lines), squeeze=False, sharex=True, sharey=True)
    for column, line in enumerate(lines):
        for row, name in enumerate(EYES):
            panel = axes[row, column]
            pixels = found_pixels(line.record, "projected_px")[:, row]
            seen = pixels[np.isfinite(pixels).all(axis=1)]
            bins = (np.arange(0, width + 1, 8) - 0.5, np.arange(0, height + 1, 8) - 0.5)
            panel.hist2d(seen[:, 0], seen[:, 1], bins=bins, cmin=1, cmap="viridis", norm="log")
            panel.plot(width / 2, height / 2, "x", color=CAMERA_COLOUR, ms=9, mew=2)
            panel.set(xlim=(0, width), ylim=(height, 0))
            panel.set_aspect("equal")
            if row == 0:
                panel.set_title(line.label, fontsize=9)
            if column == 0:
                panel.set_ylabel(f"{name}: v [px]")
        axes[1, column].set_xlabel("u [px]")
    figure.suptitle(title, fontsize=10)
    _save(figure, path)


def draw_pixel_errors(lines: Sequence[Line], width: int, height: int, dt_s: float, path: Path, title: str) -> None:
    """How far the feature was from the middle of both pictures over time, across and down (Figs. 6 e to h).

    Lines by geometry, with gaps and a bar above where the ring was not seen, and dots by the tags where pictures were
    taken.

    Args:
        lines: Of one trial.
        width: Of a picture, pixels.
        height: Of a picture.
        dt_s: Seconds between steps.
        path: PNG to write.
        title: Over the figure.
    """
    figure, axes = _figure(15, 9.5, 4, 1, sharex=True)
    middle = np.array([width / 2, height / 2])
    panels = [(f"{eye}: |{axis} error| [px]", row, k) for row, eye in enumerate(EYES) for k, axis in enumerate("uv")]
    for panel, (name, row, axis) in zip(axes, panels, strict=True):
        for number, (colour, line) in enumerate(zip(COLOURS, lines, strict=False)):
            off = np.abs(found_pixels(line.record, "projected_px")[:, row] - middle)[:, axis]
            panel.plot(dt_s * np.arange(1, len(off) + 1), off, color=colour, lw=0.9, label=line.label)
            _bar(panel, np.isnan(off), dt_s, number, "not seen", colour)
            steps = [step for step, found in enumerate(line.record.frames.tags_px) if found is not None]
            tags = np.abs(found_pixels(line.record, "tags_px")[:, row] - middle)[:, axis]
            panel.plot(dt_s * (np.array(steps) + 1), tags, ".", color=colour, ms=2.2, alpha=0.5)
        panel.set_ylabel(name)
        panel.set_ylim(bottom=0)
        panel.margins(x=0.005)
    axes[-1].set_xlabel("time [s]")
    handles, labels = axes[0].get_legend_handles_labels()
    title += "; lines and bars: by geometry; dots: by tags"
    figure.legend(handles, labels, loc="outside upper center", ncols=len(handles), frameon=False, title=title)
    _save(figure, path)


def _figure(width: float, height: float, rows: int, columns: int, **options: Any) -> tuple[Figure, Any]:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)  # no display, no global state
    axes = figure.subplots(rows, columns, **options)
    if "subplot_kw" not in options:
        for panel in np.ravel(axes):
            panel.grid(color="0.9", lw=0.6)
            panel.set_axisbelow(True)
            for side in ("top", "right"):
                panel.spines[side].set_visible(False)
    return figure, axes


def _save(figure: Figure, path: Path) -> None:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=DPI, metadata={"Software": None})
    write_atomic(path, buffer.getvalue())


assert len(RULE_NAMES) == len(RULE_COLOURS) == len(CONSTRAINTS)
