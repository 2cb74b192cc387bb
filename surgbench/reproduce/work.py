"""The work behind a table: what is to be run, and running what is not recorded yet."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from surgbench.dataset.base import Dataset
from surgbench.kinds import KINDS
from surgbench.records.format import SKIPPED
from surgbench.registry import find
from surgbench.reproduce.datasets import MakeDataset, PartRequest, Watcher, provide
from surgbench.reproduce.results import RECORDS, TIMING, BlockWork, RowWork
from surgbench.reproduce.table import Block, Definition, Table, Timing
from surgbench.suite.asked import RowRequest
from surgbench.suite.perform import ThisMachine
from surgbench.suite.plan import complete
from surgbench.suite.plan import jobs as plan_jobs
from surgbench.suite.run import make_plan, probe_output
from surgbench.suite.run import run as run_plan
from surgbench.suite.running import Run
from surgbench.suite.settings import Job
from surgbench.task import find_task


def plan_block(table: Table, block: Block, dataset: Dataset[Any], quick: bool) -> BlockWork:
    """What is to be run for a block.

    Raises:
        ConfigError: An option that no plug-in of a row takes, or something that the dataset has not.
    """
    task = find_task(dataset.task)
    works = []
    for row in block.rows:
        asked = row.asked(quick)
        if quick:
            runs = min(asked.sequences or table.quick.runs, table.quick.runs)
            frames = min(asked.frames or table.quick.frames, table.quick.frames)
            asked = asked.model_copy(update={"sequences": runs, "frames": frames})
        settings = complete(asked, block.conditions, dataset)
        timing: list[Job] = []
        if not quick:
            timing = plan_jobs(
                complete(_timed(task.timed(asked), row.timing or table.timing), block.conditions, dataset), dataset
            )
        works.append(RowWork(row, settings.hash, tuple(plan_jobs(settings, dataset)), tuple(timing)))
    return BlockWork(block, dataset, tuple(works))


def _timed(asked: RowRequest, timing: Timing) -> RowRequest:
    runs = min(asked.sequences or timing.runs, timing.runs)
    frames = min(asked.frames or timing.frames, timing.frames)
    return asked.model_copy(update={"sequences": runs, "frames": frames})


def lacking(table: Table, quick: bool) -> list[str]:
    """A line for each row that this machine lacks something for."""
    lines = []
    for _, row in table.rows():
        asked = row.asked(quick)
        for kind in KINDS:
            reference = getattr(asked, kind, None)
            reason = None if reference is None else find(kind, reference).unavailable
            if reason is not None:
                lines.append(f"row '{row.id}' will be skipped: {kind} '{reference}' cannot run here: {reason}")
    return lines


def do_work(
    definition: Definition, out: Path, data: Path, jobs: int, quick: bool, make: MakeDataset, watcher: Watcher
) -> tuple[list[BlockWork], list[str]]:
    """Make the datasets that are missing and run what is not recorded; the same call again goes on where it stopped.

    Args:
        definition: The table.
        out: The table's own folder; records go to sub-folders of it.
        data: Folder of datasets.
        jobs: Worker processes; latencies are measured by one at a time whatever this is.
        quick: Only the small share.
        make: Makes datasets.
        watcher: Is told what is going on.

    Returns:
        The work, and a line for each run that failed.

    Raises:
        SurgbenchError: Something cannot be written, or a dataset is at fault.
    """
    table = definition.table
    # First of all, while it can still be mended: what will not be in the table.
    for line in lacking(table, quick):
        watcher.say(line)
    probe_output(out)
    blocks = []
    for block in table.blocks:
        part = PartRequest(block.quick_sequences, table.quick.frames) if quick else None
        watcher.say(f"{block.heading}: dataset {block.dataset.folder}")
        blocks.append(plan_block(table, block, provide(block.dataset, part, data, jobs, make), quick))
    failures: list[str] = []
    for work in blocks:
        planned = [job for row in work.rows for job in row.jobs]
        failures += _run(work, planned, out / RECORDS, jobs, work.block.heading, watcher)
    for work in blocks:
        planned = [job for row in work.rows for job in row.timing]
        failures += _run(work, planned, out / TIMING, 1, f"{work.block.heading}: latencies", watcher)
    return blocks, failures


def _run(work: BlockWork, planned: list[Job], out: Path, workers: int, title: str, watcher: Watcher) -> list[str]:
    plan = make_plan(planned, out)
    if not plan.todo:
        return []
    failures: list[str] = []

    def finished(record: dict[str, Any]) -> None:
        if record["status"] not in ("ok", SKIPPED):
            spec = record["spec"]
            failures.append(f"{spec['row_id']} {spec['unit']}: {record['status']}: {record['error']}")

    watcher.say(f"{title}: {len(plan.todo)} runs, {plan.frames} frames; {plan.done} recorded already")
    with watcher.progress(title, plan.frames) as bar:
        run_plan(plan, work.dataset, out, ThisMachine(workers), Run(bar, bar.stage), finished)
    return failures
