"""The rules of a record's steps as flags, in the order of ``CONSTRAINTS``: active, broken, against the naive pose."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from surgbench.tasks.viewpoint.records import ViewpointFrames
from surgbench.viewpoint.placement import CONSTRAINTS
from surgbench.viewpoint.rules import broken, depth_name

RULE_NAMES = {
    "no_go": "no-go zone",
    "floor": "floor",
    "orientation": "orientation",
    "proximity": "proximity",
    "joint_limit": "joint limit",
}


@dataclass(frozen=True, eq=False)
class RuleFlags:
    """Of T steps, ``(T, 5)`` each.

    Attributes:
        active: For the controller itself, as far as it says so.
        broken: By the camera, on reported poses, beyond their tolerances (:mod:`surgbench.viewpoint.rules`).
        naive: Those that speak against the naive pose.
    """

    active: NDArray[np.bool_]
    broken: NDArray[np.bool_]
    naive: NDArray[np.bool_]

    @property
    def told(self) -> bool:
        """Whether the controller says which rules are active."""
        return bool(self.active.any())


def rule_flags(frames: ViewpointFrames) -> RuleFlags:
    """Of a record's frames."""
    count = len(frames.index)
    beyond: NDArray[np.bool_] = np.zeros((count, len(CONSTRAINTS)), dtype=bool)
    for column, rule in enumerate(CONSTRAINTS):
        depth = np.array(getattr(frames, depth_name(rule)), dtype=np.float64)
        if len(depth):
            beyond[:, column] = broken(depth, rule)
    return RuleFlags(_bits(frames.active, count), beyond, _bits(frames.rules, count))


def spans(flags: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """From and to (one after the last) of every run of true values."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flags.astype(int), [0]])))
    return [(int(begin), int(end)) for begin, end in edges.reshape(-1, 2)]


def _bits(numbers: list[int], count: int) -> NDArray[np.bool_]:
    values = np.array(numbers or [0] * count, dtype=int)
    return np.asarray((values[:, None] >> np.arange(len(CONSTRAINTS))) & 1, dtype=bool)
