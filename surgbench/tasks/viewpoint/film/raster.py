"""A canvas with a depth for every pixel: triangles, and lines that what is nearer hides. Compiled.

Films need hundreds of pictures of a few thousand triangles; this draws one in a few milliseconds, without a display, a
graphics card or a renderer to install.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from surgbench.compiled import compiled
from surgbench.geometry import FloatArray
from surgbench.report.drawing import Picture

# Every pixel is drawn as so many squared, and averaged.
FINER = 2
# Lines win over surfaces that are nearer by less than this share of their depth: those that lie on them.
LINE_SLACK = 0.004


@compiled
def draw_triangles(
    pixels: FloatArray,
    depth: FloatArray,
    faces: NDArray[np.int32],
    colours: NDArray[np.uint8],
    picture: Picture,
    nearest: NDArray[np.float32],
) -> None:
    """Draw triangles of one colour each; the nearer one wins.

    Args:
        pixels: ``(n, 2)`` corners; NaN where the camera does not see them: their triangles are left out.
        depth: ``(n,)`` of them, more than 0.
        faces: ``(m, 3)``.
        colours: ``(m, 3)``.
        picture: ``(H, W, 3)``, drawn into.
        nearest: ``(H, W)`` inverse depths, drawn into.
    """
    height, width = picture.shape[:2]
    for face in range(len(faces)):
        a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
        ax, ay, bx, by, cx, cy = pixels[a, 0], pixels[a, 1], pixels[b, 0], pixels[b, 1], pixels[c, 0], pixels[c, 1]
        if not (abs(ax) + abs(ay) + abs(bx) + abs(by) + abs(cx) + abs(cy) < 1e7):  # NaN too
            continue
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        if abs(area) < 1e-9:
            continue
        top, bottom = max(math.ceil(min(ay, by, cy)), 0), min(math.floor(max(ay, by, cy)), height - 1)
        za, zb, zc = 1.0 / depth[a], 1.0 / depth[b], 1.0 / depth[c]
        along_x = ((cy - ay) * (zb - za) - (by - ay) * (zc - za)) / area
        along_y = ((bx - ax) * (zc - za) - (cx - ax) * (zb - za)) / area
        for row in range(top, bottom + 1):
            # From edge to edge: of a long thin triangle, its box is nearly empty.
            first, last = math.inf, -math.inf
            for edge in range(3):
                px, py, qx, qy = ax, ay, bx, by
                if edge == 1:
                    px, py, qx, qy = bx, by, cx, cy
                elif edge == 2:
                    px, py, qx, qy = cx, cy, ax, ay
                if (py <= row) != (qy <= row):
                    x = px + (row - py) * (qx - px) / (qy - py)
                    first, last = min(first, x), max(last, x)
            if first > last:
                continue
            left, right = max(math.ceil(first), 0), min(math.floor(last), width - 1)
            inverse = za + (left - ax) * along_x + (row - ay) * along_y
            for column in range(left, right + 1):
                if inverse > nearest[row, column]:
                    nearest[row, column] = inverse
                    for k in range(3):
                        picture[row, column, k] = colours[face, k]
                inverse += along_x


@compiled
def draw_line(
    pixels: FloatArray,
    depth: FloatArray,
    colour: FloatArray,
    radius: float,
    shown: float,
    hidden: float,
    picture: Picture,
    nearest: NDArray[np.float32],
) -> None:
    """Draw a polyline that is not hidden by what is nearer, or dimly where it is.

    Args:
        pixels: ``(n, 2)`` points; pieces with a NaN are left out.
        depth: ``(n,)`` of them, more than 0.
        colour: ``(3,)``.
        radius: Half the line's width, pixels.
        shown: How opaque it is.
        hidden: And where it is hidden.
        picture: ``(H, W, 3)``, drawn into.
        nearest: ``(H, W)`` inverse depths.
    """
    height, width = picture.shape[:2]
    for piece in range(len(pixels) - 1):
        ax, ay, bx, by = pixels[piece, 0], pixels[piece, 1], pixels[piece + 1, 0], pixels[piece + 1, 1]
        dx, dy = bx - ax, by - ay
        square = dx * dx + dy * dy
        if not square < 1e8:  # NaN, and what comes from behind the camera
            continue
        left, right = max(math.ceil(min(ax, bx) - radius), 0), min(math.floor(max(ax, bx) + radius), width - 1)
        top, bottom = max(math.ceil(min(ay, by) - radius), 0), min(math.floor(max(ay, by) + radius), height - 1)
        last = piece == len(pixels) - 2
        for row in range(top, bottom + 1):
            for column in range(left, right + 1):
                share = ((column - ax) * dx + (row - ay) * dy) / square if square > 0.0 else 0.0
                # A joint belongs to one piece alone: nothing is laid on twice.
                if (share < 0.0 and piece > 0) or (share > 1.0 and not last):
                    continue
                share = min(1.0, max(0.0, share))
                away = (column - ax - share * dx) ** 2 + (row - ay - share * dy) ** 2
                if away > radius * radius:
                    continue
                inverse = (1.0 - share) / depth[piece] + share / depth[piece + 1]
                opaque = shown if inverse >= nearest[row, column] * (1.0 - LINE_SLACK) else hidden
                for k in range(3):
                    picture[row, column, k] = np.uint8(
                        (1.0 - opaque) * picture[row, column, k] + opaque * colour[k] + 0.5
                    )


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles, each of one colour.

    Attributes:
        points_m: ``(n, 3)``.
        faces: ``(m, 3)``.
        colours: ``(m, 3)`` 0 to 255.
    """

    points_m: FloatArray
    faces: NDArray[np.int32]
    colours: NDArray[np.uint8]

    def moved(self, transform: FloatArray) -> Mesh:
        """Carried along by a ``(4, 4)`` transform."""
        return Mesh(self.points_m @ transform[:3, :3].T + transform[:3, 3], self.faces, self.colours)


