"""What tells that a record has been altered since it was written.

It guards against a slip of the hand, or of a script; whoever makes a seal of their own is not found out by it.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from surgbench.errors import DatasetError
from surgbench.files import canonical_json, sha256_text, short_hash
from surgbench.records.format import UNSEALED_FORMAT

SEAL = "seal"


def seal(record: dict[str, Any]) -> str:
    """SHA-256 of the canonical JSON of a record without its seal."""
    return sha256_text(canonical_json({key: value for key, value in record.items() if key != SEAL}))


def sealed(record: dict[str, Any]) -> dict[str, Any]:
    """A record with its seal."""
    return {**record, SEAL: seal(record)}


def check_seal(record: dict[str, Any], path: Path) -> None:
    """See that a record is as it was written; of records that have no seal yet, that its specification is.

    Raises:
        DatasetError: It has been altered; one line.
    """
    changed = [] if record.get("spec_hash") == short_hash(record.get("spec")) else ["its 'spec'"]
    try:
        unsealed = record.get("format") == UNSEALED_FORMAT and SEAL not in record
        if not unsealed and record.get(SEAL) != seal(record):
            changed = changed or ["its content"]
    except ValueError:  # NaN, which is never written
        changed = changed or ["its content"]
    if changed:
        raise DatasetError(
            f"{path}: altered: {changed[0]} is not what was written; run it again with: surgbench run … --again "
            "(or delete it)"
        )
