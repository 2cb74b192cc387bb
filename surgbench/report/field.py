"""What a table of records holds: its columns' names and types, declared once for writing and reading alike."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

FieldType = Literal["text", "count", "number", "flag"]


@dataclass(frozen=True)
class Field:
    """A column of a file or of a DataFrame.

    Attributes:
        key: Its name, and the key of a row.
        type: ``text``; ``count``, a whole number; ``number``; ``flag``, yes or no. A value of any may be missing.
    """

    key: str
    type: FieldType


def text(*keys: str) -> tuple[Field, ...]:
    """Fields that hold text."""
    return tuple(Field(key, "text") for key in keys)


def count(*keys: str) -> tuple[Field, ...]:
    """Fields that hold whole numbers."""
    return tuple(Field(key, "count") for key in keys)


def number(*keys: str) -> tuple[Field, ...]:
    """Fields that hold numbers."""
    return tuple(Field(key, "number") for key in keys)


def flag(*keys: str) -> tuple[Field, ...]:
    """Fields that hold yes or no."""
    return tuple(Field(key, "flag") for key in keys)


def filled(fields: Iterable[Field], rows: Iterable[Mapping[str, Any]]) -> tuple[Field, ...]:
    """Those that a row has a value of."""
    present = {key for row in rows for key, value in row.items() if value is not None}
    return tuple(field for field in fields if field.key in present)


def keys(fields: Iterable[Field]) -> tuple[str, ...]:
    """Their names."""
    return tuple(field.key for field in fields)
