"""``surgbench view``: sequences and runs in Rerun."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer


def view(
    sources: Annotated[
        list[Path],
        typer.Argument(metavar="DATASET|RUN...", help="A dataset's folder; or folders of records, or records."),
    ],
    unit: Annotated[
        list[str] | None, typer.Option(metavar="ID", help="Show this unit; may be repeated. Default: the first.")
    ] = None,
    row: Annotated[
        list[str] | None, typer.Option(metavar="ROW_ID", help="Of runs: only this row; may be repeated.")
    ] = None,
    every: Annotated[
        int, typer.Option(min=1, max=1000, metavar="N", help="Pictures and outlines of every N-th frame.")
    ] = 1,
    dataset: Annotated[
        Path | None, typer.Option(metavar="PATH", help="Of runs: where the dataset is, if it moved since.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option(metavar="FILE.rrd", help="Write a recording of Rerun, and open nothing.")
    ] = None,
) -> None:
    """Look at a sequence of a dataset, or at what trackers made of it, in space and over time, in Rerun.

    Pictures, masks and outlines, the instruments where they are and where each row has them, cameras, errors; of camera
    runs the arm, the ring, the wire, the zone and what is seen. One timeline, in frames and in seconds. Needs the extra
    ``view``.

    Example: surgbench view data/mini --unit 000

    Example: surgbench view runs --unit 000-left --row cmaes --row hybrid --out seen.rrd
    """
    from surgbench.cli.progress import progress
    from surgbench.errors import ConfigError
    from surgbench.exporting import read_material
    from surgbench.records.reader import only_task, read_runs
    from surgbench.report.stage import ENDING, Stage, Subject, see_that_there_is_a_display
    from surgbench.task import find_task

    if out is not None and out.suffix != ENDING:
        raise ConfigError(f"--out {out}: recordings of Rerun end in {ENDING}")
    if out is not None and out.is_dir():
        raise ConfigError(f"--out {out}: is a folder; expected a file FILE{ENDING}")
    asked = (dataset, tuple(unit or ()), tuple(row or ()), every)
    if len(sources) == 1:
        material = read_material(sources[0], dataset)
        for line in material.left_out:
            print(f"left out, for it has no estimate: {line}", file=sys.stderr)
        subject = Subject(material.dataset, material.records, *asked)
    else:
        subject = Subject(None, tuple(read_runs(sources)), *asked)
    if subject.dataset is not None and row:
        raise ConfigError(f"--row: {sources[0]} is a dataset; rows are of runs")
    task = only_task(subject.records, sources[0]) if subject.dataset is None else find_task(subject.dataset.task)
    if out is None:
        see_that_there_is_a_display()
    stage = Stage(sources[0].resolve().name)
    with stage.watched() if out is None else stage.written(out):
        lines = task.view(subject, stage, progress)
    if out is not None:
        print(out)
    for line in lines:
        print(line, file=sys.stderr)
