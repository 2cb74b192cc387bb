"""``surgbench handeye``: runs held against a robot's readings."""

from __future__ import annotations

import sys
from contextlib import nullcontext
from enum import Enum
from pathlib import Path
from typing import Annotated

import typer


class HandEyeFormat(str, Enum):
    """How to write what was found."""

    table = "table"
    csv = "csv"
    json = "json"


def handeye(
    runs: Annotated[list[Path], typer.Argument(metavar="RUN...", help="Records, or folders of them.")],
    dataset: Annotated[
        Path | None, typer.Option(metavar="PATH", help="Where the dataset is, if it moved since the run.")
    ] = None,
    row: Annotated[
        list[str] | None, typer.Option(metavar="ROW_ID", help="Judge only this row; may be repeated.")
    ] = None,
    output: Annotated[
        HandEyeFormat, typer.Option("--format", help="csv and json hold the hand-eye transform and every digit.")
    ] = HandEyeFormat.table,
    fix_lag: Annotated[
        Path | None,
        typer.Option(metavar="OUT", help="Write the dataset to this new folder, its readings where they belong."),
    ] = None,
) -> None:
    """Judge trackers where there is no truth: hold their wrist poses against the robot's own readings of the arm.

    The two may differ by one constant transform (hand-eye) and one lag, which are estimated; what is left, and cannot
    be the arm's, is the tracker's.

    Example: surgbench handeye runs/suturing --fix-lag data/suturing-aligned
    """
    from surgbench.cli.progress import progress
    from surgbench.errors import SurgbenchError, unknown_name
    from surgbench.handeye.table import FIELDS, print_judged
    from surgbench.locks import sole_writer
    from surgbench.records.reader import only_task, read_runs
    from surgbench.report.frame import csv_text, json_text, to_frame

    records = read_runs(runs)
    rows = {record.spec.row_id for record in records}
    for name in row or ():
        if name not in rows:
            raise SurgbenchError(f"--row: {unknown_name('row', name, rows)}")
    records = [record for record in records if not row or record.spec.row_id in row]
    task = only_task(records, runs[0])
    with nullcontext() if fix_lag is None else sole_writer(fix_lag, "handeye", "--fix-lag"):
        judged = task.hand_eye(records, dataset, fix_lag, progress)
    for note in dict.fromkeys(one.note for one in judged if one.note):
        print(f"surgbench: {note}", file=sys.stderr)
    if output is HandEyeFormat.table:
        from rich.console import Console

        print_judged(judged, Console())
    else:
        frame = to_frame([one.row() for one in judged], FIELDS)
        sys.stdout.write(csv_text(frame) if output is HandEyeFormat.csv else json_text(frame))
    if fix_lag is not None:
        print(fix_lag, file=sys.stdout if output is HandEyeFormat.table else sys.stderr)
