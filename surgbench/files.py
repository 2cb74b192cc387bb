"""Files that are there whole or not at all, and their hashes."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
from pathlib import Path
from secrets import token_hex
from typing import Any

PARTIAL_SUFFIX = ".partial"
HASH_DIGITS = 16


def write_atomic(path: Path, data: bytes) -> None:
    """Write ``data`` so that ``path`` never holds a part of it, whatever kills the process.

    Raises:
        OSError: It cannot be written; names ``path``.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    # Two machines, or two containers, that share the folder may each have a process of this number.
    partial = path.with_name(f"{path.name}.{os.getpid()}.{token_hex(4)}{PARTIAL_SUFFIX}")
    try:
        partial.write_bytes(data)
        partial.replace(path)
    except OSError as error:
        with contextlib.suppress(OSError):
            partial.unlink(missing_ok=True)
        # Of a full disk the system names no file, else the part.
        raise OSError(error.errno, error.strerror, str(path)) from None


def canonical_json(value: Any) -> str:
    """JSON with sorted keys and no spaces: the text that hashes are taken of. NaN is refused."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False)


def short_hash(value: Any) -> str:
    """Start of the SHA-256 of a value's canonical JSON."""
    return sha256_text(canonical_json(value))[:HASH_DIGITS]


def sha256_text(text: str) -> str:
    """Hex SHA-256 of a text."""
    return hashlib.sha256(text.encode()).hexdigest()


def sha256_file(path: Path) -> str:
    """Hex SHA-256 of a file's bytes."""
    return hashlib.sha256(path.read_bytes()).hexdigest()
