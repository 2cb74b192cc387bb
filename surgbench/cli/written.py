"""Text to standard output, or to a file that only one command writes at a time."""

from __future__ import annotations

import sys
from pathlib import Path


def write_text(text: str | bytes, out: Path | None, command: str) -> None:
    """Write what a command has to say.

    Args:
        text: All of it; bytes as they are.
        out: File; ``None`` for standard output.
        command: Name of the command, for whoever meets it at work.

    Raises:
        SurgbenchError: The file cannot be written, or another command is at it; one line.
    """
    from surgbench.errors import SurgbenchError
    from surgbench.files import write_atomic
    from surgbench.locks import in_use, locked_beside

    if out is None and isinstance(text, bytes):
        sys.stdout.buffer.write(text)
        return
    if out is None:
        sys.stdout.write(str(text))
        return
    try:
        with locked_beside(out) as ours:
            if not ours:
                raise in_use(out, command)
            write_atomic(out, text if isinstance(text, bytes) else text.encode())
    except OSError as error:
        raise SurgbenchError(f"{out}: cannot be written ({error.strerror})") from None
