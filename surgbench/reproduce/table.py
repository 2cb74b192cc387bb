"""What a table consists of: blocks of rows on datasets, read from one YAML file."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar

from pydantic import Discriminator, Field, Tag, create_model, model_validator

from surgbench.config import Count, Section
from surgbench.generation import settings_suffix
from surgbench.kinds import NAME_PATTERN
from surgbench.reproduce.published import Published
from surgbench.suite.asked import Conditions, RowRequest


class DatasetRequest(Section):
    """A generated dataset: a preset, and what is put over it.

    Attributes:
        preset: Name or file.
        sequences: Pairs of trajectories.
        frames: Per sequence.
        seed: Of the data.
        corruption: Level of the masks' corruption.
        set: Keys of the preset and their values, as ``{occluders.tissue: 0.4}``.
    """

    preset: str
    sequences: Count | None = None
    frames: Count | None = None
    seed: Annotated[int, Field(ge=0)] | None = None
    corruption: str | None = None
    set: dict[str, Any] = Field(default={})

    @property
    def folder(self) -> str:
        """Name of its folder: the preset's, and whatever is put over it."""
        over = self.model_dump(exclude={"preset", "set"}, exclude_none=True)
        name = "-".join([Path(self.preset).stem, *(f"{key}-{value}" for key, value in over.items())])
        return f"{name}{settings_suffix(self.set)}"


class ImportRequest(Section):
    """A dataset made of recordings that whoever reproduces the table has on a disk.

    Attributes:
        importer: What reads them; where they lie is told on the command line.
        name: Of its folder.
        options: The importer's.
    """

    importer: str
    name: Annotated[str, Field(pattern=f"^{NAME_PATTERN}$")]
    options: dict[str, Any] = Field(default={})

    @property
    def folder(self) -> str:
        """Name of its folder."""
        return self.name


def _origin(content: Any) -> str:
    keys = content if isinstance(content, dict) else type(content).model_fields
    return "imported" if "importer" in keys else "generated"


AnyDataset = Annotated[
    Annotated[DatasetRequest, Tag("generated")] | Annotated[ImportRequest, Tag("imported")], Discriminator(_origin)
]


class Timing(Section):
    """What latencies are measured on, one run at a time, whatever the number of jobs was."""

    runs: Count
    frames: Count


class TableRow(RowRequest):
    """A row of a suite with its place in a table. It needs a ``row_id``.

    Attributes:
        label: What it is called in the table.
        published: The row among the published figures that it stands for.
        beside: One that it is shown beside, which is another method's or another protocol's.
        floor: Row id of the floor it is held against: of one that knows what no other can.
        against: Row id that it may better: the same without what it is to show the worth of, or another method. On a
            dataset of another block that must be of the same motion.
        timing: What its latencies are measured on, where that differs from the table's: for what is very slow.
        quick_options: Options put over ``options`` in a quick run, for what is slow however few the frames are.
    """

    label: str
    published: str | None = None
    beside: str | None = None
    floor: str | None = None
    against: str | None = None
    timing: Timing | None = None
    quick_options: dict[str, dict[str, Any]] = Field(default={})

    row: ClassVar[type[RowRequest]] = RowRequest  # of the table's task: see table_model

    @property
    def id(self) -> str:
        """The row id."""
        return str(self.row_id)

    def asked(self, quick: bool) -> RowRequest:
        """The row as a suite would ask for it."""
        content = self.model_dump(include=set(self.row.model_fields))
        if quick:
            names = {*self.options, *self.quick_options}
            content["options"] = {k: {**self.options.get(k, {}), **self.quick_options.get(k, {})} for k in names}
        return self.row.model_validate(content)


