"""What is planned, carried out before the user's eyes: how much it is, how far it is, what came of it."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from surgbench.cli.forecast import tell_forecast
from surgbench.cli.progress import progress

if TYPE_CHECKING:
    from surgbench.dataset.base import Dataset
    from surgbench.suite.perform import Workplace
    from surgbench.suite.running import Run
    from surgbench.suite.settings import Job


def carry_out(
    planned: list[Job],
    dataset: Dataset[Any],
    out: Path,
    *,
    where: Workplace | None = None,
    retry_failed: bool = True,
    again: bool = False,
    dry_run: bool = False,
    begins: Callable[[Run], None] = lambda run: None,
) -> bool:
    """Run what has no record yet, and print the leaderboard of all that was asked for.

    Args:
        planned: What is asked for.
        dataset: What all of it is about.
        out: Folder of records.
        where: Where it is done; ``None`` for this machine, one run at a time.
        retry_failed: Failed runs are tried again.
        again: All are run again.
        dry_run: Say what would be run, and what time and disk it takes, and run nothing.
        begins: Told of the run that begins, which it may stop.

    Returns:
        Whether a run was sound, or there was none to be made.
    """
    from surgbench.records.format import SKIPPED
    from surgbench.records.reader import read_records
    from surgbench.report.fold import terminal
    from surgbench.report.render import print_leaderboard
    from surgbench.report.rows import derive_rows, hints
    from surgbench.suite.perform import ThisMachine
    from surgbench.suite.run import make_plan, probe_output
    from surgbench.suite.run import run as run_plan
    from surgbench.suite.running import Run

    plan = make_plan(planned, out, retry_failed, again)
    if plan.todo and not dry_run:
        probe_output(out)
    words = f"{len(plan.todo) - plan.skipped} runs, {plan.frames} frames to track"
    if plan.skipped:
        words += f"; {plan.skipped} cannot be run here"
    if plan.done:
        words += f"; {plan.done} recorded already"
    if plan.retried:
        words += f"; {plan.retried} failed before and are tried again"
    if plan.again:
        words += f"; {plan.again} recorded already and made again"
    print(words, file=sys.stderr)
    if dry_run:
        for job in plan.todo:
            print(out / job.path)
        if plan.frames:
            tell_forecast(list(plan.todo), dataset, out, (where or ThisMachine()).jobs)
        return True

    failures: list[dict[str, Any]] = []

    def finished(record: dict[str, Any]) -> None:
        if record["status"] not in ("ok", SKIPPED):
            failures.append(record)

    if plan.todo:
        with progress("frames", plan.frames) as bar:
            under_way = Run(bar, bar.stage)
            begins(under_way)
            elsewhere = run_plan(plan, dataset, out, where or ThisMachine(), under_way, finished)
        if elsewhere:
            print(f"{elsewhere} of these were made by another call at the same time", file=sys.stderr)
    for record in failures:
        spec = record["spec"]
        print(f"{spec['row_id']} {spec['unit']}: {record['status']}: {record['error']}", file=sys.stderr)
    # The folder may hold other datasets' and other settings' records: show what was asked for.
    asked_for = [record for record in read_records([out]) if record.spec_hash in {job.hash for job in planned}]
    for line in hints(asked_for):
        print(line, file=sys.stderr)
    print_leaderboard(derive_rows(asked_for), terminal())
    print(out)
    return not failures or len(failures) < len(plan.todo) - plan.skipped
