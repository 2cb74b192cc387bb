"""Records of pages for tests: sound and failed runs, and some of somebody who means no good."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import fabricate
import numpy as np
from small_dataset import FRAMES, make_pair, states_of

from surgbench.records.reader import read_records
from surgbench.report.page.build import build_page

UNITS = ("000-left", "000-right", "001-left", "001-right")
ATTACK = "</script><script>alert(1)</script>"
MARKUP = "<img src=x onerror=alert(2)>"


@contextmanager
def silent(description: str, total: float) -> Iterator[Any]:
    """No progress."""
    yield lambda amount: None


def page_of(folder: Path, **options: Any) -> str:
    """The page of a folder's records."""
    return build_page(read_records([folder]), silent, **options).decode()


def ordinary(folder: Path) -> Path:
    """Three rows on two arms: two sound ones, of which ``better`` is twice as good, and one that failed."""
    for unit in UNITS[:2]:
        good, bad = fabricate.record(row_id="better", unit=unit), fabricate.record(row_id="worse", unit=unit)
        good["errors"]["mask_error"] = [value / 2 for value in good["errors"]["mask_error"]]
        good["environment"] = {"python": "3.11", "machine": {"processor": "Processor of the test"}}
        bad["frames"]["latency_ms"] = [100.0] * 4
        fabricate.write(folder, good, bad, fabricate.failed(row_id="broken", unit=unit))
    return folder


def hostile(folder: Path) -> Path:
    """Names, messages, options and a dataset that are meant to run in the reader's browser."""
    name = (f"a{MARKUP}", "ab" * 32)
    for unit in UNITS[:2]:
        sound = fabricate.record(row_id=MARKUP, unit=unit, dataset=name)
        sound["spec"]["tracker"] = {"name": ATTACK, "source": ATTACK, "options": {ATTACK: {"x": ATTACK}, "y": "\ud800"}}
        sound["variant"] = f"{ATTACK}\u2028{{{{ 7 * 7 }}}}' onfocus=alert(3) autofocus='"
        sound["environment"] = {ATTACK: ATTACK, "machine": [MARKUP]}
        sound[f'"><script>alert(4)</script>{MARKUP}'] = "javascript:alert(5)"
        failed = fabricate.failed(row_id=f"b{MARKUP}", unit=unit, dataset=name)
        failed["error"] = f"ValueError: {ATTACK} <!-- <script> {MARKUP}"
        failed["status"] = "invalid"
        fabricate.write(folder, sound, failed)
    return folder


def pictured(folder: Path) -> Path:
    """One row on a small dataset that is there: its estimates are the true states, a little off at the end."""
    dataset = make_pair(folder / "pairs", sequences=1)
    for unit in UNITS[:2]:
        arm = unit.partition("-")[2]
        record = fabricate.record(row_id="near", unit=unit, dataset=(dataset.name, dataset.hash), frames=FRAMES)
        states = states_of(arm) + 0.002 * np.arange(FRAMES)[:, None]
        record["frames"]["state"] = states.tolist()
        record["dataset_path"] = str(dataset.path)
        fabricate.write(folder / "runs", record)
    return folder / "runs"
