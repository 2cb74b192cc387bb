"""``surgbench run``."""

from __future__ import annotations

import sys
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from surgbench.cli.carry_out import carry_out
from surgbench.cli.completion import files, plugins

# Headings of the help.
WHAT, MUCH, HOW, WORK = "What is run", "How much of it", "Under which conditions", "The work"


def run(
    asked: dict[str, Any],
    dataset: Annotated[
        list[Path] | None,
        typer.Option(metavar="DIR", help="A dataset's folder; may be repeated.", rich_help_panel=WHAT),
    ] = None,
    tracker: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME|FILE.py:Class",
            help="A tracker; may be repeated.",
            rich_help_panel=WHAT,
            autocompletion=plugins("tracker"),
        ),
    ] = None,
    suite: Annotated[
        str | None,
        typer.Option(
            metavar="NAME|FILE.yaml",
            help="Rows from a suite instead of --tracker.",
            rich_help_panel=WHAT,
            autocompletion=files("suites"),
        ),
    ] = None,
    no_joints: Annotated[
        bool, typer.Option("--no-joints", help="Without joint readings, as is the default.", rich_help_panel=HOW)
    ] = False,
    joints: Annotated[
        bool,
        typer.Option(
            "--joints", help="With the dataset's own readings: a recording's, or noisy ones.", rich_help_panel=HOW
        ),
    ] = False,
    arms: Annotated[
        Literal["single", "dual"] | None,
        typer.Option(help="Each arm alone, or pairs in one mask.", rich_help_panel=HOW),
    ] = None,
    set_: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="NAME.option=value",
            help="An option, of every row in which NAME takes part; may be repeated.",
            rich_help_panel=WHAT,
        ),
    ] = None,
    sequences: Annotated[
        int | None,
        typer.Option(min=1, metavar="N", help="Only N arms or pairs, spread over the dataset.", rich_help_panel=MUCH),
    ] = None,
    frames: Annotated[
        int | None, typer.Option(min=1, metavar="N", help="Only the first N frames of each.", rich_help_panel=MUCH)
    ] = None,
    repeats: Annotated[
        int | None, typer.Option(min=1, help="Runs per sequence, each with its own seed.", rich_help_panel=MUCH)
    ] = None,
    seed: Annotated[int | None, typer.Option(min=0, help="Default: 0.", rich_help_panel=HOW)] = None,
    jobs: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="Runs at a time; default: 1, which is for latencies, or all that the cluster can.",
            rich_help_panel=WORK,
        ),
    ] = None,
    scheduler: Annotated[
        str | None,
        typer.Option(
            metavar="ADDRESS",
            help="A Dask cluster does the work, whose machines see the datasets and trackers where they are here.",
            rich_help_panel=WORK,
        ),
    ] = None,
    timeout: Annotated[
        float | None,
        typer.Option(metavar="S", help="Longest wait for one answer of a tracker; default: 120.", rich_help_panel=HOW),
    ] = None,
    memory: Annotated[
        str | None,
        typer.Option(
            metavar="SIZE",
            help="What a tracker's process may use, as 2GB, with what it starts; default: no limit.",
            rich_help_panel=HOW,
        ),
    ] = None,
    device: Annotated[
        Literal["cpu", "cuda"] | None,
        typer.Option(help="Where trackers score candidates; default: cpu.", rich_help_panel=HOW),
    ] = None,
    retry_failed: Annotated[
        bool,
        typer.Option("--retry-failed/--keep-failed", help="Whether failed runs are tried again.", rich_help_panel=WORK),
    ] = True,
    again: Annotated[
        bool,
        typer.Option(
            "--again", help="Run everything again; records that are there are replaced.", rich_help_panel=WORK
        ),
    ] = False,
    dry_run: Annotated[
        bool,
        typer.Option(
            "--dry-run",
            help="Say what would be run, and what time and disk it takes; record nothing.",
            rich_help_panel=WORK,
        ),
    ] = False,
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder of records.", rich_help_panel=WORK)] = Path("runs"),
) -> None:
    """Run trackers on a dataset; every run becomes a record, and is not run again.

    Example: surgbench run --dataset data/mini --tracker cmaes --set cmaes.iterations=5

    Example: surgbench run --dataset data/chaser --tracker gaze --tracker autocam

    A tracker runs in a process of its own that is sent observations only. FILE.py:Class runs that file with
    your rights. A failed run is a record too; the exit code is 1 where every run failed. What this machine lacks
    something for is skipped and recorded with the reason.
    """
    from surgbench.dataset.open import open_dataset
    from surgbench.errors import ConfigError
    from surgbench.suite.perform import ThisMachine, Workplace
    from surgbench.suite.plan import complete_all
    from surgbench.suite.plan import jobs as plan_jobs
    from surgbench.suite.run import check_output
    from surgbench.suite.suites import from_command_line, load_suite, parse_sets

    row = {**asked, **_shorthand(asked, joints, no_joints), "sequences": sequences, "frames": frames}
    conditions = {
        **{"arms": arms, "seed": seed, "repeats": repeats},
        **{"timeout_s": timeout, "memory": memory, "device": device},
    }
    base = None if suite is None else load_suite(suite)
    suite_ = from_command_line(base, tracker or [], row, conditions)
    overrides = parse_sets(set_ or [])
    places = dataset or ([] if base is None else list(base.datasets))
    if not places:
        raise ConfigError("say on what: --dataset DIR (made by: surgbench generate), or 'datasets' in the suite's file")
    check_output(out)
    planned = []
    for data in map(open_dataset, places):  # all of it, before anything is run
        rows = complete_all(suite_.rows, suite_, data, overrides)
        planned.append((data, [job for one in rows for job in plan_jobs(one, data)]))
    with ExitStack() as held:
        where: Workplace = ThisMachine(jobs or 1)
        if scheduler is not None and not dry_run:
            from surgbench.cluster.connection import connect
            from surgbench.cluster.runs import ClusterRuns

            where = ClusterRuns(held.enter_context(connect(scheduler, _say)), jobs)
        sound = [
            carry_out(jobs_, data, out, where=where, retry_failed=retry_failed, again=again, dry_run=dry_run)
            for data, jobs_ in planned
        ]
    if not any(sound):
        raise typer.Exit(1)


def _say(line: str) -> None:
    print(line, file=sys.stderr, flush=True)


def _shorthand(asked: dict[str, Any], joints: bool, no_joints: bool) -> dict[str, Any]:
    """What ``--joints`` and ``--no-joints`` stand for.

    Raises:
        ConfigError: They contradict each other, or what is asked for beside them.
    """
    from surgbench.errors import ConfigError

    given = [word for word, there in (("none", no_joints), ("noisy", joints)) if there]
    if len({*given, *([asked["readings"]] if "readings" in asked else [])}) > 1:
        raise ConfigError("--no-joints, --joints and --readings contradict each other; give one")
    return {"readings": given[0]} if given else {}
