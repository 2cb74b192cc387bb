"""Where every row is from: all that its records say of what was run, on what, and where."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from surgbench.processes.reference import REFERENCE_MS
from surgbench.records.format import Record
from surgbench.report.page.boards import Group
from surgbench.report.page.content import Origin, clipped

# Said elsewhere on the page, of single runs, or of no use to whom the page is sent to: where somebody's files lie.
_LEFT_OUT = (
    "spec", "settings_hash", "spec_hash", "seal", "status", "error", "variant", "floor", "unit_frames",
    "dataset_frames", "dataset_path", "environment", "calibration_ms", "initialise_s", "initial_state",
)  # fmt: skip
_OF_THE_RUN = ("unit", "sequence", "arms", "mask_kind", "repeat", "seed", "level", "dataset")
MOST_VALUES = 6  # that are listed where runs differ
MOST_FACTS = 200

Facts = list[tuple[str, str]]


def origins(group: Group) -> list[Origin]:
    """One for each run of a table, in the order of its rows."""
    found: dict[str, Origin] = {}
    for row, records, anchor, about in zip(group.rows, group.records, group.anchors, group.abouts, strict=True):
        if about not in found:
            found[about] = Origin(about, clipped(row["row_id"]), group.title, anchor, _parts(row, records))
    return list(found.values())


def _parts(row: Mapping[str, Any], records: Sequence[Record]) -> dict[str, Facts]:
    abouts = [record.about for record in records]
    specs = [spec for about in abouts if isinstance(spec := about.get("spec"), dict)]
    dataset = records[0].spec.dataset
    ran: Facts = [
        ("row", row["row_id"]),
        ("variant", row["variant"]),
        ("settings hash", row["settings_hash"]),
        ("task", row["task"]),
        *(_fact(key, specs, key) for key in ("seed",) if any(key in spec for spec in specs)),
        ("repeats", str(row["repeats"])),
        ("records", str(len(records))),
        ("status", ", ".join(_counted(record.status for record in records))),
    ]
    on: Facts = [
        ("dataset", dataset.name),
        ("its SHA-256", dataset.sha256),
        ("units", ", ".join(_few(sorted({record.spec.unit for record in records}), 40))),
        ("frames", str(row["frames"])),
    ]
    kept = [{key: value for key, value in spec.items() if key not in _OF_THE_RUN} for spec in specs]
    others = [{key: value for key, value in about.items() if key not in _LEFT_OUT} for about in abouts]
    where = [value if isinstance(value := about.get("environment"), dict) else {} for about in abouts]
    parts = {
        "What was run": ran,
        "On what": on,
        "Settings": _facts(kept),
        "Where": [*_facts(where), *_times(row, records, abouts)],
        "Records": _facts(others),
    }
    return {
        title: [(clipped(name, 200), clipped(text)) for name, text in facts] for title, facts in parts.items() if facts
    }


def _times(row: Mapping[str, Any], records: Sequence[Record], abouts: Sequence[Mapping[str, Any]]) -> Facts:
    facts: Facts = []
    ratio = row.get("calibration_ratio")
    if ratio is not None:
        own = np.array([record.calibration_ms for record in records if record.calibration_ms is not None])
        spread = f"{own.min():.2f} to {own.max():.2f} ms, on the reference machine {REFERENCE_MS:.2f} ms"
        facts.append(("calibration ratio", f"{ratio:.3f} (a fixed piece of work took {spread})"))
    took = [value for about in abouts if isinstance(value := about.get("initialise_s"), int | float)]
    if took:
        facts.append(("initialising, median", f"{float(np.median(took)):.3f} s"))
    return facts


def _facts(contents: Sequence[Mapping[str, Any]]) -> Facts:
    """What some mappings say, nested ones with dots; where they differ, each value and how often."""
    flat = [dict(_flat(content)) for content in contents]
    keys = list(dict.fromkeys(key for one in flat for key in one))
    facts = [_fact(key, flat, key) for key in keys[:MOST_FACTS]]
    if len(keys) > MOST_FACTS:
        facts.append(("…", f"{len(keys) - MOST_FACTS} more"))
    return facts


def _fact(name: str, contents: Sequence[Mapping[str, Any]], key: str) -> tuple[str, str]:
    counts = _counted(_text(content[key]) for content in contents if key in content)
    return name, "; ".join(_few(counts, MOST_VALUES))


def _counted(texts: Iterator[str] | Any) -> list[str]:
    """Each text once; with how often where there are several."""
    counts: dict[str, int] = {}
    for text in texts:
        counts[text] = counts.get(text, 0) + 1
    return list(counts) if len(counts) == 1 else [f"{text} ({count})" for text, count in counts.items()]


def _few(texts: Sequence[str], most: int) -> list[str]:
    return [*texts[:most], *([f"and {len(texts) - most} more"] if len(texts) > most else [])]


def _flat(content: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in content.items():
        if isinstance(value, Mapping) and value:
            yield from _flat(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value


def _text(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)
