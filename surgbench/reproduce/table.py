"""What a table consists of: blocks of rows on datasets, read from one YAML file."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from surgbench.config import locate, parse_model, read_yaml
from surgbench.errors import ConfigError, NotFoundError, unknown_name
from surgbench.registry import NAME_PATTERN, Kind, configure, find
from surgbench.reproduce.published import Published, load_published
from surgbench.suite.plan import Protocol, Row

Count = Annotated[int, Field(ge=1)]


class _Part(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class DatasetRequest(_Part):
    """A generated dataset: a preset, and what is put over it.

    Attributes:
        preset: Name or file.
        sequences: Pairs of trajectories.
        frames: Per sequence.
        seed: Of the data.
        corruption: Level of the masks' corruption.
    """

    preset: str
    sequences: Count | None = None
    frames: Count | None = None
    seed: Annotated[int, Field(ge=0)] | None = None
    corruption: str | None = None

    @property
    def folder(self) -> str:
        """Name of its folder: the preset's, and whatever is put over it."""
        over = self.model_dump(exclude={"preset"}, exclude_none=True)
        return "-".join([Path(self.preset).stem, *(f"{key}-{value}" for key, value in over.items())])


class Timing(_Part):
    """What latencies are measured on, one run at a time, whatever the number of jobs was."""

    runs: Count
    frames: Count


class TableRow(Row):
    """A row of a suite with its place in a table. It needs a ``row_id``.

    Attributes:
        label: What it is called in the table.
        published: Its row among the published figures.
        floor: Row id of the floor it is held against.
        against: Row id that it may better: the same without what it is to show the worth of. On a dataset of another
            block that must be of the same motion.
        timing: What its latencies are measured on, where that differs from the table's: for what is very slow.
        quick_options: Options put over ``options`` in a quick run, for what is slow however few the frames are.
    """

    label: str
    published: str | None = None
    floor: str | None = None
    against: str | None = None
    timing: Timing | None = None
    quick_options: dict[str, dict[str, Any]] = Field(default={})

    @property
    def id(self) -> str:
        """The row id."""
        return str(self.row_id)

    def asked(self, quick: bool) -> Row:
        """The row as a suite would ask for it."""
        content = self.model_dump(include=set(Row.model_fields))
        if quick:
            names = {*self.options, *self.quick_options}
            content["options"] = {k: {**self.options.get(k, {}), **self.quick_options.get(k, {})} for k in names}
        return Row.model_validate(content)


class Block(_Part):
    """Rows that share a dataset and a protocol.

    Attributes:
        name: A word.
        heading: As it stands over the block.
        note: The protocol in words.
        dataset: What to generate.
        quick_sequences: Ids of the dataset's sequences that a quick run makes.
        protocol: What all rows share.
        keypoints: Keypoint source of the rows that name none; unless told as in a suite.
        published_on: Which of the published rows' datasets the block stands for.
        rows: In the order they are shown.
    """

    name: Annotated[str, Field(pattern=f"^{NAME_PATTERN}$")]
    heading: str
    note: str = ""
    dataset: DatasetRequest
    quick_sequences: Annotated[tuple[str, ...], Field(min_length=1)]
    protocol: Protocol = Protocol()
    keypoints: str | None = None
    published_on: str | None = None
    rows: Annotated[tuple[TableRow, ...], Field(min_length=1)]

    @model_validator(mode="after")
    def _hand_on_keypoints(self) -> Block:
        if self.keypoints is not None:
            rows = (row if row.keypoints else row.model_copy(update={"keypoints": self.keypoints}) for row in self.rows)
            self.__dict__["rows"] = tuple(rows)
        return self


class Share(_Part):
    """What a quick run does.

    Attributes:
        runs: Arms or pairs a row is run on, spread over the block's ``quick_sequences``.
        frames: Of each, the first so many.
    """

    runs: Count
    frames: Count


class Check(_Part):
    """How much a check repeats.

    Attributes:
        runs: How many rows, on one arm or pair each.
        frames: The first so many. Their hashes are kept with the table.
    """

    runs: Count
    frames: Count


