"""``surgbench export``: datasets and estimates in other people's formats."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer


def export(
    source: Annotated[
        Path, typer.Argument(metavar="DATASET|RUNS", help="A dataset's folder, a folder of records, or one record.")
    ],
    format_: Annotated[
        str, typer.Option("--format", metavar="NAME", help="bop, card, coco, croissant, csv, tum, or one of your own.")
    ],
    out: Annotated[Path, typer.Option(metavar="DIR", help="A new or empty folder.")],
    dataset: Annotated[
        Path | None, typer.Option(metavar="PATH", help="Where the dataset of the runs is, if it moved since.")
    ] = None,
    set_: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="NAME.option=value", help="An option of the format; may be repeated."),
    ] = None,
) -> None:
    """Write a dataset, or what trackers estimated, in another format.

    Example: surgbench export runs --format csv --out poses

    What each format holds: docs/exchange.md. Its options: surgbench list exporters.
    """
    from surgbench.cli.progress import progress
    from surgbench.dataset.storage import check_new
    from surgbench.errors import ConfigError
    from surgbench.exporting import export as export_to
    from surgbench.exporting import read_material
    from surgbench.locks import sole_writer
    from surgbench.registry import create, find
    from surgbench.suite.suites import parse_sets

    found = find("exporter", format_)
    options = parse_sets(set_ or [])
    for name in options:
        if name != found.name:
            raise ConfigError(f"--set {name}.…: this is the format '{found.name}'; its options are {found.name}.…")
    exporter = create(found, options.get(found.name, {}))
    with sole_writer(out, "export"):
        check_new(out)
        material = read_material(source, dataset)
        for line in material.left_out:
            print(f"left out, for it has no estimate: {line}", file=sys.stderr)
        with progress("frames", exporter.count(material)) as advance:
            export_to(exporter, material, out, advance)
    print(out)
