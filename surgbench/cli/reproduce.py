"""``surgbench reproduce``."""

from __future__ import annotations

import os
import sys
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from surgbench.cli.completion import files
from surgbench.cli.progress import Bar, progress

if TYPE_CHECKING:
    from surgbench.reproduce.datasets import PartRequest
    from surgbench.reproduce.table import DatasetRequest, Definition, ImportRequest

COMMITTED, OWN = Path("results"), Path("reproduced")


def reproduce(
    table: Annotated[
        str,
        typer.Argument(
            metavar="TABLE|FILE.yaml", help="A table's name, or a table file.", autocompletion=files("tables")
        ),
    ],
    arms: Annotated[
        Literal["single", "dual"], typer.Option(help="The table of single arms, or that of pairs in one image.")
    ] = "single",
    surgpose: Annotated[
        Path | None, typer.Option(metavar="DIR", help="SurgPose on your disk: the table's rows on its recordings.")
    ] = None,
    surgpose_masks: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Masks of SurgPose: TRAJECTORY/PSM1 and PSM3. Default: in --surgpose."),
    ] = None,
    masks: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="Of recordings: also rows from pixels to poses, with this mask source."),
    ] = None,
    set_: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="NAME.option=value", help="An option of that mask source; may be repeated."),
    ] = None,
    quick: Annotated[bool, typer.Option("--quick", help="Every row on a small fixed share; not to be quoted.")] = False,
    check: Annotated[
        bool, typer.Option("--check", help="Run a part of a finished table again and compare; nothing is written.")
    ] = False,
    row: Annotated[
        list[str] | None,
        typer.Option(metavar="ID", help="Run this row of a finished table again, and no other; may be given again."),
    ] = None,
    render: Annotated[
        bool, typer.Option("--render", help="Only write the Markdown page again, from the files beside it.")
    ] = False,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR", help="The table's folder is in here. Default: reproduced; with --check or --render: results."
        ),
    ] = None,
    data: Annotated[Path, typer.Option(metavar="DIR", help="Folder of datasets; what is missing is made.")] = Path(
        "data"
    ),
    jobs: Annotated[
        int | None, typer.Option(min=1, help="Runs at a time; all cores unless told. Times are measured one by one.")
    ] = None,
) -> None:
    """Make a published table again: datasets, runs, CSV, Markdown, figure, fingerprints.

    Example: surgbench reproduce table1 --quick

    Example: surgbench reproduce table1 --arms dual

    Example: surgbench reproduce table1 --surgpose SurgPose --surgpose-masks masks --masks sam2 --set sam2.model=DIR

    Whatever is interrupted goes on with the same command. --check takes the table in DIR, sees whether its files agree,
    runs a part of it again that its hash and the git commit choose, and ends with exit code 1 where it comes out
    differently. A run that fails makes exit code 1 too.
    """
    from surgbench.config import is_file
    from surgbench.errors import ConfigError
    from surgbench.report.fold import terminal
    from surgbench.reproduce.load import ToldMasks, load_table
    from surgbench.reproduce.make import render as render_page
    from surgbench.reproduce.make import reproduce as make_table
    from surgbench.reproduce.make import table_folder
    from surgbench.reproduce.screen import print_table
    from surgbench.suite.suites import parse_sets

    if sum((quick, check, render, bool(row))) > 1:
        raise ConfigError("--quick, --check, --render and --row contradict each other; give one")
    if surgpose_masks is not None and surgpose is None:
        raise ConfigError("--surgpose-masks needs --surgpose DIR")
    if set_ and masks is None:
        raise ConfigError("--set: is for a mask source; give one by --masks NAME")
    told = None if masks is None else ToldMasks(masks, parse_sets(set_ or []))
    definition = load_table(table if is_file(table) else _name(table, arms == "dual", surgpose is not None), told)
    maker = _Maker({"surgpose": (surgpose, {"masks": surgpose_masks})})
    workers = jobs or len(os.sched_getaffinity(0))
    place = out or (COMMITTED if check or render else OWN)
    folder = table_folder(definition, place, quick)
    if check:
        _check(definition, folder, data, workers, maker)
        return
    if render:
        print(render_page(definition, folder))
        return
    results, failures = make_table(definition, place, data, workers, quick, maker, _Watcher(), row or ())
    print_table(definition, results, terminal())
    for failure in failures:
        print(failure, file=sys.stderr)
    print(folder)
    if failures:
        raise typer.Exit(1)


