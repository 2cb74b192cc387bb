"""Where the feature is in the pictures, by its tags: the measurement behind the article's Table II.

Of the tags found, that with the longest perimeter is taken; its pose comes from its four corners, the ring's centre
from the tag's known place on the grasp object, and that centre is projected back through the lens. So the feature may
be measured where it is hidden, or even outside the picture.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from surgbench.camera import Camera
from surgbench.geometry import FloatArray, inverse_transform, rigid_transform, rotation_from_vector
from surgbench.viewpoint.optics.grasp_object import DICTIONARY, Tags, grasp_object
from surgbench.viewpoint.optics.photograph import NOISE, Photographer, Picture
from surgbench.viewpoint.optics.stereo import StereoCamera

SHORTEST_PERIMETER_PX = 10.0
# The most exact of 0.3 (OpenCV's) to 1.
WINDOW_CELLS = 0.6


@dataclass(frozen=True, eq=False)
class Found:
    """A tag, and the feature's centre by it.

    Attributes:
        index: The tag's id.
        corners_px: ``(4, 2)`` as detected.
        T_cam_tag: ``(4, 4)``.
        centre_cam_m: ``(3,)`` the ring's centre in the camera's frame.
        pixel: ``(2,)`` where that is seen, through the lens; NaN where no lens sees it.
    """

    index: int
    corners_px: FloatArray
    T_cam_tag: FloatArray
    centre_cam_m: FloatArray
    pixel: FloatArray


class TagFinder:
    """Finds the tags in a picture.

    Settings are the authors': corners refined to sub-pixels in a window of 7 pixels either way, 50 iterations, to
    0.005; error correction rate 0.7. But a cell of a tag has 4 pixels at 11 cm, so that this window would take in the
    tag's code and what is around it; OpenCV 4.9 and later, unlike the authors' 4.8, limit it by the cells' size.

    Args:
        camera: That took the pictures: intrinsics and distortion as calibrated.
        tags: As measurement knows them; their true side may be another.
        window_cells: The window's largest size either way, in cells of the tag; infinite is the authors' version.
    """

    def __init__(self, camera: Camera, tags: Tags | None = None, window_cells: float = WINDOW_CELLS) -> None:
        self.camera, self.tags = camera, tags or Tags()
        settings = cv2.aruco.DetectorParameters()
        settings.cornerRefinementMethod = int(cv2.aruco.CORNER_REFINE_SUBPIX)
        settings.cornerRefinementWinSize = 7
        settings.cornerRefinementMaxIterations = 50
        settings.cornerRefinementMinAccuracy = 0.005
        settings.errorCorrectionRate = 0.7
        settings.relativeCornerRefinmentWinSize = min(window_cells, 1e3)
        self._detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(DICTIONARY), settings)

    def find(self, picture: Picture) -> Found | None:
        """The ring's centre in a ``(height, width)`` picture; ``None`` where no tag of the object is found."""
        quads, ids, _ = self._detector.detectMarkers(picture)
        if ids is None:
            return None
        best: tuple[int, FloatArray] | None = None
        longest = SHORTEST_PERIMETER_PX
        for quad, index in zip(quads, np.asarray(ids, dtype=np.intp).ravel(), strict=True):
            corners = np.asarray(quad, dtype=np.float64).reshape(4, 2)
            length = float(np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1).sum())
            if int(index) in self.tags.centre_m and length > longest:
                best, longest = (int(index), corners), length
        return None if best is None else self.solve(*best)

    def solve(self, index: int, corners_px: FloatArray) -> Found | None:
        """The ring's centre by one tag (its id) whose ``(4, 2)`` corners were detected, clockwise from its first."""
        seen, bent = corners_px, None
        if self.camera.distortion_model == "opencv":
            bent = np.array(self.camera.distortion) if self.camera.is_distorted else None
        else:  # OpenCV's solver knows no other
            seen = self.camera.lens.undistort(corners_px)
            if not np.isfinite(seen).all():
                return None
        solved, rotation, place = cv2.solvePnP(
            self.tags.corners_m, seen, self.camera.matrix, bent, flags=cv2.SOLVEPNP_ITERATIVE
        )
        turned, moved = (np.asarray(vector, dtype=np.float64).ravel() for vector in (rotation, place))
        pose = rigid_transform(rotation_from_vector(turned), moved)
        if not solved or not np.isfinite(pose).all():
            return None
        centre = pose[:3, :3] @ np.array(self.tags.centre_m[index]) + pose[:3, 3]
        return Found(index, corners_px, pose, centre, self.camera.see(centre))


class CentroidMeasurement:
    """Photographs the grasp object with both cameras, and measures its ring's centre in both pictures.

    Args:
        cameras: Left and right, as they are.
        calibrated: As they are believed to be; as they are unless told.
        tags: Where they are on the object, and how large.
        believed: What measurement takes them to be; as they are unless told.
        noise: The sensors', :class:`Photographer`.
        tool: Whether ring and tool are in the pictures as well.
    """

    def __init__(
        self,
        cameras: StereoCamera,
        calibrated: StereoCamera | None = None,
        tags: Tags | None = None,
        believed: Tags | None = None,
        noise: float = NOISE,
        tool: bool = False,
    ) -> None:
        subject = grasp_object(tags, tool)
        known = calibrated or cameras
        self._eyes: Sequence[tuple[Photographer, TagFinder]] = [
            (Photographer(true, subject, noise=noise), TagFinder(camera, believed or tags))
            for true, camera in ((cameras.left, known.left), (cameras.right, known.right))
        ]

    def look(
        self, T_world_left: FloatArray, T_world_right: FloatArray, T_world_feature: FloatArray, rng: np.random.Generator
    ) -> list[tuple[Picture, Found | None]]:
        """Both pictures and what is found in them.

        Args:
            T_world_left: ``(4, 4)`` the left camera, not the controlled point.
            T_world_right: ``(4, 4)`` the right one.
            T_world_feature: ``(4, 4)``.
            rng: For the sensors' noise.
        """
        pairs = []
        for (photographer, finder), T_world_eye in zip(self._eyes, (T_world_left, T_world_right), strict=True):
            picture = photographer.photograph(inverse_transform(T_world_eye) @ T_world_feature, rng)
            pairs.append((picture, finder.find(picture)))
        return pairs

    def measure(
        self, T_world_left: FloatArray, T_world_right: FloatArray, T_world_feature: FloatArray, rng: np.random.Generator
    ) -> NDArray[np.float64]:
        """Pixels ``(2, 2)`` of the ring's centre, left and right, NaN where no tag was found; as :meth:`look`."""
        found = [one for _, one in self.look(T_world_left, T_world_right, T_world_feature, rng)]
        return np.array([np.full(2, np.nan) if one is None else one.pixel for one in found])
