"""Calibration of the stereo camera from pictures of a checkerboard, as the authors did it.

In two stages, with OpenCV: each camera by itself (Zhang), then the transform between the two with both cameras'
parameters held (the article only says that it minimises the error of both).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from surgbench.camera import Camera
from surgbench.errors import SurgbenchError
from surgbench.geometry import FloatArray, inverse_transform, rigid_transform, rotation_from_vector, rotation_vector
from surgbench.viewpoint.optics.grasp_object import Checkerboard
from surgbench.viewpoint.optics.photograph import NOISE, Photographer, Picture
from surgbench.viewpoint.optics.stereo import Mount, StereoCamera

FEWEST_PAIRS = 3
# Refined within this many pixels either way of where a corner was found; squares are at least twice as large.
_WINDOW_PX = 5
_CRITERIA = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 60, 1e-4)
_FIND = cv2.CALIB_CB_ADAPTIVE_THRESH + cv2.CALIB_CB_NORMALIZE_IMAGE + cv2.CALIB_CB_FAST_CHECK

Pair = tuple[Picture, Picture]


class CalibrationError(SurgbenchError):
    """Pictures from which no camera can be calibrated."""


@dataclass(frozen=True)
class Calibration:
    """What came out.

    Attributes:
        cameras: With the mount that was given.
        left_rms_px: Root mean square distance of corners from where the left camera alone projects them.
        right_rms_px: Of the right one.
        stereo_rms_px: With one transform between them.
        pairs: How many had the board in both pictures.
    """

    cameras: StereoCamera
    left_rms_px: float
    right_rms_px: float
    stereo_rms_px: float
    pairs: int


def board_poses(cameras: StereoCamera, board: Checkerboard, count: int, rng: np.random.Generator) -> FloatArray:
    """Where a person might hold the board so that both cameras see all of it.

    Distances of 0.2 to 0.4 m, tilts of up to 40 degrees, any turn in the picture by up to 30 degrees, and the board
    everywhere in the pictures.

    Args:
        cameras: Both.
        board: What is held.
        count: Poses.
        rng: The only source of randomness.

    Returns:
        ``(count, 4, 4)`` T_left_board.
    """
    T_right_left = inverse_transform(cameras.T_left_right)
    facing = np.diag([1.0, -1.0, -1.0])
    margin_m = np.array([board.inner[0] + 1, board.inner[1] + 1, 0]) * board.square_m / 2
    outline = np.array([[x, y, 0.0] for x in (-1, 0, 1) for y in (-1, 0, 1)]) * margin_m
    poses: list[FloatArray] = []
    for _ in range(1000 * count):
        if len(poses) == count:
            return np.array(poses)
        towards = rng.uniform(0, 2 * np.pi)
        tilt = rotation_from_vector(np.radians(rng.uniform(0, 40)) * np.array([np.cos(towards), np.sin(towards), 0]))
        turn = rotation_from_vector(np.array([0.0, 0.0, np.radians(rng.uniform(-30, 30))]))
        distance = rng.uniform(0.2, 0.4)
        pixel = rng.uniform([0, 0], [cameras.left.width, cameras.left.height])
        ray = (pixel - [cameras.left.cx, cameras.left.cy]) / [cameras.left.fx, cameras.left.fy]
        pose = rigid_transform(turn @ tilt @ facing, distance * np.array([*ray, 1.0]))
        points = outline @ pose[:3, :3].T + pose[:3, 3]
        in_right = points @ T_right_left[:3, :3].T + T_right_left[:3, 3]
        pairs = ((cameras.left, points), (cameras.right, in_right))
        if all(camera.contains(camera.see(seen), 4.0).all() for camera, seen in pairs):
            poses.append(pose)
    raise CalibrationError("calibration: there are no places where both cameras see the whole board")


def photograph_board(
    cameras: StereoCamera,
    board: Checkerboard,
    T_left_board: FloatArray,
    rng: np.random.Generator,
    noise: float = NOISE,
) -> Iterable[Pair]:
    """Rendered pairs of pictures of a board at ``(n, 4, 4)`` poses; ``noise`` is the sensors'."""
    subject = board.subject()
    left, right = (Photographer(camera, subject, noise=noise) for camera in (cameras.left, cameras.right))
    T_right_left = inverse_transform(cameras.T_left_right)
    for pose in T_left_board:
        yield left.photograph(pose, rng), right.photograph(T_right_left @ pose, rng)


