"""``surgbench score``: records of estimates that another program made."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Annotated, Literal

import typer


def score(
    dataset: Annotated[Path, typer.Argument(metavar="DATASET", help="What the estimates were made on.")],
    estimates: Annotated[
        Path, typer.Argument(metavar="ESTIMATES.csv", help="With the columns that export --format csv writes.")
    ],
    name: Annotated[str, typer.Option(metavar="NAME", help="What the row is called in tables.")],
    time_ms: Annotated[
        str | None, typer.Option(metavar="COLUMN", help="Column with the milliseconds that each frame took.")
    ] = None,
    arms: Annotated[
        Literal["single", "dual"] | None,
        typer.Option(help="Whether each arm was tracked alone or pairs in one mask; default: single."),
    ] = None,
    frames: Annotated[int | None, typer.Option(min=1, metavar="N", help="Only the first N frames of each.")] = None,
    joints: Annotated[
        bool, typer.Option("--joints", help="The estimates were made with the dataset's joint readings.")
    ] = False,
    again: Annotated[bool, typer.Option("--again", help="Score what is recorded already, too.")] = False,
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder of records.")] = Path("runs"),
) -> None:
    """Score estimates from a file: they become records like those of run, marked 'from file'.

    Example: surgbench score data/mini mine.csv --name mine --time-ms latency_ms

    A row per arm and frame: sequence, arm, frame; x_m, y_m, z_m and qw, qx, qy, qz of the wrist-pitch frame in the
    camera's; q1_rad, q2_rad, q3_rad. Other forms and units: docs/exchange.md.
    """
    from surgbench.cli.progress import progress
    from surgbench.config import parse_model
    from surgbench.dataset.open import open_dataset
    from surgbench.errors import ConfigError
    from surgbench.kinds import NAME_PATTERN
    from surgbench.records.reader import read_records
    from surgbench.report.fold import terminal
    from surgbench.report.render import print_leaderboard
    from surgbench.report.rows import derive_rows, hints
    from surgbench.suite.asked import FileRequest
    from surgbench.suite.score import FileScore

    if not re.fullmatch(NAME_PATTERN, name):
        raise ConfigError(f"--name: must be letters, digits, '.', '_' and '-', not '{name}'")
    told = {"name": name, "time_column": time_ms, "arms": arms, "frames": frames, "joints": joints}
    asked = parse_model(FileRequest, {key: value for key, value in told.items() if value is not None}, "command line")
    work = FileScore(open_dataset(dataset), estimates, asked, out, again)
    if work.plan.done:
        print(f"{work.plan.done} recorded already", file=sys.stderr)
    with progress("frames", sum(job.frames for job in work.plan.todo)) as advance:
        work.run(advance)
    hashes = {job.hash for job in work.jobs}
    scored = [one for one in read_records([out]) if one.spec_hash in hashes]
    for line in hints(scored):
        print(line, file=sys.stderr)
    print_leaderboard(derive_rows(scored), terminal())
    print(out)
