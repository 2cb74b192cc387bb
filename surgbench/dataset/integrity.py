"""Whether a dataset's files are those that its manifest lists: all there, whole, unaltered, and no others."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
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


def check_inside(root: Path, path: Path) -> None:
    """See that a file of a dataset lies in the dataset's folder, wherever links lead.

    Raises:
        DatasetError: It does not; one line.
    """
    if not path.resolve().is_relative_to(root.resolve()):
        raise DatasetError(f"{path}: a link that leads out of the dataset's folder; put the file itself there")


def read_listed(root: Path, file: str, files: Mapping[str, FileEntry]) -> bytes:
    """The bytes of one of a dataset's files, which must be those that the manifest lists.

    Args:
        root: The dataset's folder.
        file: Below it.
        files: What the manifest lists.

    Raises:
        DatasetError: It is not listed, missing, altered, or lies elsewhere; one line.
    """
    path = root / file
    if file not in files:
        raise DatasetError(f"{path}: not listed in {MANIFEST_NAME}, but its sequence needs it")
    check_inside(root, path)
    return read_unaltered(path, files[file])


def read_unaltered(path: Path, listed: FileEntry) -> bytes:
    """A file's bytes, which must be as listed.

    Raises:
        DatasetError: They are not, or it cannot be read; one line.
    """
    data = read_bytes(path)
    problem = difference(path, data, listed)
    if problem is not None:
        raise DatasetError(problem)
    return data


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
            check_inside(root, root / file)
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
