"""What tells rows of one name apart."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable

from surgbench.records.format import Plug, Record

DIGITS = 6


def telling_variants(records: Iterable[Record]) -> dict[str, str]:
    """By the hash of their settings, what the variants of some records of one row id are to be called.

    Two plug-ins of one name, such as a file before and after a change, get the start of their sources' hashes, and so
    does the engine before and after a change; what differs in nothing that is said gets that of its settings' hash.
    """
    by_settings = {record.settings_hash: record for record in records}
    if len(by_settings) == 1:
        return {key: record.variant for key, record in by_settings.items()}
    plugs = {key: _sources(record) for key, record in by_settings.items()}
    sources: dict[str, set[str]] = {}
    for own in plugs.values():
        for name, source in own.items():
            sources.setdefault(name, set()).add(source)
    words = {
        key: [f"{name}@{_digits(source)}" for name, source in own.items() if len(sources[name]) > 1]
        for key, own in plugs.items()
    }
    variants = {key: ", ".join(filter(None, [by_settings[key].variant, *words[key]])) for key in by_settings}
    count = Counter(variants.values())
    return {
        key: ", ".join(filter(None, [text, *([f"settings {key[:DIGITS]}"] if count[text] > 1 else [])]))
        for key, text in variants.items()
    }


def _sources(record: Record) -> dict[str, str]:
    """Of a record's plug-ins, by their names, and of the engine."""
    values = (getattr(record.spec, name) for name in type(record.spec).model_fields)
    return {"engine": record.spec.engine, **{plug.name: plug.source for plug in values if isinstance(plug, Plug)}}


def _digits(source: str) -> str:
    return source.rpartition("@")[2][:DIGITS] or "unknown"
