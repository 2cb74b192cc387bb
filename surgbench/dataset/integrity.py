"""Whether a dataset's files are those that its manifest lists: all there, whole, unaltered, and no others."""

from __future__ import annotations

from collections.abc import Callable, Collection
from pathlib import Path

from surgbench.dataset.card import CARD_NAME
from surgbench.dataset.manifest import MANIFEST_NAME, FileEntry, Manifest
from surgbench.dataset.masks import read_bytes
from surgbench.dataset.storage import file_entry
from surgbench.errors import DatasetError
from surgbench.leftovers import without_leftovers

# Metadata for catalogues, as `surgbench export --format croissant` makes it to be put here; like the dataset's card, it
# says nothing new.
METADATA_NAME = "croissant.json"


def difference(path: Path, data: bytes, listed: FileEntry) -> str | None:
    """How a file's bytes differ from what the manifest says of them, one line; ``None`` if they do not."""
    found = file_entry(data)
    if found.bytes < listed.bytes:
        return f"{path}: truncated, {found.bytes} bytes; {MANIFEST_NAME} says {listed.bytes}"
    if found != listed:
        return f"{path}: altered, its SHA-256 is not the one in {MANIFEST_NAME}"
    return None


def check_files(
    root: Path,
    manifest: Manifest,
    expected: Collection[str],
    examine: Callable[[str, bytes], str | None] = lambda file, data: None,
    progress: Callable[[float], None] = lambda files: None,
) -> tuple[list[str], set[str]]:
    """Hold a dataset's folder against its manifest.

    Args:
        root: The folder.
        manifest: What it should hold.
        expected: Files that the manifest must list.
        examine: Takes an expected file and its bytes, unaltered; returns the problem of its content, if it has one.
        progress: Takes the number of files just checked.

    Returns:
        One line per problem, and the files that are there unaltered.
    """
    problems = [
        f"{root / file}: not listed in {MANIFEST_NAME}, but its sequence needs it"
        for file in sorted(set(expected) - set(manifest.files))
    ]
    sound: set[str] = set()
    for file, listed in sorted(manifest.files.items()):
        progress(1)
        try:
            data = read_bytes(root / file)
        except DatasetError as error:
            problems.append(str(error))
            continue
        problem = difference(root / file, data, listed)
        if problem is None:
            sound.add(file)
            problem = examine(file, data) if file in expected else None
        if problem is not None:
            problems.append(problem)
    known = {*manifest.files, MANIFEST_NAME, METADATA_NAME, CARD_NAME}
    for place in sorted(without_leftovers(root.rglob("*"), root)):
        name = place.relative_to(root).as_posix()
        if not place.is_dir() and name not in known:
            problems.append(f"{place}: extra, not listed in {MANIFEST_NAME}")
    return problems, sound
