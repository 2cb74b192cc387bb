"""What both eyes of the stereo camera see, drawn through their lenses, with the ring's outline and the middle."""

from __future__ import annotations

import cv2
import numpy as np

from surgbench.camera import Camera
from surgbench.geometry import FloatArray, inverse_transform
from surgbench.report.drawing import Picture
from surgbench.tasks.viewpoint.film.raster import Canvas, Mesh
from surgbench.tasks.viewpoint.film.shot import Shot
from surgbench.tasks.viewpoint.film.things import Colour, held_ring, wire_mesh
from surgbench.viewpoint.optics.stereo import AUTOCAM_STEREO
from surgbench.viewpoint.trial import Wire
from surgbench.viewpoint.workspace import Workspace

OUTLINE: Colour = (60, 220, 60)
CROSS: Colour = (255, 255, 255)
LOST: Colour = (235, 60, 50)
BACKGROUND: Colour = (58, 60, 66)
BOARD: tuple[Colour, Colour] = ((148, 134, 120), (120, 108, 98))
# Squares of the board on which the task stands.
SQUARE_M, SQUARES = 0.01, 12
RING_POINTS = 48


class Eyes:
    """Draws both pictures of one controller's camera, the right way up.

    Args:
        shot: Whose.
        workspace: For the board, the base of its zone.
        wire: Where it is known.
        width: Of each picture, pixels.
        ring_radius_m: Of the outline.
    """

    def __init__(self, shot: Shot, workspace: Workspace, wire: Wire | None, width: int, ring_radius_m: float) -> None:
        self._shot = shot
        eyes = (AUTOCAM_STEREO.left, AUTOCAM_STEREO.right)
        height = round(width * eyes[0].height / eyes[0].width)
        self._cameras = [eye.resized(width, height) for eye in eyes]
        self._T_camera_eye = (AUTOCAM_STEREO.T_camera_left, AUTOCAM_STEREO.T_camera_right)
        self._still = [_board(workspace), *([] if wire is None else [wire_mesh(wire)])]
        angle = np.linspace(0, 2 * np.pi, RING_POINTS, endpoint=False)
        self._ring = ring_radius_m * np.stack([np.cos(angle), np.zeros_like(angle), np.sin(angle)], axis=1)
        # The controllers' cameras have y up, so that their pictures are upside down.
        self.turned = bool(np.median(shot.T_world_camera[:, 2, 1]) > 0)

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of each picture."""
        return self._cameras[0].width, self._cameras[0].height

    def draw(self, step: int) -> tuple[Picture, Picture]:
        """Left and right, after a step."""
        left, right = (
            self._picture(camera, T_camera_eye, step)
            for camera, T_camera_eye in zip(self._cameras, self._T_camera_eye, strict=True)
        )
        return left, right

    def _picture(self, camera: Camera, T_camera_eye: FloatArray, step: int) -> Picture:
        shot = self._shot
        T_eye_world = inverse_transform(shot.T_world_camera[step] @ T_camera_eye)
        canvas = Canvas(camera.width, camera.height, BACKGROUND)
        ring = shot.T_world_feature[step]
        known = bool(np.isfinite(ring).all())
        for mesh in (*self._still, *([held_ring().moved(ring)] if known else [])):
            _mesh(canvas, camera, T_eye_world, mesh)
        picture = canvas.picture
        if self.turned:
            picture = np.ascontiguousarray(picture[::-1, ::-1])
        middle = np.array([(camera.width - 1) / 2, (camera.height - 1) / 2])
        _cross(picture, middle, 9, CROSS)
        if known:
            points = self._ring @ ring[:3, :3].T + ring[:3, 3]
            pixels = camera.see(points @ T_eye_world[:3, :3].T + T_eye_world[:3, 3])
            centre = camera.see(T_eye_world[:3, :3] @ ring[:3, 3] + T_eye_world[:3, 3])
            if self.turned:
                pixels, centre = 2 * middle - pixels, 2 * middle - centre
            inside = bool(camera.contains(centre[None])[0]) if np.isfinite(centre).all() else False
            if np.isfinite(pixels).all() and (np.abs(pixels - middle) < 4 * max(self.size)).all():
                cv2.polylines(picture, [np.rint(16 * pixels).astype(np.int32)], True, OUTLINE, 1, cv2.LINE_AA, 4)
            if not inside:
                cv2.rectangle(picture, (0, 0), (camera.width - 1, camera.height - 1), LOST, 3)
        return picture


def _board(workspace: Workspace) -> Mesh:
    zone = workspace.zone
    along = zone.points[1] - zone.points[0]
    along /= np.linalg.norm(along)
    side = np.cross(zone.up, along)
    places = SQUARE_M * (np.arange(SQUARES + 1) - SQUARES / 2)
    x, y = (grid.ravel() for grid in np.meshgrid(places, places))
    points = zone.points[:4].mean(axis=0) + x[:, None] * along + y[:, None] * side
    row, column = (grid.ravel() for grid in np.mgrid[:SQUARES, :SQUARES])
    corner = row * (SQUARES + 1) + column
    one = np.stack([corner, corner + 1, corner + SQUARES + 1], axis=1)
    other = np.stack([corner + 1, corner + SQUARES + 2, corner + SQUARES + 1], axis=1)
    shade = np.array(BOARD, dtype=np.uint8)[(row + column) % 2]
    return Mesh(points, np.concatenate([one, other]).astype(np.int32), np.concatenate([shade, shade]))


def _mesh(canvas: Canvas, camera: Camera, T_eye_world: FloatArray, mesh: Mesh) -> None:
    points = mesh.points_m @ T_eye_world[:3, :3].T + T_eye_world[:3, 3]
    canvas.triangles(camera.see(points), points[:, 2], mesh, points)


def _cross(picture: Picture, at: FloatArray, size: int, colour: Colour) -> None:
    u, v = np.rint(at).astype(int).tolist()
    cv2.line(picture, (u - size, v), (u + size, v), colour, 1, cv2.LINE_AA)
    cv2.line(picture, (u, v - size), (u, v + size), colour, 1, cv2.LINE_AA)
