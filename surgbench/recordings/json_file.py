"""JSON as other programs write it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from surgbench.errors import DatasetError
from surgbench.syntax import parse_json


def read_json(path: Path) -> Any:
    """What a JSON file holds; a byte order mark is passed over.

    Raises:
        DatasetError: It cannot be read, or is not JSON; one line.
    """
    try:
        return parse_json(path.read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise DatasetError(f"{path}: cannot be read ({error.strerror})") from None
    except ValueError as error:
        raise DatasetError(f"{path}: not valid JSON ({error})") from None
