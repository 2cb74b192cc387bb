"""Tables in the terminal: what is too wide stands in bands below each other, each with the row's name, and uncut."""

from __future__ import annotations

import io
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

TABLE_WIDTH = 100
# Names are folded over lines, but into no less than this.
NAME_MIN_WIDTH = 8
# Blanks at both ends of a line.
_EDGES = 2


@dataclass(frozen=True)
class Head:
    """What stands over a column.

    Attributes:
        text: In one line or more.
        is_text: Its cells are text: they stand on the left, and may be folded.
    """

    text: str
    is_text: bool = False


def print_folded(
    title: str,
    heads: Sequence[Head],
    lines: Sequence[Sequence[Text | str]],
    console: Console,
    kept: int = 1,
    styles: Sequence[str | None] | None = None,
) -> None:
    """Print a table, in one piece where the console is wide enough.

    Args:
        title: Over it.
        heads: Of its columns.
        lines: As many cells each.
        console: Where to.
        kept: The first so many columns name a line, and stand in every band.
        styles: Of each line; plain unless told.
    """
    from rich.text import Text

    cells = [[cell if isinstance(cell, Text) else Text(cell) for cell in line] for line in lines]
    natural = [
        max(_width(text) for text in (head.text, *(line[place].plain for line in cells)))
        for place, head in enumerate(heads)
    ]
    for number, (columns, widths) in enumerate(bands(natural, [head.is_text for head in heads], console.width, kept)):
        sheet = _sheet(console, Text(title) if number == 0 else None)
        for column, width in zip(columns, widths, strict=True):
            head = heads[column]
            sheet.add_column(Text(head.text), justify="left" if head.is_text else "right", width=width, overflow="fold")
        for line, style in zip(cells, styles or [None] * len(cells), strict=True):
            sheet.add_row(*(line[column] for column in columns), style=style)
        console.print(sheet)


def bands(
    natural: Sequence[int], is_text: Sequence[bool], width: int, kept: int = 1
) -> list[tuple[list[int], list[int]]]:
    """Which columns stand beside each other, and how wide they are.

    Args:
        natural: Width of each column whose cells are not folded.
        is_text: Whether it may be narrower.
        width: Characters of a line.
        kept: How many columns stand in every band.

    Returns:
        Of each band its columns and their widths; every column is in one of them, a kept one in all.

    Example:
        >>> from surgbench.report.fold import bands
        >>> bands([10, 6, 6, 6], [True, False, False, False], 80)
        [([0, 1, 2, 3], [10, 6, 6, 6])]
        >>> bands([10, 6, 6, 6], [True, False, False, False], 30)
        [([0, 1, 2], [10, 6, 6]), ([0, 3], [10, 6])]
    """
    room = max(1, width - _EDGES)
    if sum(natural) + len(natural) - 1 <= room:
        return [(list(range(len(natural))), list(natural))]
    names = _narrowed(natural[:kept], room * 2 // 5 if kept == 1 else room // 2)
    left = max(1, room - sum(names) - kept)
    found: list[tuple[list[int], list[int]]] = []
    free = 0
    for column in range(kept, len(natural)):
        # A long text leaves room for others beside it.
        wanted = min(natural[column], left, max(NAME_MIN_WIDTH, room // 3) if is_text[column] else left)
        if not found or wanted > free:
            found.append((list(range(kept)), list(names)))
            free = left
        found[-1][0].append(column)
        found[-1][1].append(wanted)
        free -= wanted + 1
    for columns, widths in found:
        spare = room - sum(widths) - len(widths) + 1
        for place, column in enumerate(columns[kept:], start=kept):
            if is_text[column] and spare > 0:  # what is left over is theirs
                wider = min(natural[column], widths[place] + spare)
                spare, widths[place] = spare - wider + widths[place], wider
    return found or [(list(range(kept)), names)]


def terminal() -> Console:
    """Standard output, as wide as it is; Rich itself takes any that is called dumb to have 80 columns."""
    from rich.console import Console

    size = shutil.get_terminal_size((80, 25))  # of what is no terminal
    return Console(width=size.columns, height=size.lines)


def plain(print_on: Callable[[Console], None], width: int = TABLE_WIDTH) -> str:
    """What is printed, as plain text in lines of at most ``width`` characters."""
    from rich.console import Console

    out = io.StringIO()
    print_on(Console(file=out, width=width, color_system=None))
    return "\n".join(line.rstrip() for line in out.getvalue().splitlines()) + "\n"


def _narrowed(natural: Sequence[int], room: int) -> list[int]:
    """Widths of names that have so much room together: the widest ones give way."""
    widths = list(natural)
    while sum(widths) + len(widths) - 1 > room and max(widths) > NAME_MIN_WIDTH:
        widths[widths.index(max(widths))] -= 1
    return widths


def _sheet(console: Console, title: Text | None) -> Table:
    from rich import box
    from rich.table import Table

    # Rich's own substitute for terminals without line drawing has a frame, which takes room that is not there.
    lines = box.Box("    \n    \n -- \n    \n    \n    \n    \n    \n", ascii=True)
    style = lines if console.options.ascii_only else box.SIMPLE_HEAD
    return Table(title=title, title_justify="left", box=style, padding=0, pad_edge=False)


def _width(text: str) -> int:
    from rich.cells import cell_len

    return max(map(cell_len, text.split("\n")), default=0)
