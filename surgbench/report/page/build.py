"""The page as one text: its parts, its template, and a policy that lets nothing run but what is its own."""

from __future__ import annotations

import base64
import hashlib
import json
from collections.abc import Callable, Sequence
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any

from jinja2 import Environment, StrictUndefined

from surgbench.records.format import Record
from surgbench.report.encoders import browsers_play
from surgbench.report.page.boards import board, grouped
from surgbench.report.page.content import Page, clipped
from surgbench.report.page.curves import curves_of
from surgbench.report.page.drawn import drawn
from surgbench.report.page.moments import planned
from surgbench.report.page.origins import origins
from surgbench.report.page.pictures import FULL, NO_FILMS, Pictures, Progress
from surgbench.report.page.quoted import quoted_boards
from surgbench.report.page.statistics import statistics_boards
from surgbench.task import find_task
from surgbench.version import __version__

MOST_BYTES = 10_000_000  # of a page with pictures
PICTURED_ROWS = 3  # of each table, unless told
_ESCAPES = {ord(letter): f"\\u{ord(letter):04x}" for letter in "<>&\u2028\u2029"}


def build_page(
    records: Sequence[Record],
    progress: Progress,
    *,
    pictures: int = PICTURED_ROWS,
    dataset: Path | None = None,
    published: Sequence[str] = (),
    tell: Callable[[str], None] = lambda problem: None,
) -> bytes:
    """The report of some records as one HTML page, which needs no other file.

    Args:
        records: From :func:`surgbench.records.reader.read_records`; of one task or of several.
        progress: Takes a description and how much there is to do; a context manager that gives what takes the part just
            done.
        pictures: Rows of each table whose moments are drawn; 0 for none.
        dataset: Where the dataset of some of them is now, if not where the records say.
        published: Sources of published figures, which are quoted.
        tell: Takes one line for everything that there are no pictures of, and why.

    Raises:
        SurgbenchError: No such dataset or source; one line.
    """
    groups = grouped(records)
    curves = [curves_of(group) for group in groups]
    drawings = planned(curves, pictures)
    rows = [row for group in groups for row in group.rows]
    tasks = [find_task(name) for name in dict.fromkeys(row["task"] for row in rows)]
    parts: dict[str, Any] = {
        "title": f"surgbench: {_listed([row['dataset'] for row in rows])}",
        "summary": _summary(records, [task.name for task in tasks]),
        "boards": tuple(map(board, groups)),
        "quoted": tuple(quoted_boards(published, tasks)),
        "further": tuple(statistics_boards(records)),
        "data": drawn(curves, drawings),
        "origins": tuple(origin for group in groups for origin in origins(group)),
    }
    known = {record.spec.dataset.sha256 for record in records}
    drawer = Pictures(MOST_BYTES - len(render(Page(**parts))), known, dataset, tell)
    galleries = tuple(drawer.draw(drawings, progress))
    notes = list(drawer.problems)
    if galleries and not browsers_play():
        notes.append(NO_FILMS)
    if drawer.full:
        notes.append(FULL.format(MOST_BYTES // 1_000_000))
    return render(Page(**parts, galleries=galleries, notes=tuple(notes)))


def render(page: Page) -> bytes:
    """The page's HTML."""
    style, script = read("page.css"), read("page.js")
    html = _template().render(
        page=page,
        policy=policy(style, script),
        style=style,
        script=script,
        data=embedded(page.data),
        version=__version__,
    )
    # A record may hold halves of characters, which no file can.
    return str(html).encode("utf-8", "replace")


def policy(style: str, script: str) -> str:
    """The content security policy: nothing is loaded, and nothing runs but this style and this script."""
    return "; ".join(
        [
            "default-src 'none'",
            f"script-src '{_hash(script)}'",
            f"style-src '{_hash(style)}'",
            "img-src data:",
            "media-src data:",
            "base-uri 'none'",
            "form-action 'none'",
        ]
    )


def embedded(data: Any) -> str:
    """JSON as it may stand in a ``script`` element, whatever its texts hold."""
    return json.dumps(data, separators=(",", ":"), allow_nan=False).translate(_ESCAPES)


def read(name: str) -> str:
    """One of the page's own files."""
    return resources.files(__package__).joinpath(name).read_text(encoding="utf-8")


def _hash(text: str) -> str:
    return f"sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}"


@cache
def _template() -> Any:
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    return environment.from_string(read("page.html"))


def _summary(records: Sequence[Record], tasks: Sequence[str]) -> str:
    datasets = {record.spec.dataset.sha256 for record in records}
    rows = {(record.spec.dataset.sha256, record.spec.row_id, record.settings_hash) for record in records}
    counts = [(len(rows), "row"), (len(records), "run"), (len(datasets), "dataset")]
    words = ", ".join(f"{count} {word}{'' if count == 1 else 's'}" for count, word in counts)
    return f"{words}; {' and '.join(tasks)}."


def _listed(names: Sequence[str], most: int = 4) -> str:
    found = [clipped(name, 80) for name in dict.fromkeys(names)]
    return ", ".join(found[:most]) + (f" and {len(found) - most} more" if len(found) > most else "")
