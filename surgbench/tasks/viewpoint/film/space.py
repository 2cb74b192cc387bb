"""The scene in space: camera arm and frustum, ring and tool, wire, zone, floor, and where both have been."""

from __future__ import annotations

import numpy as np

from surgbench.camera import Camera
from surgbench.geometry import FloatArray, inverse_transform
from surgbench.report.drawing import Picture
from surgbench.tasks.viewpoint.draw import EDGES
from surgbench.tasks.viewpoint.film.raster import Canvas, Mesh
from surgbench.tasks.viewpoint.film.shot import Shot
from surgbench.tasks.viewpoint.film.things import Colour, arm_mesh, held_ring, wire_mesh
from surgbench.viewpoint.optics.stereo import AUTOCAM_STEREO
from surgbench.viewpoint.placement import look_at
from surgbench.viewpoint.trial import Wire
from surgbench.viewpoint.workspace import Workspace

ZONE: Colour = (205, 60, 50)
FLOOR: Colour = (150, 158, 170)
NEAR: Colour = (230, 140, 30)
FRUSTUM: Colour = (40, 120, 75)
CAMERA_TRAIL: Colour = (40, 150, 90)
RING_TRAIL: Colour = (210, 140, 20)
LINE_OF_SIGHT: Colour = (110, 110, 110)
TOP: Colour = (246, 248, 251)
BOTTOM: Colour = (222, 227, 234)

# The viewer looks from this elevation, beside the camera arm, so that neither arm is before the ring.
ELEVATION_RAD, BESIDE_RAD = np.radians(22.0), np.radians(118.0)
FIELD_RAD = np.radians(30.0)
# Trails are so long.
TRAIL_S = 8.0
GRID_M, GRID_HALF = 0.02, 6
# Depth at which the picture's frame of the frustum is drawn, as a share of the wanted distance.
FRAME_SHARE = 0.45
SPHERE = 48