class Block(Section):
    """Rows that share a dataset and conditions.

    Attributes:
        name: A word.
        heading: As it stands over the block.
        note: The protocol in words.
        dataset: What to generate or import.
        quick_sequences: Ids of the dataset's sequences that a quick run makes: the first unless told.
        conditions: What all rows share.
        defaults: What its rows ask for where they do not say.
        published_on: Which of the published rows' datasets the block stands for.
        levels: What makes its dataset hard, and at which level: where the block stands on curves over levels.
        rows: In the order they are shown.
    """

    name: Annotated[str, Field(pattern=f"^{NAME_PATTERN}$")]
    heading: str
    note: str = ""
    dataset: AnyDataset
    quick_sequences: Annotated[tuple[str, ...], Field(min_length=1)] = ("000",)
    conditions: Conditions = Conditions()
    defaults: dict[str, Any] = Field(default={})
    published_on: str | None = None
    levels: dict[str, Annotated[float, Field(ge=0)]] = Field(default={})
    rows: Annotated[tuple[TableRow, ...], Field(min_length=1)]


class Share(Section):
    """What a quick run does.

    Attributes:
        runs: Arms or pairs a row is run on, spread over the block's ``quick_sequences``.
        frames: Of each, the first so many.
    """

    runs: Count
    frames: Count


class Check(Section):
    """How much a check repeats.

    Attributes:
        runs: How many rows, on one arm or pair each.
        frames: The first so many. Their hashes are kept with the table.
    """

    runs: Count
    frames: Count


class Picture(Section):
    """The figure: ground truth and some rows' estimates over time.

    Attributes:
        block: Its block.
        unit: The arm, or its pair, that is shown.
        rows: RowRequest ids.
    """

    block: str
    unit: str
    rows: Annotated[tuple[str, ...], Field(min_length=1, max_length=5)]


class Worst(Section):
    """The sheet of worst moments.

    Attributes:
        block: Its block.
        rows: Row ids, a line each.
        moments: Of each row.
    """

    block: str
    rows: Annotated[tuple[str, ...], Field(min_length=1, max_length=6)]
    moments: Annotated[int, Field(ge=1, le=8)] = 4


class Table(Section):
    """A table file.

    Attributes:
        title: Heading.
        task: What its trackers do.
        note: What holds for all blocks.
        published: Name of the file with the published figures, where there are any.
        quick: Fixed small share.
        timing: Where latencies come from.
        check: How much ``--check`` repeats.
        figure: Estimates over time, if they are drawn.
        worst: Worst moments, if they are drawn.
        over_sequences: Columns of which rows have the standard deviation over sequences too (``_std_sequences``);
            ``frames_per_second`` is there with it alone.
        blocks: The parts, in order.
    """

    title: str
    task: str
    note: str = ""
    published: str | None = None
    quick: Share = Share(runs=1, frames=40)
    timing: Timing = Timing(runs=1, frames=100)
    check: Check = Check(runs=16, frames=100)
    figure: Picture | None = None
    worst: Worst | None = None
    over_sequences: tuple[str, ...] = ()
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
        for key, wanted in (("figure", self.figure), ("worst", self.worst)):
            for id_ in () if wanted is None else wanted.rows:
                if wanted and id_ not in [row.id for block, row in self.rows() if block.name == wanted.block]:
                    raise ValueError(f"{key}: block '{wanted.block}' has no row '{id_}'")
        return self

    @property
    def has_pictures(self) -> bool:
        """Whether anything is drawn for it."""
        return self.figure is not None or self.worst is not None or any(block.levels for block in self.blocks)

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


def table_model(row: type[RowRequest]) -> type[Table]:
    """The model of a table whose rows are of one task.

    Args:
        row: What a row of that task may ask for.
    """
    own: Any = create_model("TableRow", __base__=(TableRow, row))
    own.row = row
    rows: Any = (Annotated[tuple[own, ...], Field(min_length=1)], ...)
    block: Any = create_model("Block", __base__=Block, rows=rows)
    blocks: Any = (Annotated[tuple[block, ...], Field(min_length=1)], ...)
    return create_model("Table", __base__=Table, blocks=blocks)
