"""``surgbench submit`` and ``surgbench verify``: a leaderboard that others can join."""

from __future__ import annotations

import sys
from collections import Counter
from pathlib import Path
from typing import Annotated

import typer

from surgbench.cli.progress import progress


def submit(
    runs: Annotated[
        list[Path], typer.Argument(metavar="RUN…", help="Folders of records, as surgbench run writes them.")
    ],
    out: Annotated[Path, typer.Option(metavar="FILE", help="The submission: one file, for example mine.zip.")],
    by: Annotated[str, typer.Option(metavar="NAME", help="Who hands it in.")],
    statement: Annotated[
        str, typer.Option(metavar="TEXT", help="What was run: where the method is described, and its code is.")
    ] = "",
) -> None:
    """Put runs into one file to be handed in: records, their hashes, and a statement of what was run.

    Example: surgbench submit runs --by "Lab of X" --statement "https://example.org/method" --out mine.zip

    Runs that failed, or that knew the truth, are refused. What is asked of a submission: docs/board.md.
    """
    from surgbench.board.submission import write_submission

    made = write_submission(runs, out, by, statement)
    datasets = ", ".join(f"{name} ({sha256[:8]})" for name, sha256 in made.datasets.items())
    print(f"{len(made.records)} runs of {', '.join(made.rows)} on {datasets}", file=sys.stderr)
    print(out)


def verify(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="What surgbench submit made.")],
    dataset: Annotated[
        list[Path], typer.Option(metavar="DIR", help="A dataset that the runs are about; may be repeated.")
    ],
    tracker: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME=FILE.py:Class", help="Where a tracker of the submission is; may be repeated."),
    ] = None,
    again: Annotated[int, typer.Option(min=0, metavar="N", help="Runs that are made again.")] = 3,
    frames: Annotated[int, typer.Option(min=1, metavar="N", help="Of each the first N frames.")] = 100,
    salt: Annotated[
        str, typer.Option(metavar="TEXT", help="Goes into the choice of those runs; known to nobody who hands in.")
    ] = "",
) -> None:
    """See whether a submission's numbers are right: refuse it, or show its leaderboard.

    Example: surgbench verify mine.zip --dataset data/paper

    All estimates are scored again against the truth. N runs, chosen by the file's hash, are made again where their
    tracker is here; one of somebody else is run with your rights, and only where you name it. The exit code is 1 where
    something does not fit; it is 0 where all that could be looked at fits, and the last line says what could not.
    """
    from rich.console import Console

    from surgbench.board.submission import read_submission
    from surgbench.board.verify import choose, incomplete, rescore, run_again
    from surgbench.dataset.open import open_dataset
    from surgbench.errors import ConfigError, SurgbenchError, unknown_name
    from surgbench.report.render import print_leaderboard
    from surgbench.report.rows import derive_rows
    from surgbench.suite.running import Run

    places = dict(one.partition("=")[::2] for one in tracker or [])
    wrong = next((name for name, place in places.items() if not place), None)
    if wrong is not None:
        raise ConfigError(f"--tracker {wrong}: must be NAME=FILE.py:Class")
    submission = read_submission(file)
    datasets = {one.hash: one for one in map(open_dataset, dataset)}
    told = submission.statement
    trackers = sorted({record.spec.tracker.name for record in submission.records})
    for name in places:
        if name not in trackers:
            raise ConfigError(f"--tracker {name}: {unknown_name('tracker of the submission', name, trackers)}")
    print(f"{', '.join(told.rows)} by {told.by}, made with {told.created_by}", file=sys.stderr)
    if told.text:
        print(told.text, file=sys.stderr)
    findings = []
    with progress("frames scored again", sum(len(record.frames.index) for record in submission.records)) as bar:
        for number in range(len(submission.records)):
            findings.append(rescore(submission, number, datasets, Run(bar, bar.stage)))
    chosen = choose(submission, again, salt)
    with progress(
        "frames run again", sum(min(frames, len(submission.records[one].frames.index)) for one in chosen)
    ) as bar:
        for number in chosen:
            findings.append(run_again(submission, number, datasets, places, frames, Run(bar, bar.stage)))
    if not any(one.outcome != "unknown" and one.what == "scored again" for one in findings):
        raise SurgbenchError(f"{file}: nothing of it can be scored here: {findings[0].detail}")
    problems = [*incomplete(submission, datasets), *(one.line for one in findings if one.outcome == "differs")]
    for one in findings:
        if one.what == "run again":
            print(one.line, file=sys.stderr)
    open_ = Counter(one.detail for one in findings if one.outcome == "unknown" and one.what == "scored again")
    for detail, count in open_.items():
        print(f"{count} runs: not scored again: {detail}", file=sys.stderr)
    print_leaderboard(derive_rows(submission.records), Console())
    for problem in problems:
        print(f"refused: {problem}")
    if problems:
        raise typer.Exit(1)
    counts = {what: sum(one.what == what and one.outcome == "fits" for one in findings) for what in _DONE}
    unknown = sum(one.outcome == "unknown" for one in findings)
    said = ", ".join(f"{count} {what}" for what, count in counts.items())
    print(
        f"{'fits' if not unknown else 'fits as far as could be seen'}: {said}"
        + (f", {unknown} unknown" if unknown else "")
    )


_DONE = ("scored again", "run again")
