"""``surgbench generate``."""

from __future__ import annotations

import os
import sys
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated

import typer

from surgbench.cli.completion import files
from surgbench.cli.forecast import duration
from surgbench.cli.progress import progress


def generate(
    preset: Annotated[
        str,
        typer.Argument(
            metavar="PRESET|FILE.yaml", help="A preset's name, or a preset file.", autocompletion=files("presets")
        ),
    ],
    out: Annotated[
        Path, typer.Option(help="The dataset's folder: new, empty, or an interrupted one of the same settings.")
    ],
    sequences: Annotated[int | None, typer.Option(help="Pairs of trajectories or trials, not the preset's.")] = None,
    frames: Annotated[int | None, typer.Option(help="Frames or samples of each, not the preset's.")] = None,
    seed: Annotated[int | None, typer.Option(help="Seed, instead of the preset's.")] = None,
    jobs: Annotated[
        int | None, typer.Option(min=1, help="Worker processes; all cores unless told. The bytes do not depend on it.")
    ] = None,
    scheduler: Annotated[
        str | None,
        typer.Option(
            metavar="ADDRESS", help="A Dask cluster does the work, whose machines see --out; --jobs is its limit then."
        ),
    ] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Say what would be made, and what time and disk it takes; make nothing.")
    ] = False,
    corruption: Annotated[
        str | None,
        typer.Option(metavar="published|strong|none", help="How the masks are corrupted, instead of the preset's."),
    ] = None,
    set_: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="KEY=VALUE",
            help="Any key of the preset, for example occluders.tissue=0.4 or instances.swap_rate=0.05; may be "
            "repeated. The dataset's name tells it.",
        ),
    ] = None,
) -> None:
    """Make a synthetic dataset: trajectories, masks, keypoints, joint readings, ground truth; or a wire chaser.

    Example: surgbench generate mini --out data/mini

    Example: surgbench generate occlusion --set occluders.tissue=0.4 --out data/occlusion-tissue-0.4

    The same preset and seed give the same bytes. After an interruption the same command goes on where it stopped.
    """
    from surgbench.generation import GenerationRequest, Workers, parse_settings
    from surgbench.generators.dispatch import plan_preset
    from surgbench.generators.resumable import generate as make
    from surgbench.processes.pool import ProcessPool

    plan = plan_preset(preset, GenerationRequest(sequences, frames, seed, corruption, set=parse_settings(set_ or [])))

    most = jobs or min(len(os.sched_getaffinity(0)), max(1, plan.frames // 20))

    def say(line: str) -> None:
        print(line, file=sys.stderr, flush=True)

    if dry_run:
        from surgbench.generators.forecast import frame_seconds

        seconds = frame_seconds(plan) * plan.frames / most
        size = f"{plan.disk_bytes / 1e6:.0f} MB"
        say(f"{plan.name}: {plan.counts}, about {size} and {duration(seconds)} with --jobs {most}")
        return
    with ExitStack() as held:
        workers: Workers
        if scheduler is None:
            workers = ProcessPool(most)
        else:
            from surgbench.cluster.connection import connect
            from surgbench.cluster.tasks import ClusterWorkers

            workers = ClusterWorkers(held.enter_context(connect(scheduler, say)), jobs)
        advance = held.enter_context(progress("frames", plan.frames))
        made = make(plan, out if scheduler is None else out.absolute(), workers=workers, say=say, progress=advance)
    if not made:
        say("complete already, nothing to do")
    print(out)
