"""Texts of others, parsed: Python for one thread at a time, JSON and YAML no deeper than the interpreter bears.

Up to Python 3.11 its depth is counted for all threads together, and one that is interrupted by another's raises a
``SystemError`` ("AST constructor recursion depth mismatch", https://github.com/python/cpython/issues/106905).
"""

from __future__ import annotations

import ast
import json
import math
import re
from pathlib import Path
from threading import RLock
from typing import Any

import yaml

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


# No file of ours or of anyone else's nests nearly as deeply; what does is damaged, or meant to overflow the stack.
_DEEPEST = 100
_MOST = 5_000_000


def parse_json(text: str | bytes) -> Any:
    """What a JSON text holds.

    Raises:
        ValueError: It is not JSON, or nested too deeply; the message says what is wrong with it.
    """
    try:
        content = json.loads(text)
    except RecursionError:
        raise ValueError(f"nested more than {_DEEPEST} deep") from None
    return _shallow(content)


def parse_yaml(text: str | bytes, loader: Any = yaml.SafeLoader) -> Any:
    """What a YAML text holds.

    Args:
        text: It.
        loader: A safe one. One in C is taken only for what cannot overflow its stack, which ends the process.

    Raises:
        ValueError: It is not YAML, or nested too deeply; the message, in one line, says what is wrong with it.
    """
    in_c = not hasattr(loader, "compose_node")
    try:
        content = yaml.load(text, Loader=yaml.SafeLoader if in_c and _may_be_deep(text) else loader)
    except RecursionError:
        raise ValueError(f"nested more than {_DEEPEST} deep") from None
    except (yaml.YAMLError, ValueError) as error:  # of a date that is none it is a ValueError
        raise ValueError(" ".join(str(error).split())) from None
    return _shallow(content, _MOST)


def _may_be_deep(text: str | bytes) -> bool:
    """Whether a YAML text could nest deeply: by indents, by brackets, or by dashes in a line."""
    data = text.encode() if isinstance(text, str) else text
    depth = 0
    for line in data.splitlines():
        depth += sum(map(line.count, (b"[", b"{")))
        steps = (depth, len(line) - len(line.lstrip()), len(re.findall(rb"[-?:]\s", line)))
        if max(steps) > _DEEPEST:
            return True
        depth = max(0, depth - sum(map(line.count, (b"]", b"}"))))
    return False


def _shallow(content: Any, most: float = math.inf) -> Any:
    """The same.

    Args:
        content: Mappings, lists and values.
        most: Values that it may have at one depth. A few aliases of YAML can stand for more than memory holds.

    Raises:
        ValueError: It is nested too deeply for what is done with it next, or has more values than that.
    """
    level = [content]
    for _ in range(_DEEPEST):
        inner: list[Any] = []
        for value in level:
            if isinstance(value, dict | list):
                inner += value.values() if isinstance(value, dict) else value
                if len(inner) > most:
                    raise ValueError(f"holds more than {most} values")
        if not inner:
            return content
        level = inner
    raise ValueError(f"nested more than {_DEEPEST} deep")
