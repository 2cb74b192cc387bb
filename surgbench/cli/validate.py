"""``surgbench validate``."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from surgbench.cli.progress import progress


def validate(path: Annotated[Path, typer.Argument(metavar="PATH", help="A dataset's folder.")]) -> None:
    """Check a dataset: every file there, unaltered and whole; shapes, numbers and angles as they must be.

    Example: surgbench validate data/mini

    Prints one line per problem, each naming the file, and exits with 2; or a summary and exits with 0.
    """
    from surgbench.dataset.open import open_dataset
    from surgbench.dataset.validate import validate as check

    dataset = open_dataset(path)
    manifest = dataset.manifest
    with progress("files", len(manifest.files)) as advance:
        problems = check(path, advance)
    for problem in problems:
        print(problem, file=sys.stderr)
    if problems:
        raise typer.Exit(2)
    counts = f"{manifest.counts}, {len(manifest.files)} files"
    print(f"{path}: sound; '{manifest.name}', {counts}, hash {dataset.hash}")
