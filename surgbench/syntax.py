"""Python's own parser, for one thread at a time.

Up to Python 3.11 its depth is counted for all threads together, and one that is interrupted by another's raises a
``SystemError`` ("AST constructor recursion depth mismatch", https://github.com/python/cpython/issues/106905).
"""

from __future__ import annotations

import ast
from pathlib import Path
from threading import RLock

# To be held for whatever parses: text of ours, and a library's ``ast.literal_eval`` (NumPy's, of a type's name).
PARSING = RLock()


def parse_file(path: Path) -> ast.Module:
    """The syntax tree of a Python file.

    Raises:
        SyntaxError: It is none.
        ValueError: It holds a null byte.
    """
    text = path.read_bytes()
    with PARSING:
        return ast.parse(text)
