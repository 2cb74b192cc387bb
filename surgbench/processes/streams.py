"""Standard output and error as they may be: of ASCII only, a pipe that nobody reads any more, a full disk."""

from __future__ import annotations

import codecs
import contextlib
import io
import os
import sys
import unicodedata

# What stands for a character that a terminal does not have, where taking the accents off is not enough.
_PLAIN = {"…": "...", "–": "-", "—": "-", "−": "-", "×": "x", "·": ".", "°": " deg", "±": "+-", "µ": "u", "μ": "u",
          "≤": "<=", "≥": ">=", "≈": "~", "→": "->", "‘": "'", "’": "'", "“": '"', "”": '"'}  # fmt: skip
_HANDLER = "surgbench.plain"


def _plain(error: UnicodeError) -> tuple[str | bytes, int]:
    """What is written for characters that cannot be; bytes of a file's name that are no characters stay as they are."""
    if not isinstance(error, UnicodeEncodeError):
        raise error
    missing = error.object[error.start : error.end]
    with contextlib.suppress(UnicodeEncodeError):
        return missing.encode("ascii", "surrogateescape"), error.end
    simpler = (_PLAIN.get(one) or unicodedata.normalize("NFKD", one) for one in missing)
    return "".join(text.encode("ascii", "ignore").decode() or "?" for text in simpler), error.end


def print_whatever_comes() -> None:
    """Replace characters that standard output or error cannot show, in this process, instead of failing over them."""
    codecs.register_error(_HANDLER, _plain)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors=_HANDLER)


def flush_output() -> None:
    """Write what standard output holds back, here rather than when the interpreter has ended, which hides the fault.

    Raises:
        OSError: It cannot be written.
    """
    if sys.stdout is not None:
        sys.stdout.flush()


def abandon_output() -> None:
    """Throw away what standard output still holds: nobody reads it, or it cannot be written."""
    with contextlib.suppress(OSError, ValueError):
        sink = os.open(os.devnull, os.O_WRONLY)
        os.dup2(sink, sys.stdout.fileno())
        os.close(sink)
