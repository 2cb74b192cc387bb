"""A column that tables are read by, in the terminal and on pages."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

NO_VALUE = "–"


@dataclass(frozen=True)
class Column:
    """One column for reading: how a value of a row is shown, and what stands over it.

    Attributes:
        key: Key of the row.
        name: What it is called.
        unit: As shown; empty for none.
        decimals: ``None`` for text and counts.
        scale: Multiplies the value (1000 turns metres into millimetres).
        short: Heading in the terminal's leaderboard, with the unit on a line of its own.
        best: The smallest value of a sound row is marked.
        unless_zero: Shown only where a row has something else than 0.
    """

    key: str
    name: str
    unit: str = ""
    decimals: int | None = None
    scale: float = 1.0
    short: str = ""
    best: bool = False
    unless_zero: bool = False

    @property
    def heading(self) -> str:
        """Name and unit."""
        return f"{self.name} [{self.unit}]" if self.unit else self.name

    def text(self, value: Any) -> str:
        """A value as shown; a dash for ``None``."""
        if value is None:
            return NO_VALUE
        if self.decimals is None:
            return str(value)
        shown = value * self.scale
        if self.decimals == 0 and 0 < shown < 1:  # little is not nothing
            return f"{shown:.1g}"
        return f"{shown:.{self.decimals}f}"

    def cell(self, row: Mapping[str, Any]) -> str:
        """What a row has of it, as shown."""
        return self.text(row.get(self.key))

    def with_spread(self, value: float | None, spread: float | None) -> str:
        """A value and, where there is one, what it may be off by or spreads by."""
        if value is None or spread is None:
            return self.text(value)
        return f"{self.text(value)} ± {self.text(spread)}"


@dataclass(frozen=True)
class Interval(Column):
    """Where a mean lies: its key is that of the lower end.

    Attributes:
        upper: Key of the other end.
    """

    upper: str = ""

    def cell(self, row: Mapping[str, Any]) -> str:
        """Both ends."""
        low, high = row.get(self.key), row.get(self.upper)
        return NO_VALUE if low is None or high is None else f"{self.text(low)}–{self.text(high)}"


ROW = Column("row_id", "row", short="row")
VARIANT = Column("variant", "variant", short="variant")
# Of a frame or step, the median: all that a user waits for, and called the same wherever it is shown.
LATENCY = Column("latency_ms", "latency", "ms", 1, short="latency\nms", best=True)
STATUS = Column("status", "status", short="status")
