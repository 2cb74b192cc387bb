"""Draws docs/images/architecture.png: the rooms of the house, and the way of the data through them.

    .venv/bin/python tools/draw_architecture.py docs/images/architecture.png

Needs the extra ``plots``.
"""

from __future__ import annotations

import sys
from typing import Any

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch

ENGINE, PLUGGED, BUILT_ON, FILES = "#d7e6f5", "#fbe3c8", "#e3e3e3", "#ffffff"
INK, WAY = "#222222", "#B4480B"


def room(axes: Any, x: float, y: float, width: float, height: float, name: str, says: str, colour: str) -> None:
    """A box with a name and what lives there."""
    rounded = "round,pad=0,rounding_size=0.8"
    axes.add_patch(FancyBboxPatch((x, y), width, height, boxstyle=rounded, fc=colour, ec=INK, lw=1))
    name_at = y + height - 1.6 if says else y + height / 2
    axes.text(x + width / 2, name_at, name, ha="center", va="center", fontsize=9.5, weight="bold", color=INK)
    if says:
        axes.text(x + width / 2, y + (height - 2.4) / 2, says, ha="center", va="center", fontsize=7.6, color=INK)


def way(axes: Any, start: tuple[float, float], end: tuple[float, float], says: str = "", above: float = 0.9) -> None:
    """A step of the data."""
    axes.add_patch(FancyArrowPatch(start, end, arrowstyle="-|>", mutation_scale=14, color=WAY, lw=1.8))
    x, y = (start[0] + end[0]) / 2, (start[1] + end[1]) / 2
    axes.text(x, y + above, says, ha="center", va="bottom", fontsize=7.6, color=WAY)


def heading(axes: Any, x: float, y: float, text: str) -> None:
    """What a row of rooms has in common."""
    axes.text(x, y, text, ha="left", va="bottom", fontsize=9, style="italic", color=INK)


def draw() -> Figure:
    """The whole picture."""
    figure = Figure(figsize=(13.5, 9.2), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    axes.set(xlim=(-1, 134), ylim=(2, 93))
    axes.axis("off")

    heading(axes, 0, 90, "the way of the data")
    steps = [
        ("preset", "configs/presets/\n*.yaml", FILES),
        ("generators/", "trajectories,\nmasks by Mitsuba,\ncorruption", PLUGGED),
        ("dataset", "dataset.json\nsequences/\ntruth/", FILES),
        ("child process", "worker of the task,\na tracker from\ntrackers/ or FILE.py", PLUGGED),
        ("record", "one JSON file a run,\nsealed by hashes", FILES),
        ("table", "leaderboard.csv, .md\npictures, video", FILES),
    ]
    width, gap = 17.0, 6.2
    says = ["", "", "what is\nseen", "what is\nsaid", "rows"]
    for place, (name, what, colour) in enumerate(steps):
        x = place * (width + gap)
        room(axes, x, 76, width, 12, name, what, colour)
        if place:
            way(axes, (x - gap, 82), (x, 82), says[place - 1])
    room(axes, 0, 66, 17, 6, "recordings/", "what files mean", BUILT_ON)
    room(axes, 23.2, 66, 17, 6, "exchange/", "importers", PLUGGED)
    way(axes, (17, 69), (23.2, 69))
    way(axes, (40.2, 69), (50, 75.8))
    room(axes, 92.8, 66, 17, 6, "exchange/exporters/", "BOP, COCO, TUM, …", PLUGGED)
    way(axes, (60, 75.8), (92.8, 68.6))
    way(axes, (101.3, 75.8), (101.3, 72.1))
    room(axes, 116, 66, 17, 6, "handeye/", "the robot as a judge", BUILT_ON)
    way(axes, (104, 75.8), (116, 70))

    heading(axes, 0, 62.5, "the engine, surgbench/: knows no task, no tracker and no generator by name")
    engine = [
        ("cli/", "commands; their options\ncome from models"),
        ("dataset/", "manifest, integrity,\nopening, checking"),
        ("suite/", "rows, plan, run:\nwhat is missing is done"),
        ("processes/", "children, threads,\nCtrl-C"),
        ("records/", "format, reading,\nseals"),
        ("report/", "rows, columns,\ntables, drawing"),
        ("reproduce/", "tables from nothing\nto files, and checked"),
        ("conformance/", "does a tracker\nkeep the rules?"),
    ]
    narrow = 15.4
    for place, (name, what) in enumerate(engine):
        room(axes, place * (narrow + 1.4), 52, narrow, 9, name, what, ENGINE)
    room(
        axes,
        0,
        42,
        32.2,
        7.5,
        "registry.py, kinds.py",
        "finds plug-ins of every kind: by folder, entry point, file",
        ENGINE,
    )
    room(
        axes,
        33.6,
        42,
        99.4,
        7.5,
        "task.py: the seam",
        "data · run · report · view · checks: all that the engine asks of a task",
        ENGINE,
    )

    heading(
        axes, 0, 22.5, "tasks, surgbench/tasks/: a folder each; yours, or one behind an entry point, by the same door"
    )
    room(
        axes,
        0,
        25,
        51,
        10,
        "tasks/instrument/",
        "format, dataset, worker (predict, step, update), errors,\nrows, pages, video, checks",
        PLUGGED,
    )
    room(
        axes,
        53,
        25,
        51,
        10,
        "tasks/viewpoint/",
        "trials, worker (controller and simulator), errors,\nrows, pages, figures, checks",
        PLUGGED,
    )
    room(axes, 106, 25, 27, 10, "yours", "tests/toy shows the\nsmallest one", FILES)
    for x in (40, 78, 119):
        way(axes, (x, 35.1), (x, 41.9))
    axes.text(41, 38, "found by name", fontsize=7.6, color=WAY, va="center")

    heading(axes, 0, 16.3, "what tasks and trackers are built on: pure, typed, no files but instruments'")
    ground = [
        ("state, geometry", "Θ, poses"),
        ("camera/", "pinhole, lens"),
        ("instrument/", "kinematics, meshes"),
        ("silhouette/", "exact areas, gradients,\ncontours, no pixels"),
        ("objective, metrics", "eq. 5 to 8, errors"),
        ("search/", "bases of trackers\nthat search"),
        ("keypoints/", "tips in masks"),
        ("viewpoint/", "camera arm, workspace,\nsimulator, optics/"),
    ]
    for place, (name, what) in enumerate(ground):
        room(axes, place * (narrow + 1.4), 6.5, narrow, 9, name, what, BUILT_ON)
    axes.text(
        0, 3, "What is plugged in (orange) imports the engine and what lies below; nothing imports what is plugged in, "
        "and there are no circles (tests/engine/test_structure.py).",
        fontsize=8.5, color=INK,
    )  # fmt: skip
    return figure


if __name__ == "__main__":
    draw().savefig(sys.argv[1], dpi=110, metadata={"Software": None})
