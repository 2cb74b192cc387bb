"""Dataset cards: what a dataset is, for people and for hubs that read the head of a Markdown file (YAML)."""

from __future__ import annotations

from dataclasses import dataclass, field

import yaml

# Where a card lies in a dataset's folder when it is published there.
CARD_NAME = "README.md"
# Bounds of the hubs' size categories, in frames.
_SIZES = ((1_000, "n<1K"), (10_000, "1K<n<10K"), (100_000, "10K<n<100K"), (1_000_000, "100K<n<1M"))
LARGEST = "n>1M"
MB = 1e6


@dataclass(frozen=True)
class Facts:
    """What a card says.

    Attributes:
        name: The dataset's.
        task: What trackers do on it.
        what: A sentence or two.
        origin: ``generated`` or ``imported``.
        units: Id to its number of frames; ``None`` where only the sum is known.
        frames: Of all of them.
        sensors: What was observed, a line each.
        truth: What is true, a line each; empty without truth.
        cameras: A line each.
        conventions: Word to text, as in the manifest.
        lengths: The manifest's units: quantity to name.
        limits: What is known not to be so, a line each.
        sha256: Of ``dataset.json``.
        bytes: Of all files; ``None`` where that is not known.
        created_by: Program and version.
        command: How it is made again; ``None`` where it cannot.
        tables: Names of the reproduced tables that it is behind.
        licence: As hubs name it, for example ``apache-2.0``.
        tags: For searching.
        cite: How to cite it.
        notes: Further lines on the checksum.
    """

    name: str
    task: str
    what: str
    origin: str
    units: dict[str, int | None]
    frames: int
    sensors: list[str]
    truth: list[str]
    cameras: list[str]
    conventions: dict[str, str]
    lengths: dict[str, str]
    limits: list[str]
    sha256: str
    bytes: int | None
    created_by: str
    command: str | None
    tables: list[str] = field(default_factory=list)
    licence: str = "unknown"
    tags: list[str] = field(default_factory=list)
    cite: str = ""
    notes: list[str] = field(default_factory=list)


def size_category(frames: int) -> str:
    """The category that hubs have for so many frames."""
    return next((name for bound, name in _SIZES if frames < bound), LARGEST)


def card(facts: Facts) -> str:
    """The card, Markdown with a YAML head."""
    head = {
        "license": facts.licence,
        "pretty_name": facts.name,
        "task_categories": ["robotics"],
        "tags": facts.tags,
        "size_categories": [size_category(facts.frames)],
        "configs": [
            {"config_name": "observations", "data_files": [_split("sequences/*/observations.parquet")]},
        ],
    }
    known = [(name, frames) for name, frames in facts.units.items() if frames is not None]
    counted = f"{len(facts.units)} sequence{'s' if len(facts.units) > 1 else ''}, {facts.frames} frames"
    size = "" if facts.bytes is None else f", {facts.bytes / MB:.1f} MB"
    parts = [
        f"---\n{yaml.safe_dump(head, sort_keys=False, allow_unicode=True).rstrip()}\n---",
        f"# {facts.name}",
        facts.what,
        f"A dataset of the {facts.task} task of surgbench, {facts.origin}: {counted}{size}. All of it is for testing; "
        "there is no training split.",
        "## How it is made",
        f"```sh\n{facts.command}\n```"
        if facts.command
        else "From recordings; `dataset.json` has the options of the import.",
        f"Made by {facts.created_by}. The whole effective configuration is in `dataset.json`.",
    ]
    if facts.tables:
        parts.append(f"Reproduced tables on it: {', '.join(f'`{name}`' for name in facts.tables)}.")
    parts += [
        "## Checksum",
        f"SHA-256 of `dataset.json`, which holds that of every other file: `{facts.sha256}`",
        *facts.notes,
        "## What was observed",
        _list(facts.sensors),
        "## Cameras",
        _list(facts.cameras),
        "## What is true",
        _list(facts.truth) if facts.truth else "Nothing: a recording without truth.",
        "## Sequences",
        _table(known) if known else ", ".join(facts.units),
        "## Units and conventions",
        _list([f"{quantity}: {unit}" for quantity, unit in facts.lengths.items()]),
        _list([f"{word}: {text}" for word, text in facts.conventions.items()]),
        "## Known limits",
        _list(facts.limits),
        "## Licence and citation",
        f"Licence: {facts.licence}.",
    ]
    if facts.cite:
        parts.append(f"```bibtex\n{facts.cite}\n```")
    return "\n\n".join(parts) + "\n"


def _split(path: str) -> dict[str, str]:
    return {"split": "test", "path": path}


def _list(lines: list[str]) -> str:
    # Whatever a manifest says is one line of text.
    return "\n".join(f"- {' '.join(line.split()).replace('<', '&lt;')}" for line in lines)


def _table(rows: list[tuple[str, int]]) -> str:
    return "\n".join(["| sequence | frames |", "|---|---:|", *(f"| {name} | {frames} |" for name, frames in rows)])