def joined(meshes: list[Mesh]) -> Mesh:
    """Several meshes as one."""
    starts = np.cumsum([0, *(len(mesh.points_m) for mesh in meshes[:-1])])
    faces = [mesh.faces + start for mesh, start in zip(meshes, starts, strict=True)]
    return Mesh(
        np.concatenate([mesh.points_m for mesh in meshes]),
        np.concatenate(faces).astype(np.int32),
        np.concatenate([mesh.colours for mesh in meshes]),
    )


class Canvas:
    """A picture that is drawn ``FINER`` times as large as it is shown.

    Args:
        width: As shown, pixels.
        height: Likewise.
        background: ``(height, width, 3)`` or a colour.
    """

    def __init__(self, width: int, height: int, background: tuple[int, int, int] = (255, 255, 255)) -> None:
        self.width, self.height = width, height
        self._picture = np.full((height * FINER, width * FINER, 3), background, dtype=np.uint8)
        self._nearest = np.zeros((height * FINER, width * FINER), dtype=np.float32)

    def copy(self) -> Canvas:
        """With what has been drawn so far."""
        other = Canvas.__new__(Canvas)
        other.width, other.height = self.width, self.height
        other._picture, other._nearest = self._picture.copy(), self._nearest.copy()
        return other

    def shade(self, rows: NDArray[np.uint8]) -> None:
        """Fill each row with a colour: ``(height, 3)``."""
        self._picture[:] = np.repeat(rows, FINER, axis=0)[:, None]

    def triangles(self, pixels: FloatArray, depth: FloatArray, mesh: Mesh, points_view: FloatArray) -> None:
        """Draw a mesh, lit from the viewer.

        Args:
            pixels: ``(n, 2)`` where its points are seen, in the picture as shown.
            depth: ``(n,)``.
            mesh: Its faces and colours.
            points_view: ``(n, 3)`` its points before the viewer, for the light.
        """
        corners = points_view[mesh.faces]
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        middle = corners.mean(axis=1)
        lengths = np.linalg.norm(normal, axis=1) * np.linalg.norm(middle, axis=1)
        facing = np.nan_to_num(np.abs((normal * middle).sum(axis=1)) / np.maximum(lengths, 1e-15))
        colours = (mesh.colours * (0.45 + 0.55 * facing)[:, None]).astype(np.uint8)
        fine = np.ascontiguousarray((pixels + 0.5) * FINER - 0.5, dtype=np.float64)
        seen = np.where(depth[:, None] > 1e-4, fine, np.nan)
        draw_triangles(seen, depth, mesh.faces, colours, self._picture, self._nearest)

    def line(
        self,
        pixels: FloatArray,
        depth: FloatArray,
        colour: tuple[int, int, int],
        width: float = 1.0,
        shown: float = 1.0,
        hidden: float = 0.15,
    ) -> None:
        """Draw a polyline, ``(n, 2)`` pixels as shown, ``(n,)`` depths, with its width in pixels as shown."""
        fine = np.ascontiguousarray((pixels + 0.5) * FINER - 0.5, dtype=np.float64)
        seen = np.where(depth[:, None] > 1e-4, fine, np.nan)
        draw_line(
            seen,
            np.ascontiguousarray(depth, dtype=np.float64),
            np.array(colour, dtype=np.float64),
            0.5 * width * FINER,
            shown,
            hidden,
            self._picture,
            self._nearest,
        )

    @property
    def picture(self) -> Picture:
        """As shown, ``(height, width, 3)``."""
        return np.asarray(
            cv2.resize(self._picture, (self.width, self.height), interpolation=cv2.INTER_AREA), dtype=np.uint8
        )
