"""Files that are there whole or not at all, and their hashes."""

from __future__ import annotations

import contextlib
import errno
import hashlib
import json
import os
import stat
from pathlib import Path
from secrets import token_hex
from typing import Any

PARTIAL_SUFFIX = ".partial"
HASH_DIGITS = 16
# No file of a dataset that is read whole is nearly as large; one that is was made to take all memory.
MOST_BYTES = 1 << 30
# Likewise of JSON, which takes up to 25 times its size when it is parsed, and of YAML, which takes long.
MOST_JSON_BYTES = 1 << 28
MOST_YAML_BYTES = 1 << 22


def read_whole(path: Path, most: int = MOST_BYTES) -> bytes:
    """The bytes of a file that somebody else may have made: a pipe is not waited for, and no device read without end.

    Args:
        path: It.
        most: Bytes that it may have.

    Raises:
        OSError: It cannot be read, is larger, or is a folder, pipe or device; names ``path``.
    """
    descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    with os.fdopen(descriptor, "rb") as file:
        about = os.fstat(descriptor)
        if stat.S_ISDIR(about.st_mode):
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
        if not stat.S_ISREG(about.st_mode):
            raise OSError(errno.EINVAL, "Not a regular file", str(path))
        data = b"" if about.st_size > most else file.read(most + 1)
        if max(about.st_size, len(data)) > most:
            raise OSError(errno.EFBIG, f"Larger than {most >> 20} MiB", str(path))
        return data


def write_atomic(path: Path, data: bytes) -> None:
    """Write ``data`` so that ``path`` never holds a part of it, whatever kills the process.

    Raises:
        OSError: It cannot be written; names ``path``.
    """
    if not path.name or path.is_dir():
        raise IsADirectoryError(errno.EISDIR, "is a folder; name a file", str(path))
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
    return sha256_bytes(text.encode())


def sha256_bytes(data: bytes) -> str:
    """Hex SHA-256 of bytes."""
    return hashlib.sha256(data).hexdigest()


def sha256_file(path: Path) -> str:
    """Hex SHA-256 of a file's bytes."""
    return hashlib.sha256(path.read_bytes()).hexdigest()
