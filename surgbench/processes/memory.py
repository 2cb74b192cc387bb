"""How much memory a tracker's process and what it has started use, and how much they may.

Counted is what the system can take back only by ending them: memory of their own, shared memory, and what of both has
been swapped out. Files that are mapped (libraries, weights) are not, for they can be read again, nor is memory that was
asked for and never written: libraries that compile reserve more than there is. What several of them share counts once.
"""

from __future__ import annotations

import os
import re
import time
from collections import defaultdict
from pathlib import Path
from typing import Annotated

from pydantic import AfterValidator

# Between two looks. In between a process may take more: some hundred megabytes, as fast as memory is.
LOOK_INTERVAL_S = 0.1
_PROC = Path("/proc")
_UNITS = {"": 1, "K": 1, "M": 2, "G": 3, "T": 4}
_SIZE = re.compile(r"\s*(\d+(?:\.\d+)?)\s*([KMGT])(I?)B?\s*", re.IGNORECASE)
# Of one process, and of one among several, where each counts for its share. Kernels before 5.4 say the latter of all.
_OWN = ("RssAnon", "RssShmem", "VmSwap")
_SHARES = ("Pss_Anon", "Pss_Shmem", "SwapPss")


def parse_size(text: str) -> int:
    """Bytes of a size with its unit: ``2GB`` is 2e9, ``2GiB`` 2^31; ``2G`` is ``2GB``.

    Raises:
        ValueError: It is none, or nothing.
    """
    found = _SIZE.fullmatch(text)
    size = 0
    if found is not None:
        number, unit, binary = found.groups()
        size = round(float(number) * (1024 if binary else 1000) ** _UNITS[unit.upper()])
    if size <= 0:
        raise ValueError(f"must be a size with its unit, as 2GB or 512MiB, not '{text}'")
    return size


def _as_told(text: str) -> str:
    parse_size(text)
    return " ".join(re.sub(r"(?<=[\d.])(?=[A-Za-z])", " ", text).split())


# A size as it is told to people: ``2 GB``.
Size = Annotated[str, AfterValidator(_as_told)]


class MemoryLimit:
    """How much memory a process and what it has started may use, looked at now and then.

    Args:
        size: For example ``"2 GB"``.
    """

    def __init__(self, size: str) -> None:
        self.size = size
        self._bytes = parse_size(size)
        self._looked_s = -LOOK_INTERVAL_S

    def exceeded(self, pid: int) -> bool:
        """Whether they use more; ``False`` where somebody has looked just before.

        Args:
            pid: The process, which leads a session of its own.
        """
        now = time.monotonic()
        if now - self._looked_s < LOOK_INTERVAL_S:
            return False
        self._looked_s = now
        return used_bytes(pid, self._bytes) > self._bytes


def used_bytes(pid: int, enough: int = 0) -> int:
    """Memory of the processes of a session, and of all that they have started.

    Args:
        pid: The session's leader.
        enough: What is less need not be exact: of memory that several share each is taken to have its own.
    """
    members = _members(pid)
    own = {member: sum(_fields(_PROC / str(member) / "status", _OWN).values()) for member in members}
    if len(members) == 1 or sum(own.values()) <= enough:
        return sum(own.values())
    shares = {member: _fields(_PROC / str(member) / "smaps_rollup", _SHARES) for member in members}
    return sum(sum(found.values()) if "Pss_Anon" in found else own[member] for member, found in shares.items())


def _members(leader: int) -> set[int]:
    """Numbers of the processes of a session, and of their descendants."""
    children: dict[int, list[int]] = defaultdict(list)
    waiting = [leader]
    for name in filter(str.isdecimal, os.listdir(_PROC)):  # noqa: PTH208 (in a third of the time)
        try:
            with open(f"{_PROC}/{name}/stat", "rb", buffering=0) as file:  # noqa: PTH123 (likewise)
                words = file.read()
            # After the name, which may hold anything: the state, and the numbers of parent, group and session.
            _, parent, _, session = words.rpartition(b")")[2].split()[:4]
        except (OSError, ValueError):  # it has ended
            continue
        number = int(name)
        children[int(parent)].append(number)
        if int(session) == leader:
            waiting.append(number)
    found: set[int] = set()
    while waiting:
        number = waiting.pop()
        if number not in found:
            found.add(number)
            waiting += children[number]
    return found


def _fields(path: Path, names: tuple[str, ...]) -> dict[str, int]:
    """Bytes of some lines of a file of sizes; nothing where the process has ended."""
    try:
        text = path.read_text()
    except OSError:
        return {}
    lines = (line.split() for line in text.splitlines())
    return {line[0][:-1]: 1024 * int(line[1]) for line in lines if line and line[0][:-1] in names}
