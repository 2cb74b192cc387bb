"""Checks a dataset on disk against its manifest, its format and common sense."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from surgbench.dataset.open import open_dataset
from surgbench.errors import DatasetError
from surgbench.task import find_task


def validate(path: Path | str, progress: Callable[[float], None] = lambda files: None) -> list[str]:
    """Find everything that is wrong with a dataset.

    Args:
        path: Its folder.
        progress: Takes the number of files just checked.

    Returns:
        One line per problem, each naming the file; empty for a sound dataset.
    """
    try:
        dataset = open_dataset(path)
    except DatasetError as error:
        return [str(error)]
    return find_task(dataset.task).validate(dataset, progress)
