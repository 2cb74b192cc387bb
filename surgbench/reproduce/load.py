"""Table files, read and checked."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from surgbench.config import locate, parse_model, read_yaml
from surgbench.errors import ConfigError, NotFoundError, unknown_name
from surgbench.kinds import KINDS
from surgbench.registry import configure, find
from surgbench.reproduce.published import Published, load_published
from surgbench.reproduce.table import Block, Definition, TableRow, table_model
from surgbench.task import default_task, find_task

# Rows of recordings whose masks are made by whatever the command line names.
TOLD = "told"


@dataclass(frozen=True)
class ToldMasks:
    """What makes the masks of rows that leave it open.

    Attributes:
        source: A mask source, ``NAME`` or ``FILE.py:Class``.
        options: Plug-in name to its options, as of :func:`surgbench.suite.suites.parse_sets`.
    """

    source: str
    options: dict[str, dict[str, Any]] = field(default_factory=dict)


def load_table(reference: str, masks: ToldMasks | None = None) -> Definition:
    """A table by name (``surgbench list tables``) or from a YAML file.

    Args:
        reference: Which.
        masks: For rows with ``masks: told``, which are left out where nothing is.

    Raises:
        NotFoundError: No such table, or a row of it names a plug-in or published row that is not there.
        ConfigError: An unknown key or a wrong value; one line.
    """
    path = locate("tables", "table", reference)
    content = {"task": default_task().name, **read_yaml(path, "table")}
    try:
        task = find_task(str(content["task"]))
    except NotFoundError as error:
        raise NotFoundError(f"{path}: {error}") from None
    table = parse_model(table_model(task.row), _with_told(_with_defaults(content), masks, path), str(path))
    published = None if table.published is None else load_published(table.published)
    for block, row in table.rows():
        try:
            _check_row(block, row, published)
        except (ConfigError, NotFoundError) as error:
            raise type(error)(f"{path}: row '{row.id}': {error}") from None
    return Definition(path.stem, table, published, hashlib.sha256(path.read_bytes()).hexdigest())


def _with_defaults(content: dict[str, Any]) -> dict[str, Any]:
    """The file's content with each block's ``defaults`` under its rows, as far as it has the form of a table."""

    def of_block(block: Any) -> Any:
        defaults, rows = (block.get(key) if isinstance(block, dict) else None for key in ("defaults", "rows"))
        if not isinstance(defaults, dict) or not isinstance(rows, list):
            return block
        return {**block, "rows": [{**defaults, **row} if isinstance(row, dict) else row for row in rows]}

    blocks = content.get("blocks")
    return {**content, "blocks": [of_block(block) for block in blocks]} if isinstance(blocks, list) else content


def _with_told(content: dict[str, Any], masks: ToldMasks | None, path: Path) -> dict[str, Any]:
    """The file's content with the told mask source in rows that leave it open, and without these if there is none."""
    found = 0
    if masks is not None:
        _check_told(masks)

    def of_row(row: Any) -> list[Any]:
        nonlocal found
        if not isinstance(row, dict) or row.get("masks") != TOLD:
            return [row]
        found += 1
        if masks is None:
            return []
        name = find("mask_source", masks.source).name
        return [
            {
                **row,
                "row_id": f"{row.get('row_id')}-{name}",
                "label": f"{row.get('label')}, masks by {name}",
                "masks": masks.source,
                "options": {**(row.get("options") or {}), **masks.options},
            }
        ]

    def of_block(block: Any) -> Any:
        rows = block.get("rows") if isinstance(block, dict) else None
        return {**block, "rows": [new for row in rows for new in of_row(row)]} if isinstance(rows, list) else block

    blocks = content.get("blocks")
    if not isinstance(blocks, list):
        return content
    told = {**content, "blocks": [of_block(block) for block in blocks]}
    if masks is not None and not found:
        raise ConfigError(f"{path}: no row of this table leaves its masks open; --masks is for those of recordings")
    return told


def _check_told(masks: ToldMasks) -> None:
    if masks.source in ("auto", "union", "instances"):
        raise ConfigError(
            f"--masks {masks.source}: is no mask source, which makes masks of images (surgbench list masks)"
        )
    source = find("mask_source", masks.source)
    if not getattr(source.cls, "reads_images", False):
        raise ConfigError(f"--masks {source.name}: makes no masks of images; see others: surgbench list masks")
    for name in masks.options:
        if name != source.name:
            raise ConfigError(f"--set {name}.…: is not the mask source; options here are of '{source.name}' alone")


def _check_row(block: Block, row: TableRow, published: Published | None) -> None:
    """See now what would otherwise be noticed after datasets are made and rows are run."""
    if row.published is not None and row.beside is not None:
        raise ConfigError("stands for a published row ('published') or beside one ('beside'), not both")
    name = row.published or row.beside
    if name is not None:
        if published is None:
            raise ConfigError("names a published row, but the table names no published figures")
        if name not in published.rows:
            raise NotFoundError(unknown_name("published row", name, published.rows))
        if block.published_on not in published.rows[name].data:
            raise NotFoundError(
                unknown_name("dataset", str(block.published_on), published.rows[name].data)
                + f" of the published row '{name}'"
            )
    for kind in KINDS:
        reference = getattr(row, kind, None)  # a row names a plug-in of a kind in the field of that name
        if reference is not None:
            found = find(kind, reference)
            for quick in (False, True):
                configure(found, row.asked(quick).options.get(found.name, {}))
