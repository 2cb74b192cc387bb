"""Where the feature was in the stereo camera's pictures over a trial, and whether it was seen in them.

By geometry, with what covers it, and by its tags in pictures.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from surgbench.geometry import FloatArray
from surgbench.viewpoint.contract import ViewpointScene
from surgbench.viewpoint.optics.stereo import AUTOCAM_STEREO
from surgbench.viewpoint.optics.visibility import ring_shares
from surgbench.viewpoint.rules import after_steps
from surgbench.viewpoint.simulator import Course
from surgbench.viewpoint.trial import Trial

DECIMALS = 3


class Pictures:
    """Looks at courses.

    Args:
        photographs_hz: How many pairs of pictures a second are rendered; 0 for none.
        rng: For the sensors' noise.
    """

    def __init__(self, photographs_hz: float, rng: np.random.Generator) -> None:
        self._hz, self._rng = photographs_hz, rng

    def pixels(self, course: Course, trial: Trial, scene: ViewpointScene) -> dict[str, Any]:
        """What a record has of pictures, on true poses where they are known.

        That is ``projected_px``, ``ring_seen`` and, where pictures are taken, ``tags_px``. The tool is in them.

        Args:
            course: What happened.
            trial: With or without truth.
            scene: As the controller was told it.
        """
        count = len(course.goals)
        base = scene.T_world_base if trial.truth is None else trial.truth.T_world_base
        feature = trial.T_world_feature if trial.truth is None else trial.truth.T_world_feature
        feature = after_steps(feature, count)
        camera = base @ scene.arm.forward(course.joints[1:])
        projected, inside = AUTOCAM_STEREO.see(camera, feature[:, :3, 3])
        found = {
            "projected_px": _rows(np.where(inside[..., None], projected, np.nan)),
            "ring_seen": _rows(ring_shares(AUTOCAM_STEREO, camera, feature)),
        }
        if self._hz <= 0 or not count:
            return found
        steps = range(0, count, max(1, round(1 / (self._hz * trial.dt_s))))
        return {**found, "tags_px": self._photograph(camera, feature, steps)}

    def _photograph(
        self, T_world_camera: FloatArray, T_world_feature: FloatArray, steps: range
    ) -> list[list[float | None] | None]:
        from surgbench.viewpoint.optics.markers import CentroidMeasurement

        measurement = CentroidMeasurement(AUTOCAM_STEREO, tool=True)
        T_camera_left, T_camera_right = AUTOCAM_STEREO.T_camera_left, AUTOCAM_STEREO.T_camera_right
        tags: list[list[float | None] | None] = [None] * len(T_world_camera)
        for step in steps:
            feature, camera = T_world_feature[step], T_world_camera[step]
            if np.isfinite(feature).all():
                pixels = measurement.measure(camera @ T_camera_left, camera @ T_camera_right, feature, self._rng)
                tags[step] = _rows(pixels[None])[0]
        return tags


def _rows(pixels: FloatArray) -> list[list[float | None]]:
    """``(T, …)`` numbers as one list for each step, ``None`` for NaN."""
    return [
        [None if np.isnan(value) else round(value, DECIMALS) for value in row]
        for row in pixels.reshape(len(pixels), math.prod(pixels.shape[1:])).tolist()
    ]
