"""The command as a user types it, and the records it leaves."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import pytest

from surgbench.cli import main

# Trackers of people who never saw the package.
STRANGERS = Path(__file__).with_name("strangers.py")
# For runs in which it does not matter where the tips come from: without the network a run starts two seconds sooner.
RUN = ("run", "--keypoints", "observed")


def surgbench(*arguments: object, expect: int = 0) -> None:
    """The command as a user types it, in this process."""
    before = sys.argv
    sys.argv = ["surgbench", *map(str, arguments)]
    try:
        with pytest.raises(SystemExit) as ended:
            main()
    finally:
        sys.argv = before
    assert ended.value.code == expect


def records(folder: Path) -> list[dict[str, Any]]:
    """All records below a folder, in the order of their paths."""
    return [json.loads(path.read_text()) for path in sorted(folder.rglob("*-r*.json"))]
