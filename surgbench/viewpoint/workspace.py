"""Where the camera must not be: the no-go zone, the floor, too near to the feature, the wrong side.

World frame: metres, z up, as the cart of the arms reports it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from surgbench.errors import SurgbenchError
from surgbench.geometry import FloatArray

# Edges shorter than this, or closer than this to lying on one line, span no box.
SMALLEST_M = 1e-3
FLOOR_M, PROXIMITY_M = 0.04, 0.08
PREFERRED_SIDE = (1.0, 0.0, 0.0)


class WorkspaceError(SurgbenchError):
    """Touched points that span no zone."""


@dataclass(frozen=True, eq=False)
class NoGoZone:
    """A box over a base that was touched at four corners, as high as a fifth point.

    Membership is as meant and not as printed: a point is inside where it is behind all faces. (The article has "any",
    and the published code tests one side face twice and the side from D to A never; ``missing_face`` has it so, an
    endless zone beyond that side.)

    Args:
        points: ``(5, 3)`` A, B, C, D around the base, and E at the height of the top.
        missing_face: Leave out the face from D to A.

    Raises:
        WorkspaceError: The points are not finite, or span no box.
    """

    points: FloatArray
    missing_face: bool = False

    def __post_init__(self) -> None:
        points = np.asarray(self.points, dtype=np.float64)
        if points.shape != (5, 3) or not np.isfinite(points).all():
            raise WorkspaceError("a no-go zone needs five points of three finite coordinates")
        base, top = points[:4], points[4]
        normal = np.cross(base[1] - base[0], base[3] - base[0])
        longest = max(np.linalg.norm(base[k] - base[k - 1]) for k in range(4))
        if longest < SMALLEST_M or np.linalg.norm(normal) < SMALLEST_M * longest:
            raise WorkspaceError("the no-go zone's base points are collinear; touch four corners of its base")
        normal = normal / np.linalg.norm(normal)
        if abs(float((top - base[0]) @ normal)) < SMALLEST_M:
            raise WorkspaceError("the no-go zone has no height: its fifth point lies in the plane of its base")
        sides = np.roll(base, -1, axis=0) - base
        turns = np.cross(sides, np.roll(sides, -1, axis=0)) @ normal
        if (turns <= SMALLEST_M**2).any():
            raise WorkspaceError("the no-go zone's base points A, B, C, D must follow each other around a convex base")

    @cached_property
    def height(self) -> FloatArray:
        """``(3,)`` from the base up to the top."""
        normal = np.cross(self.points[1] - self.points[0], self.points[3] - self.points[0])
        normal = normal / np.linalg.norm(normal)
        return np.asarray(((self.points[4] - self.points[0]) @ normal) * normal)

    @cached_property
    def up(self) -> FloatArray:
        """``(3,)`` unit vector of the height."""
        return np.asarray(self.height / np.linalg.norm(self.height))

    @cached_property
    def faces(self) -> FloatArray:
        """``(n, 4)`` inward unit normal and offset of base, top, sides: ``n . p - offset`` is the depth behind it."""
        base = self.points[:4]
        rows = [np.append(self.up, self.up @ base[0]), np.append(-self.up, -self.up @ (base[0] + self.height))]
        for k in range(3 if self.missing_face else 4):
            along = base[(k + 1) % 4] - base[k]
            inward = np.cross(self.up, along)
            inward = inward / np.linalg.norm(inward)
            if inward @ (base[(k + 2) % 4] - base[k]) < 0:
                inward = -inward
            rows.append(np.append(inward, inward @ base[k]))
        return np.array(rows)

    @property
    def corners(self) -> FloatArray:
        """``(8, 3)``: the base's four, then the top's four above them."""
        return np.concatenate([self.points[:4], self.points[:4] + self.height])

    def depth(self, points: FloatArray) -> FloatArray:
        """How deep points ``(..., 3)`` lie inside, metres, ``(...)``.

        It is the distance to the nearest face; outside it is negative, and the distance to the farthest face's plane.
        """
        return np.asarray((points @ self.faces[:, :3].T - self.faces[:, 3]).min(axis=-1))

    def project_to_top(self, points: FloatArray) -> FloatArray:
        """Points ``(..., 3)`` moved along the height onto the plane of the top, wherever they are."""
        below = (self.points[0] + self.height - points) @ self.up
        return np.asarray(points + below[..., None] * self.up)


@dataclass(frozen=True, eq=False)
class Workspace:
    """All rules on where the camera may be.

    Attributes:
        zone: The no-go zone.
        floor_m: The camera stays this high above the base of the zone, everywhere.
        proximity_m: And this far from the feature.
        preferred_side: ``(3,)`` unit vector: the camera's y axis must not point along it.
    """

    zone: NoGoZone
    floor_m: float = FLOOR_M
    proximity_m: float = PROXIMITY_M
    preferred_side: tuple[float, float, float] = PREFERRED_SIDE

    @cached_property
    def floor(self) -> FloatArray:
        """``(4,)`` unit normal, upwards, and offset of the floor's plane."""
        up = self.zone.up
        return np.append(up, up @ self.zone.points[0] + self.floor_m)

    def below_floor(self, points: FloatArray) -> FloatArray:
        """How far points ``(..., 3)`` lie below the floor, metres, ``(...)``; negative above it."""
        return np.asarray(self.floor[3] - points @ self.floor[:3])

    def wrong_side(self, T_world_camera: FloatArray) -> NDArray[np.bool_]:
        """Which cameras ``(..., 4, 4)`` are on the wrong side of the feature, ``(...)`` bool."""
        return np.asarray(T_world_camera[..., :3, 1] @ np.array(self.preferred_side) > 0)