def _name(table: str, dual: bool, surgpose: bool) -> str:
    """Of the table on pairs, on recordings, or both; whoever names that itself need not be told."""
    for suffix, wanted in (("-dual", dual), ("-surgpose", surgpose)):
        if wanted and suffix not in table:
            table += suffix
    return table


class _Watcher:
    def say(self, line: str) -> None:
        print(line, file=sys.stderr, flush=True)

    def progress(self, description: str, total: float) -> AbstractContextManager[Bar]:
        return progress(description, total)


class _Maker:
    """Makes the datasets of tables.

    Args:
        sources: Importer to where its recordings lie, and to what options are told besides; ``None``: not told.
    """

    def __init__(self, sources: dict[str, tuple[Path | None, dict[str, Any]]]) -> None:
        self._sources = sources

    def __call__(self, request: DatasetRequest | ImportRequest, part: PartRequest | None, out: Path, jobs: int) -> None:
        from surgbench.reproduce.table import ImportRequest

        if isinstance(request, ImportRequest):
            self._import(request, out)
        else:
            _generate(request, part, out, jobs)

    def _import(self, request: ImportRequest, out: Path) -> None:
        from surgbench.cli.import_ import import_recordings
        from surgbench.dataset.manifest import MANIFEST_NAME
        from surgbench.errors import ConfigError
        from surgbench.registry import find

        if (out / MANIFEST_NAME).is_file():
            print(f"{out}: imported already; delete it to have it imported again", file=sys.stderr)
            return
        source, options = self._sources.get(request.importer, (None, {}))
        if source is None:
            raise ConfigError(f"dataset {request.folder}: needs --{request.importer} DIR, where its recordings lie")
        told = {name: value for name, value in options.items() if value is not None}
        import_recordings(find("importer", request.importer), {**request.options, **told}, source, out)


def _generate(request: DatasetRequest, part: PartRequest | None, out: Path, jobs: int) -> None:
    from surgbench.errors import DatasetError
    from surgbench.generation import GenerationRequest
    from surgbench.generators.dispatch import plan_preset
    from surgbench.generators.resumable import generate
    from surgbench.processes.pool import ProcessPool

    plan = plan_preset(
        request.preset,
        GenerationRequest(
            request.sequences,
            request.frames,
            request.seed,
            request.corruption,
            part=None if part is None else (part.sequences, part.frames),
            set=request.set,
        ),
    )
    try:
        with progress("frames made", plan.frames) as advance:
            generate(plan, out, workers=ProcessPool(min(jobs, max(1, plan.frames // 20))), progress=advance)
    except DatasetError as error:
        raise DatasetError(str(error).replace("--out", "--data")) from None


def _check(definition: Definition, folder: Path, data: Path, workers: int, maker: _Maker) -> None:
    from surgbench.reproduce.check import check

    problems, verdicts = check(definition, folder, data, workers, maker, _Watcher())
    for verdict in verdicts:
        chosen = verdict.chosen
        print(f"{verdict.outcome:10} {chosen.row.id} {chosen.unit}: {verdict.detail}")
        if verdict.latency is not None:
            print(f"{'':10} {verdict.latency}")
    bad = [verdict for verdict in verdicts if not verdict.good]
    ran = [verdict for verdict in verdicts if verdict.outcome != "skipped"]
    if problems or bad or not ran:
        rows = ", ".join(dict.fromkeys(verdict.chosen.row.id for verdict in bad))
        why = f"rows that come out differently: {rows}" if bad else "no row could be run"
        why = "its files do not agree" if problems else why
        print(f"{folder}: not confirmed: {why}")
        raise typer.Exit(1)
    print(f"{folder}: confirmed ({len(ran)} rows run again, {len(verdicts) - len(ran)} skipped)")
