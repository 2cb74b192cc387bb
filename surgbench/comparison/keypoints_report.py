"""What a comparison of keypoint sources is told by: a terminal table, files, pictures."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from surgbench.comparison.keypoints import Group, Seen, picture, worst
from surgbench.files import write_atomic
from surgbench.keypoints.labelled import LabelledMasks
from surgbench.report.field import count, number, text
from surgbench.report.frame import csv_text, to_frame
from surgbench.report.markdown import markdown_table
from surgbench.suite.environment import environment

if TYPE_CHECKING:
    from rich.console import Console

PICTURED = 24
# What datasets are corrupted like, unless their preset says otherwise: the accuracy that one figure stands for.
USUAL = "published"
FIELDS = (
    *text("keypoints", "by", "value"),
    *count("masks"),
    *number("detected_percent", "median_error_px", "p95_error_px"),
    *count("other_masks"),
    *number("false_pair_percent", "all_false_pair_percent", "latency_ms"),
)
HEADINGS = (
    "keypoints", "masks", "asked", "detected\n%", "median\npx", "95 %\npx", "others", "false pairs\n%", "ms",
)  # fmt: skip


def print_groups(rows: Sequence[Group], console: Console) -> None:
    """Print one line a source and group of masks."""
    from rich import box
    from rich.table import Table

    sheet = Table(box=box.SIMPLE_HEAD, padding=0, pad_edge=False)
    for heading in HEADINGS:
        sheet.add_column(heading, justify="left" if heading in HEADINGS[:2] else "right")
    for group in rows:
        sheet.add_row(*_cells(group))
    console.print(sheet)


def _cells(group: Group) -> list[str]:
    found = group.found
    name = group.value if group.by == "all" else f"{group.by} {group.value}"
    numbers = (found.detected_percent, found.median_error_px, found.p95_error_px)
    return [
        group.source,
        name,
        str(found.masks),
        *(_text(number) for number in numbers),
        str(found.other_masks),
        _text(found.false_pair_percent),
        f"{group.latency_ms:.1f}",
    ]


def _text(value: float | None) -> str:
    return "" if value is None else f"{value:.2f}"


def write_report(
    out: Path, rows: Sequence[Group], seen: Mapping[str, Sequence[Seen]], masks: LabelledMasks, command: str
) -> None:
    """Write a comparison to a folder.

    ``metrics.json`` (the first source on masks corrupted as datasets are), ``accuracy.csv``, ``accuracy.md``, and for
    each source ``<name>-worst.png`` and ``<name>-examples.png``.

    Args:
        out: The folder.
        rows: All groups.
        seen: By source, what it made of each mask.
        masks: The masks.
        command: What made it.
    """
    first = next(iter(seen))
    headline = next(
        (group for group in rows if group.source == first and group.value == USUAL),
        next(group for group in rows if group.source == first),
    )
    metrics = {
        **headline.row(),
        "command": command,
        "processor": environment()["machine"]["processor"],
    }
    write_atomic(out / "metrics.json", (json.dumps(metrics, indent=1) + "\n").encode())
    table = to_frame([group.row() for group in rows], FIELDS)
    write_atomic(out / "accuracy.csv", csv_text(table).encode())
    write_atomic(out / "accuracy.md", _markdown(rows).encode())
    for name, answers in seen.items():
        _write_picture(out / f"{name}-worst.png", picture(masks, worst(answers, PICTURED)))
        _write_picture(out / f"{name}-examples.png", picture(masks, answers[:PICTURED]))


def _write_picture(path: Path, image: NDArray[np.uint8]) -> None:
    write_atomic(path, cv2.imencode(".png", image)[1].tobytes())


def _markdown(rows: Sequence[Group]) -> str:
    headings = [heading.replace("\n", " ") for heading in HEADINGS]
    return markdown_table([headings, *map(_cells, rows)], text_columns=2) + "\n"
