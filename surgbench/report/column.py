"""A column that tables are read by."""

from __future__ import annotations

from dataclasses import dataclass

from surgbench.report.row import Row

NO_VALUE = "–"


@dataclass(frozen=True)
class Column:
    """One column for reading.

    Attributes:
        key: Key of the row.
        short: Heading in the terminal, with the unit on a line of its own.
        long: Heading in Markdown.
        decimals: ``None`` for text and counts.
        scale: Multiplies the value (1000 turns metres into millimetres).
        best: The smallest value of a sound row is marked.
        from_width: Terminals narrower than this go without it; Markdown shows all.
    """

    key: str
    short: str
    long: str
    decimals: int | None = None
    scale: float = 1.0
    best: bool = False
    from_width: int = 0

    def text(self, row: Row) -> str:
        """The value as shown."""
        value = row[self.key]
        if value is None:
            return NO_VALUE
        if self.decimals is None:
            return str(value)
        shown = value * self.scale
        if self.decimals == 0 and 0 < shown < 1:  # little is not nothing
            return f"{shown:.1g}"
        return f"{shown:.{self.decimals}f}"


ROW = Column("row_id", "row", "row")
VARIANT = Column("variant", "variant", "variant", from_width=120)
STATUS = Column("status", "status", "status")