class Picture(_Part):
    """The figure: ground truth and some rows' estimates over time.

    Attributes:
        block: Its block.
        unit: The arm, or its pair, that is shown.
        rows: Row ids.
    """

    block: str
    unit: str
    rows: Annotated[tuple[str, ...], Field(min_length=1, max_length=5)]


class Table(_Part):
    """A table file.

    Attributes:
        title: Heading.
        task: What its trackers do.
        note: What holds for all blocks.
        published: Name of the file with the published figures, where there are any.
        quick: Fixed small share.
        timing: Where latencies come from.
        check: How much ``--check`` repeats.
        figure: What is drawn, if anything.
        blocks: The parts, in order.
    """

    title: str
    task: Literal["instrument", "viewpoint"] = "instrument"
    note: str = ""
    published: str | None = None
    quick: Share
    timing: Timing
    check: Check
    figure: Picture | None = None
    blocks: Annotated[tuple[Block, ...], Field(min_length=1)]

    @model_validator(mode="after")
    def _rows_are_told_apart(self) -> Table:
        ids = [row.row_id for _, row in self.rows()]
        for id_ in ids:
            if id_ is None:
                raise ValueError("every row needs a row_id")
            if ids.count(id_) > 1:
                raise ValueError(f"row_id '{id_}' is given twice")
        for _, row in self.rows():
            if row.floor is not None and row.floor not in ids:
                raise ValueError(f"row '{row.id}': there is no row '{row.floor}' to be its floor")
            if row.against is not None and row.against not in ids:
                raise ValueError(f"row '{row.id}': there is no row '{row.against}' to be held against")
        names = [block.name for block in self.blocks]
        if len(set(names)) < len(names):
            raise ValueError("two blocks have the same name")
        if self.figure is not None:
            for id_ in self.figure.rows:
                if id_ not in [row.id for block, row in self.rows() if block.name == self.figure.block]:
                    raise ValueError(f"figure: block '{self.figure.block}' has no row '{id_}'")
        return self

    def rows(self) -> Iterator[tuple[Block, TableRow]]:
        """Every row with its block, in order."""
        for block in self.blocks:
            for row in block.rows:
                yield block, row

    def block(self, name: str) -> Block:
        """The block of this name, which must be there."""
        return next(block for block in self.blocks if block.name == name)


@dataclass(frozen=True)
class Definition:
    """A table file, read.

    Attributes:
        name: Of the table: the file's, without its ending.
        table: Its content.
        published: The figures it names; ``None`` where it names none.
        sha256: Of the file.
    """

    name: str
    table: Table
    published: Published | None
    sha256: str


def load_table(reference: str) -> Definition:
    """A table by name (``surgbench list tables``) or from a YAML file.

    Raises:
        NotFoundError: No such table, or a row of it names a plug-in or published row that is not there.
        ConfigError: An unknown key or a wrong value; one line.
    """
    path = locate("tables", "table", reference)
    table = parse_model(Table, read_yaml(path, "table"), str(path))
    published = None if table.published is None else load_published(table.published)
    for block, row in table.rows():
        try:
            _check_row(block, row, published)
        except (ConfigError, NotFoundError) as error:
            raise type(error)(f"{path}: row '{row.id}': {error}") from None
    return Definition(path.stem, table, published, hashlib.sha256(path.read_bytes()).hexdigest())


def _check_row(block: Block, row: TableRow, published: Published | None) -> None:
    """See now what would otherwise be noticed after datasets are made and rows are run."""
    if row.published is not None:
        if published is None:
            raise ConfigError("names a published row, but the table names no published figures")
        if row.published not in published.rows:
            raise NotFoundError(unknown_name("published row", row.published, published.rows))
        if block.published_on not in published.rows[row.published].data:
            raise NotFoundError(
                unknown_name("dataset", str(block.published_on), published.rows[row.published].data)
                + f" of the published row '{row.published}'"
            )
    asked: dict[Kind, str | None] = {
        "tracker": row.tracker,
        "initialiser": row.initialiser,
        "filter": row.filter,
        "keypoints": row.keypoints,
    }
    for kind, reference in asked.items():
        if reference is not None:
            found = find(kind, reference)
            for quick in (False, True):
                configure(found, row.asked(quick).options.get(found.name, {}))
