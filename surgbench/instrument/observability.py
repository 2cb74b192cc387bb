"""What of a state an instrument shows: joints that it has, and whether a turn about its shaft is seen."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from surgbench.geometry import FloatArray
from surgbench.instrument.spec import InstrumentSpec, Quantity

# A ring of the body is round if it is so within this share of its radius, and has no wider gap than a hexagon.
ROUND, WIDEST_GAP_RAD = 0.02, 2 * np.pi / 6 + 1e-3
# Vertices nearer than this along the shaft are of one ring.
_RING_M = 1e-6


def observable(spec: InstrumentSpec, bodies: Mapping[str, FloatArray]) -> frozenset[Quantity]:
    """What can be told of an instrument: as its file says, else as its links and body have it.

    A joint is seen if it moves a body or a tip. The roll, a turn about the shaft (beta), is seen unless no joint is and
    the whole body is round about the shaft's axis; tips beside that axis cannot be told from others around it.

    Args:
        spec: The instrument file; ``observable`` decides where it is there.
        bodies: Link name to the ``(V, 3)`` vertices of its body, metres in the wrist-pitch frame with all joints at 0.

    Returns:
        Of ``roll`` and the joints' names.
    """
    if spec.observable is not None:
        return frozenset(spec.observable)
    moved: frozenset[Quantity] = frozenset()
    above: dict[str, frozenset[Quantity]] = {}
    for link in spec.links:
        joints: frozenset[Quantity] = frozenset() if link.parent is None else above[link.parent]
        if link.joint is not None and link.joint_scale != 0.0:
            joints |= {link.joint}
        above[link.name] = joints
        if link.name in bodies or any(tip.link == link.name for tip in spec.tips):
            moved |= joints
    if not moved and is_round(np.concatenate(list(bodies.values()))):
        return frozenset()
    return moved | {"roll"}


def is_round(points: FloatArray) -> bool:
    """Whether points are those of a body of revolution about the z axis: rings of corners, and points on the axis.

    Args:
        points: ``(N, 3)``.

    Example:
        A tube of eight sides is, one of four sides is a box.

        >>> import numpy as np
        >>> from surgbench.instrument.observability import is_round
        >>> turns = [np.arange(sides) * 2 * np.pi / sides for sides in (8, 4)]
        >>> [is_round(np.stack([np.cos(turn), np.sin(turn), np.zeros_like(turn)], axis=1)) for turn in turns]
        [True, False]
    """
    radius, turn = np.hypot(points[:, 0], points[:, 1]), np.arctan2(points[:, 1], points[:, 0])
    tolerance = ROUND * max(float(radius.max()), _RING_M)
    off_axis = radius > tolerance
    height, radius, turn = points[off_axis, 2], radius[off_axis], turn[off_axis]
    order = np.argsort(height)
    for level in np.split(order, np.flatnonzero(np.diff(height[order]) > _RING_M) + 1):
        by_radius = level[np.argsort(radius[level])]
        for ring in np.split(by_radius, np.flatnonzero(np.diff(radius[by_radius]) > tolerance) + 1):
            if np.ptp(radius[ring]) > 2 * tolerance:
                return False
            around = np.sort(turn[ring])
            if np.diff(around, append=around[0] + 2 * np.pi).max() > WIDEST_GAP_RAD:
                return False
    return True
