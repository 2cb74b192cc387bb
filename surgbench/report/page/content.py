"""What stands on the page, as its template shows it. Texts are as they are: the template escapes them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

# Whoever writes a longer text than this into a record does not want it read.
LONGEST_TEXT = 2000


def clipped(text: str, most: int = LONGEST_TEXT) -> str:
    """A text, cut off where it is too long to be read."""
    return text if len(text) <= most else f"{text[:most]}… ({len(text)} characters)"


@dataclass(frozen=True)
class Head:
    """A column's heading.

    Attributes:
        name: What it is called.
        unit: Empty for none.
        main: Whether it is one of those that Markdown shows; the others are there when all are asked for.
        is_text: It stands on the left, and is sorted as text.
    """

    name: str
    unit: str = ""
    main: bool = True
    is_text: bool = False


@dataclass(frozen=True)
class Cell:
    """A value.

    Attributes:
        text: As shown.
        number: What it is sorted by; ``None`` for texts and missing values.
        place: 1 of the best of a column, 2 of the second.
    """

    text: str
    number: float | None = None
    place: int | None = None


@dataclass(frozen=True)
class Line:
    """A row of a table.

    Attributes:
        anchor: What links to it name.
        name: The row's.
        cells: One for each heading but the first, which is the name's.
        status: ``ok``, ``failed``, … or ``quoted``.
        reason: Why it is not sound.
        badges: What else is to be known of it at once.
        about: Anchor of what is said of where it is from.
    """

    anchor: str
    name: str
    cells: tuple[Cell, ...]
    status: str = "ok"
    reason: str | None = None
    badges: tuple[str, ...] = ()
    about: str | None = None


@dataclass(frozen=True)
class Board:
    """A table.

    Attributes:
        anchor: What links to it name.
        title: What stands over it.
        heads: The first is that of the rows' names.
        lines: In the order of their ranks.
        note: What is to be known of all of it.
    """

    anchor: str
    title: str
    heads: tuple[Head, ...]
    lines: tuple[Line, ...]
    note: str = ""


@dataclass(frozen=True)
class Moment:
    """A frame of a run that stands out.

    Attributes:
        anchor: What links to it name.
        kind: ``best``, ``median`` or ``worst``.
        place: Position in the run's list of frames.
        frame: Number of the frame.
        value: The error, with its name and unit.
        still: A picture as a ``data:`` URI; ``None`` where it was not drawn.
        size: Its width and height.
        clip: A film of the time around it, likewise.
    """

    anchor: str
    kind: str
    place: int
    frame: int
    value: str
    still: str | None = None
    size: tuple[int, int] = (0, 0)
    clip: str | None = None


@dataclass(frozen=True)
class Filmstrip:
    """The moments of one run.

    Attributes:
        row: Name of its row.
        unit: What it ran on.
        legend: What the pictures show.
        moments: Best, median, worst.
    """

    row: str
    unit: str
    legend: str
    moments: tuple[Moment, ...]


@dataclass(frozen=True)
class Gallery:
    """The pictures of one table's rows."""

    title: str
    strips: tuple[Filmstrip, ...]


@dataclass(frozen=True)
class Origin:
    """Where a row is from.

    Attributes:
        anchor: What links to it name.
        name: The row's.
        title: Its table's.
        row: Anchor of the row.
        parts: Heading to facts, each a name and what it is.
    """

    anchor: str
    name: str
    title: str
    row: str
    parts: Mapping[str, Sequence[tuple[str, str]]]


@dataclass(frozen=True)
class Page:
    """All of it.

    Attributes:
        title: Of the page.
        summary: What it is about, one line.
        boards: The leaderboard.
        quoted: Published figures.
        further: Other tables, with nothing to rank or to filter: statistics go here.
        data: What the page's script draws, as JSON has it.
        galleries: Pictures.
        notes: What is to be known of the pictures: why there are none, or not all.
        origins: Where every row is from.
        statuses: That rows have.
    """

    title: str
    summary: str
    boards: tuple[Board, ...]
    quoted: tuple[Board, ...] = ()
    further: tuple[Board, ...] = ()
    data: Mapping[str, Any] = field(default_factory=dict)
    galleries: tuple[Gallery, ...] = ()
    notes: tuple[str, ...] = ()
    origins: tuple[Origin, ...] = ()

    @property
    def statuses(self) -> tuple[str, ...]:
        """That rows have, in the order in which they are met."""
        return tuple(dict.fromkeys(line.status for board in (*self.boards, *self.quoted) for line in board.lines))
