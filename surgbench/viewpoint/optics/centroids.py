"""How far the feature was from the middle of the pictures: the statistics of the article's Table II.

Pixels are those of the detected feature, NaN where it was not. As the authors' evaluation has it: errors are about
(256, 192), not the principal point, in percent of the picture's diagonal (640 px), width and height; detections
whose L2 error is more than two standard deviations from the mean are left out of every mean and deviation
(``trimmed``); visibility is the rate of detection, in or out of the frame.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from surgbench.camera import Camera
from surgbench.geometry import FloatArray

ERRORS = ("l2", "u", "v")
TRIM_DEVIATIONS = 2.0


@dataclass(frozen=True)
class Spread:
    """Mean and sample standard deviation of some numbers; NaN where there are too few.

    Attributes:
        mean: Of them.
        deviation: With one degree of freedom less than numbers.
        count: How many.
    """

    mean: float
    deviation: float
    count: int


@dataclass(frozen=True)
class EyeErrors:
    """Errors of one camera.

    Attributes:
        pixels: Of ``l2``, ``u`` and ``v``: absolute errors in pixels.
        percent: The same in percent of diagonal, width and height.
    """

    pixels: dict[str, Spread]
    percent: dict[str, Spread]


@dataclass(frozen=True)
class CentroidTable:
    """Table II.

    Attributes:
        left: Errors of the left camera.
        right: Of the right one.
        combined: Percent of both together.
        visibility_percent: ``left``, ``right``, ``any`` and ``both``, of all frames.
    """

    left: EyeErrors
    right: EyeErrors
    combined: dict[str, Spread]
    visibility_percent: dict[str, float]


def spread(values: FloatArray) -> Spread:
    """Mean and sample deviation of ``(n,)`` finite numbers."""
    count = len(values)
    mean = float(values.mean()) if count else float("nan")
    return Spread(mean, float(values.std(ddof=1)) if count > 1 else float("nan"), count)


def pool(one: Spread, other: Spread) -> Spread:
    """What :func:`spread` says of two samples together, from what it says of each.

    ``s^2 = ((n1 - 1) s1^2 + (n2 - 1) s2^2 + n1 n2 / (n1 + n2) (m1 - m2)^2) / (n1 + n2 - 1)``.
    """
    if one.count == 0 or other.count == 0:
        return other if one.count == 0 else one
    count = one.count + other.count
    mean = (one.count * one.mean + other.count * other.mean) / count
    within = sum((part.count - 1) * part.deviation**2 for part in (one, other) if part.count > 1)
    between = one.count * other.count / count * (one.mean - other.mean) ** 2
    return Spread(mean, float(np.sqrt((within + between) / (count - 1))), count)


def eye_errors(pixels: FloatArray, camera: Camera, trimmed: bool = True) -> EyeErrors:
    """Errors of one camera about the middle of its picture.

    Args:
        pixels: ``(T, 2)`` (u, v), NaN where nothing was detected.
        camera: For width and height.
        trimmed: Leave out what is farther than two deviations from the mean of L2.
    """
    seen = pixels[np.isfinite(pixels).all(axis=1)]
    off = np.abs(seen - [camera.width / 2, camera.height / 2])
    errors = np.column_stack([np.hypot(off[:, 0], off[:, 1]), off])
    if trimmed and len(errors) > 1:
        length = errors[:, 0]
        errors = errors[np.abs(length - length.mean()) <= TRIM_DEVIATIONS * length.std(ddof=1)]
    whole = np.array([np.hypot(camera.width, camera.height), camera.width, camera.height])
    return EyeErrors(
        {name: spread(values) for name, values in zip(ERRORS, errors.T, strict=True)},
        {name: spread(values) for name, values in zip(ERRORS, (100 * errors / whole).T, strict=True)},
    )


def visibility(left: FloatArray, right: FloatArray) -> dict[str, float]:
    """Percent of ``(T, 2)`` frames with a detection in the left, the right, any and both pictures; NaN without any."""
    seen = np.array([np.isfinite(pixels).all(axis=1) for pixels in (left, right)])
    if seen.shape[1] == 0:
        return dict.fromkeys(("left", "right", "any", "both"), float("nan"))
    rows = {"left": seen[0], "right": seen[1], "any": seen.any(axis=0), "both": seen.all(axis=0)}
    return {name: float(100 * row.mean()) for name, row in rows.items()}


def centroid_table(
    left: FloatArray, right: FloatArray, cameras: tuple[Camera, Camera], trimmed: bool = True
) -> CentroidTable:
    """Table II of detections.

    Args:
        left: ``(T, 2)`` pixels in the left picture, NaN where not seen.
        right: ``(T, 2)`` in the right one.
        cameras: Left and right.
        trimmed: As the authors do it; visibility is always that of all frames.
    """
    eyes = [eye_errors(pixels, camera, trimmed) for pixels, camera in zip((left, right), cameras, strict=True)]
    combined = {name: pool(eyes[0].percent[name], eyes[1].percent[name]) for name in ERRORS}
    return CentroidTable(eyes[0], eyes[1], combined, visibility(left, right))
