"""The rules of a record's steps as flags, in the order of ``CONSTRAINTS``: active, broken, against the naive pose."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from surgbench.tasks.viewpoint.records import ViewpointFrames
from surgbench.viewpoint.placement import CONSTRAINTS
from surgbench.viewpoint.scores import NO_GO_TOLERANCE_M

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
        broken: By its commands, by more than a millimetre.
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
    broken: NDArray[np.bool_] = np.zeros((count, len(CONSTRAINTS)), dtype=bool)
    beyond: tuple[tuple[str, list[bool]], ...] = (
        ("no_go", [depth > NO_GO_TOLERANCE_M for depth in frames.no_go_depth_m]),
        ("floor", [depth > NO_GO_TOLERANCE_M for depth in frames.floor_depth_m]),
        ("proximity", [depth > NO_GO_TOLERANCE_M for depth in frames.proximity_m]),
        ("joint_limit", frames.limit_violation),
    )
    for name, flags in beyond:
        if flags:
            broken[:, CONSTRAINTS.index(name)] = flags
    return RuleFlags(_bits(frames.active, count), broken, _bits(frames.rules, count))


def spans(flags: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """From and to (one after the last) of every run of true values."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flags.astype(int), [0]])))
    return [(int(begin), int(end)) for begin, end in edges.reshape(-1, 2)]


def _bits(numbers: list[int], count: int) -> NDArray[np.bool_]:
    values = np.array(numbers or [0] * count, dtype=int)
    return np.asarray((values[:, None] >> np.arange(len(CONSTRAINTS))) & 1, dtype=bool)