def find_corners(picture: Picture, board: Checkerboard) -> NDArray[np.float32] | None:
    """``(n, 2)`` pixels of the board's inner corners, in :attr:`Checkerboard.corners_m`'s order; ``None`` if not seen.

    A board of an even number of squares one way and an odd one the other way looks the same only one way round.
    """
    found, corners = cv2.findChessboardCorners(picture, board.inner, flags=_FIND)
    if not found:
        return None
    refined = cv2.cornerSubPix(picture, np.asarray(corners, np.float32), (_WINDOW_PX, _WINDOW_PX), (-1, -1), _CRITERIA)
    return np.asarray(refined, dtype=np.float32).reshape(-1, 2)


def calibrate(pairs: Iterable[Pair], board: Checkerboard, like: StereoCamera | None = None) -> Calibration:
    """Both cameras and the transform between them.

    Args:
        pairs: Pictures of the left and the right camera, all of one size.
        board: What they show.
        like: Whose mount to keep, which no board can tell.

    Raises:
        CalibrationError: Fewer than three pairs show the whole board twice, or they differ in size.
    """
    size: tuple[int, ...] | None = None
    seen: list[tuple[NDArray[np.float32], NDArray[np.float32]]] = []
    for left, right in pairs:
        size = size or left.shape
        if left.shape != size or right.shape != size:
            raise CalibrationError(f"calibration: pictures of sizes {size}, {left.shape} and {right.shape}")
        corners = find_corners(left, board), find_corners(right, board)
        if corners[0] is not None and corners[1] is not None:
            seen.append((corners[0], corners[1]))
    if size is None or len(seen) < FEWEST_PAIRS:
        raise CalibrationError(f"calibration: {len(seen)} pairs show the whole board, {FEWEST_PAIRS} are needed")
    points = [board.corners_m.astype(np.float32)] * len(seen)
    lefts, rights = [one for one, _ in seen], [other for _, other in seen]
    width_height = size[1], size[0]
    left_rms, K_left, D_left = _mono(points, lefts, width_height)
    right_rms, K_right, D_right = _mono(points, rights, width_height)
    held = cv2.CALIB_FIX_INTRINSIC
    stereo = cv2.stereoCalibrate(
        points, lefts, rights, K_left, D_left, K_right, D_right, width_height, None, None, flags=held
    )
    rms, (rotation, place) = float(stereo[0]), (np.asarray(part, dtype=np.float64) for part in stereo[5:7])
    # OpenCV's transform takes points of the left camera's frame to the right one's.
    T_left_right = inverse_transform(rigid_transform(rotation, place.ravel()))
    x, y, z = T_left_right[:3, 3].tolist()
    a, b, c = rotation_vector(T_left_right[:3, :3]).tolist()
    cameras = StereoCamera(
        left=_camera(K_left, D_left, width_height),
        right=_camera(K_right, D_right, width_height),
        rotation_rad=(a, b, c),
        translation_m=(x, y, z),
        mount=Mount() if like is None else like.mount,
    )
    return Calibration(cameras, left_rms, right_rms, rms, len(seen))


def _mono(
    points: Sequence[NDArray[np.float32]], corners: Sequence[NDArray[np.float32]], size: tuple[int, int]
) -> tuple[float, FloatArray, FloatArray]:
    rms, matrix, distortion, _, _ = cv2.calibrateCamera(points, corners, size, np.eye(3), np.zeros(5))
    return float(rms), np.asarray(matrix, dtype=np.float64), np.asarray(distortion, dtype=np.float64).ravel()[:5]


def _camera(matrix: FloatArray, distortion: FloatArray, size: tuple[int, int]) -> Camera:
    fx, fy, cx, cy = matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]
    return Camera(width=size[0], height=size[1], fx=fx, fy=fy, cx=cx, cy=cy, distortion=tuple(distortion.tolist()))


def displacement_px(one: Camera, other: Camera, step_px: int = 8) -> FloatArray:
    """How far apart two cameras see the same rays, ``(rows, columns)`` pixels over the first one's picture.

    That is what a calibration is wrong by: its parameters make up for each other. NaN where one of them sees no ray.
    """
    rows, columns = np.mgrid[: one.height : step_px, : one.width : step_px].astype(np.float64)
    pixels = np.stack([columns, rows], axis=-1)
    straight = one.lens.undistort(pixels)
    rays = np.concatenate([(straight - [one.cx, one.cy]) / [one.fx, one.fy], np.ones((*rows.shape, 1))], axis=-1)
    return np.asarray(np.linalg.norm(other.see(rays) - pixels, axis=-1))
