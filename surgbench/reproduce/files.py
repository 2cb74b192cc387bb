"""A table's files, written and read back."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from surgbench.errors import DatasetError
from surgbench.files import canonical_json
from surgbench.report.field import Field
from surgbench.report.frame import read_csv, to_rows
from surgbench.report.row import Row
from surgbench.reproduce.results import Results
from surgbench.task import default_task, find_task

FORMAT = "surgbench-reproduction-1"
LEADERBOARD_CSV, LEADERBOARD_MD = "leaderboard.csv", "leaderboard.md"
SEQUENCES_CSV, RECORDS_JSON = "sequences.csv", "records.json"


def json_text(about: dict[str, Any]) -> str:
    """``records.json``: a line for each record, so that two can be compared with ``diff``."""
    rest = {key: value for key, value in about.items() if key != "records"}
    head_text = json.dumps(rest, indent=1, sort_keys=True, allow_nan=False)
    lines = ",\n".join(f"  {json.dumps(key)}: {canonical_json(value)}" for key, value in about["records"].items())
    return f'{head_text[:-2]},\n "records": {{\n{lines}\n }}\n}}\n'


def _read(path: Path, fields: Callable[[Iterable[Row]], tuple[Field, ...]]) -> list[Row]:
    content = path.read_text(encoding="utf-8")
    header = content.partition("\n")[0].split(",")
    return to_rows(read_csv(content, fields([dict.fromkeys(header, True)])))


def read_results(folder: Path) -> Results:
    """Results as they were written.

    Raises:
        DatasetError: A file is missing or is not what it should be; one line.
    """
    path = folder / RECORDS_JSON
    try:
        about = json.loads(path.read_text(encoding="utf-8"))
        if about["format"] != FORMAT or not isinstance(about["records"], dict):
            raise ValueError(f"not of the format {FORMAT}")
        path = folder / LEADERBOARD_CSV
        sheet = find_task(about.get("task", default_task().name)).sheet
        rows = _read(path, sheet.leaderboard)
        path = folder / SEQUENCES_CSV
        return Results(rows, _read(path, sheet.sequences), about)
    except FileNotFoundError:
        raise DatasetError(f"{path}: missing; a reproduced table is a folder with this file") from None
    except OSError as error:
        raise DatasetError(f"{path}: cannot be read ({error.strerror})") from None
    except (ValueError, KeyError, TypeError) as error:
        raise DatasetError(f"{path}: damaged ({' '.join(str(error).split())})") from None
