"""Table files, read and checked."""

from __future__ import annotations

import hashlib
from typing import Any

from surgbench.config import locate, parse_model, read_yaml
from surgbench.errors import ConfigError, NotFoundError, unknown_name
from surgbench.kinds import KINDS
from surgbench.registry import configure, find
from surgbench.reproduce.published import Published, load_published
from surgbench.reproduce.table import Block, Definition, TableRow, table_model
from surgbench.task import default_task, find_task


def load_table(reference: str) -> Definition:
    """A table by name (``surgbench list tables``) or from a YAML file.

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
    table = parse_model(table_model(task.row), _with_defaults(content), str(path))
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