class Space:
    """Draws one controller's scene, always from the same place.

    Args:
        shot: Whose.
        workspace: Its rules.
        wire: Where it is known.
        cameras_m: ``(n, 3)`` all places that have to be in the picture, of several controllers the same.
        width: Of the picture, pixels.
        height: Likewise.
        dt_s: Seconds between steps.
    """

    def __init__(
        self,
        shot: Shot,
        workspace: Workspace,
        wire: Wire | None,
        cameras_m: FloatArray,
        width: int,
        height: int,
        dt_s: float,
    ) -> None:
        self._shot, self._workspace = shot, workspace
        self._trail = max(2, round(TRAIL_S / dt_s))
        corners = workspace.zone.corners
        feature = _finite(shot.T_world_feature[:, :3, 3])
        places = np.concatenate([corners, feature, cameras_m])
        low, high = np.percentile(places, [1, 99], axis=0)
        middle = (low + high) / 2
        reach = float(np.linalg.norm(high - low)) / 2 + 0.02
        away = shot.T_world_base[:3, 3] - corners.mean(axis=0)
        azimuth = float(np.arctan2(away[1], away[0])) + BESIDE_RAD
        direction = np.array([np.cos(azimuth), np.sin(azimuth), np.tan(ELEVATION_RAD)])
        direction /= np.linalg.norm(direction)
        viewer = look_at(middle + reach / np.sin(FIELD_RAD / 2) * direction, middle)
        viewer[:3, :2] *= -1.0  # the camera's y points up; a picture's points down
        self._T_view_world = inverse_transform(viewer)
        focal = 0.5 * height / np.tan(FIELD_RAD / 2)
        self._camera = Camera(width=width, height=height, fx=focal, fy=focal, cx=(width - 1) / 2, cy=(height - 1) / 2)
        self._still = Canvas(width, height)
        share = np.linspace(0.0, 1.0, height)[:, None]
        self._still.shade(np.rint((1 - share) * TOP + share * np.array(BOTTOM)).astype(np.uint8))
        self._draw_still(wire, feature)

    def draw(self, step: int) -> Picture:
        """The scene after a step."""
        shot, canvas = self._shot, self._still.copy()
        camera, ring = shot.T_world_camera[step], shot.T_world_feature[step]
        self._mesh(canvas, arm_mesh(shot.scene.arm, shot.joints[step], shot.T_world_base))
        seen = bool(np.isfinite(ring).all())
        if seen:
            self._mesh(canvas, held_ring().moved(ring))
        first = max(0, step - self._trail)
        self._line(canvas, shot.T_world_camera[first : step + 1 : 3, :3, 3], CAMERA_TRAIL, 2.0, 0.9, 0.3)
        self._line(canvas, shot.T_world_feature[first : step + 1 : 3, :3, 3], RING_TRAIL, 2.0, 0.9, 0.3)
        self._frustum(canvas, camera)
        if seen:
            self._line(canvas, np.stack([camera[:3, 3], ring[:3, 3]]), LINE_OF_SIGHT, 1.2, 0.9, 0.3)
            self._sphere(canvas, ring[:3, 3])
        return canvas.picture

    def _draw_still(self, wire: Wire | None, feature: FloatArray) -> None:
        zone, canvas = self._workspace.zone, self._still
        base, up = zone.points[:4].mean(axis=0), zone.up
        along = zone.points[1] - zone.points[0]
        along /= np.linalg.norm(along)
        side = np.cross(up, along)
        # The floor that the camera has to keep above, higher than the table on which the task stands.
        for place in range(-GRID_HALF, GRID_HALF + 1):
            for one, other in ((along, side), (side, along)):
                middle = base + self._workspace.floor_m * up + place * GRID_M * one
                ends = np.stack([middle - GRID_HALF * GRID_M * other, middle + GRID_HALF * GRID_M * other])
                self._line(canvas, ends, FLOOR, 0.8, 0.75, 0.1)
        if wire is not None:
            self._mesh(canvas, wire_mesh(wire))
        if len(feature) > 1:
            self._line(canvas, feature[:: max(1, len(feature) // 600)], RING_TRAIL, 1.0, 0.3, 0.1)
        for a, b in EDGES:
            self._line(canvas, zone.corners[[a, b]], ZONE, 1.6, 0.95, 0.35)

    def _frustum(self, canvas: Canvas, T_world_camera: FloatArray) -> None:
        """The left eye's: rays through the picture's corners, and its frame; towards the ring."""
        eye = AUTOCAM_STEREO.left
        pose = T_world_camera @ AUTOCAM_STEREO.T_camera_left
        depth = FRAME_SHARE * self._shot.scene.distance_m
        corners = np.array([[0, 0], [eye.width, 0], [eye.width, eye.height], [0, eye.height]], dtype=np.float64) - 0.5
        rays = np.column_stack([(corners - [eye.cx, eye.cy]) / [eye.fx, eye.fy], np.ones(4)]) * depth
        places = rays @ pose[:3, :3].T + pose[:3, 3]
        for place in places:
            self._line(canvas, np.stack([pose[:3, 3], place]), FRUSTUM, 1.4, 0.9, 0.35)
        self._line(canvas, places[[0, 1, 2, 3, 0]], FRUSTUM, 1.8, 0.95, 0.4)

    def _sphere(self, canvas: Canvas, centre: FloatArray) -> None:
        """What the camera must not come nearer than: outline as it is seen, and the level circle."""
        radius = self._workspace.proximity_m
        if radius <= 0:
            return
        angle = np.linspace(0, 2 * np.pi, SPHERE + 1)
        eye = inverse_transform(self._T_view_world)[:3, 3]
        towards = eye - centre
        far = float(np.linalg.norm(towards))
        if far > radius:
            towards /= far
            across = np.cross(towards, [0.0, 0.0, 1.0])
            across /= np.linalg.norm(across)
            other = np.cross(towards, across)
            rim = radius * np.sqrt(1 - (radius / far) ** 2)
            outline = np.cos(angle)[:, None] * across + np.sin(angle)[:, None] * other
            self._line(canvas, centre + radius**2 / far * towards + rim * outline, NEAR, 1.4, 0.8, 0.8)
        level = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=1)
        self._line(canvas, centre + radius * level, NEAR, 1.0, 0.45, 0.2)

    def _mesh(self, canvas: Canvas, mesh: Mesh) -> None:
        points = mesh.points_m @ self._T_view_world[:3, :3].T + self._T_view_world[:3, 3]
        canvas.triangles(self._camera.project(points), points[:, 2], mesh, points)

    def _line(
        self, canvas: Canvas, places_m: FloatArray, colour: Colour, width: float, shown: float, hidden: float
    ) -> None:
        points = places_m @ self._T_view_world[:3, :3].T + self._T_view_world[:3, 3]
        canvas.line(self._camera.project(points), points[:, 2], colour, width, shown, hidden)


def _finite(points: FloatArray) -> FloatArray:
    return points[np.isfinite(points).all(axis=1)]
