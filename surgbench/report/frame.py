"""Rows as a DataFrame with declared types, and both as text without loss.

What is written, printed as CSV or JSON, read back, or given to a notebook goes through here. pandas takes long to load,
so that this module does it where it is used.
"""

from __future__ import annotations

import io
import json
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from surgbench.report.field import Field, FieldType, keys

if TYPE_CHECKING:
    from pandas import DataFrame

# How a formula begins, and a text with an apostrophe already (https://owasp.org/www-community/attacks/CSV_Injection).
_FORMULA = re.compile(r"'*[=+\-@\t\r]")
DTYPES: Mapping[FieldType, str] = {"text": "string", "count": "Int64", "number": "float64", "flag": "boolean"}


def to_frame(rows: Iterable[Mapping[str, Any]], fields: Sequence[Field]) -> DataFrame:
    """Rows as a DataFrame.

    Args:
        rows: Key to value, ``None`` for a missing one; further keys are left out.
        fields: The columns, in order.

    Returns:
        A line a row; text as ``string``, counts as ``Int64``, numbers as ``float64``, flags as ``boolean``. A missing
        value is ``NA``, of a number ``NaN``.

    Example:
        >>> from surgbench.report.field import count, number, text
        >>> from surgbench.report.frame import csv_text, to_frame
        >>> rows = [{"row_id": "a", "frames": 3, "error_m": 0.1 + 0.2}, {"row_id": "b", "frames": None}]
        >>> print(csv_text(to_frame(rows, (*text("row_id"), *count("frames"), *number("error_m")))), end="")
        row_id,frames,error_m
        a,3,0.30000000000000004
        b,,
    """
    import pandas as pd

    rows = list(rows)
    columns = {}
    for field in fields:
        values = [row.get(field.key) for row in rows]
        if field.type == "text":
            values = [None if value is None else str(value) for value in values]
        columns[field.key] = pd.Series(values, dtype=DTYPES[field.type])
    return pd.DataFrame(columns)


def to_rows(frame: DataFrame) -> list[dict[str, Any]]:
    """The lines of a DataFrame as Python's own values, ``None`` for missing ones."""
    columns = [
        [None if missing else value for value, missing in zip(column.tolist(), column.isna(), strict=True)]
        for _, column in frame.items()
    ]
    return [dict(zip(map(str, frame.columns), values, strict=True)) for values in zip(*columns, strict=True)]


def csv_text(frame: DataFrame) -> str:
    """CSV with every digit; empty cells for missing values.

    A text that a spreadsheet would take for a formula gets an apostrophe before it, which :func:`read_csv` takes off.
    """
    quoted = frame.copy()
    for name, column in frame.items():
        if column.dtype == "string":
            quoted[name] = column.map(_quoted, na_action="ignore")
    return str(quoted.to_csv(index=False, lineterminator="\n"))


def _quoted(text: str) -> str:
    return f"'{text}" if _FORMULA.match(text) else text


def _unquoted(text: str) -> str:
    return text[1:] if text.startswith("'") and _FORMULA.match(text) else text


def json_text(frame: DataFrame) -> str:
    """A JSON list of rows with every digit; null for missing values."""
    return json_list(to_rows(frame))


def json_list(rows: Sequence[Mapping[str, Any]]) -> str:
    """Rows that need not have the same keys, likewise."""
    return json.dumps(rows, indent=2, allow_nan=False, ensure_ascii=False) + "\n"


def read_csv(text: str, fields: Sequence[Field]) -> DataFrame:
    """What :func:`csv_text` made, value for value.

    Args:
        text: The whole file.
        fields: The columns that it has to have, in order.

    Raises:
        ValueError: It has others, or a value is not of its column's type.
    """
    import pandas as pd

    if not text.endswith("\n"):
        raise ValueError("truncated")
    # Cells as they stand: pandas' own ways to read numbers are not exact in all its versions.
    cells = pd.read_csv(io.StringIO(text), dtype=str, na_filter=False, lineterminator="\n")
    if tuple(cells.columns) != keys(fields):
        raise ValueError("other columns than this version of surgbench writes")
    if not isinstance(cells.index, pd.RangeIndex):
        raise ValueError("a line has more cells than there are columns")
    columns = [[_value(cell, field) for cell in cells[field.key].tolist()] for field in fields]
    return to_frame((dict(zip(keys(fields), values, strict=True)) for values in zip(*columns, strict=True)), fields)


def _value(cell: str, field: Field) -> Any:
    if cell == "":
        return None
    try:
        return _PARSE[field.type](cell)
    except (ValueError, KeyError):
        raise ValueError(f"'{field.key}': '{cell}' is not a {field.type}") from None


_PARSE: Mapping[FieldType, Callable[[str], Any]] = {
    "text": _unquoted,
    "count": int,
    "number": float,
    "flag": {"True": True, "False": False}.__getitem__,
}
