"""How well the ring's centre is measured from tags in rendered pictures, by the camera's angle and the settings.

    python benchmarks/tag_measurement.py
    python benchmarks/tag_measurement.py --picture docs/images/auxiliary-stereo.png

Prints Markdown: cameras 9 to 12.5 cm from the ring that look at it up to 75 degrees off its normal, both eyes. With
``--picture``, only draws a pair of pictures with the tag that was taken and the measured and the true centre.
"""

from __future__ import annotations

import argparse
import time
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from surgbench.files import write_atomic
from surgbench.geometry import FloatArray, inverse_transform, rigid_transform, rotation_from_vector
from surgbench.viewpoint.optics.grasp_object import grasp_object
from surgbench.viewpoint.optics.markers import WINDOW_CELLS, CentroidMeasurement, TagFinder
from surgbench.viewpoint.optics.photograph import Photographer
from surgbench.viewpoint.optics.stereo import AUTOCAM_STEREO
from surgbench.viewpoint.placement import look_at, naive_pose

CAMERAS = (AUTOCAM_STEREO.left, AUTOCAM_STEREO.right)
EYES = (AUTOCAM_STEREO.T_camera_left, AUTOCAM_STEREO.T_camera_right)
BANDS_DEG = (0, 30, 45, 60, 75)
WINDOWS = {"0.3 cells (OpenCV)": 0.3, f"{WINDOW_CELLS} cells (ours)": WINDOW_CELLS, "7 px (article)": np.inf}
ZOOM = 2


def scene(rng: np.random.Generator, off_normal_deg: float) -> tuple[FloatArray, FloatArray]:
    """A feature in the world and a camera that nearly looks at it."""
    T_world_feature = rigid_transform(rotation_from_vector(rng.normal(0, 1, 3)), np.zeros(3))
    angle, azimuth = np.radians(off_normal_deg), rng.uniform(0, 2 * np.pi)
    direction = [np.sin(angle) * np.cos(azimuth), np.cos(angle), np.sin(angle) * np.sin(azimuth)]
    place = rng.uniform(0.09, 0.125) * (T_world_feature[:3, :3] @ direction) + rng.normal(0, 0.003, 3)
    return T_world_feature, look_at(place, np.zeros(3))


def measure(rng: np.random.Generator, count: int) -> None:
    photographers = [Photographer(camera, grasp_object(tool=True)) for camera in CAMERAS]
    finders = {name: [TagFinder(camera, window_cells=size) for camera in CAMERAS] for name, size in WINDOWS.items()}
    rows: dict[str, list[tuple[float, float, float]]] = {name: [] for name in WINDOWS}
    spent_ms = []
    for _ in range(count):
        angle = rng.uniform(0, BANDS_DEG[-1])
        T_world_feature, T_world_camera = scene(rng, angle)
        for eye, (photographer, T_camera_eye) in enumerate(zip(photographers, EYES, strict=True)):
            T_cam_feature = inverse_transform(T_world_camera @ T_camera_eye) @ T_world_feature
            start = time.process_time()
            picture = photographer.photograph(T_cam_feature, rng)
            spent_ms.append(1e3 * (time.process_time() - start))
            points = grasp_object().points_m @ T_cam_feature[:3, :3].T + T_cam_feature[:3, 3]
            if not CAMERAS[eye].contains(CAMERAS[eye].see(points)).all():
                continue
            true = CAMERAS[eye].see(T_cam_feature[:3, 3])
            for name in WINDOWS:
                found = finders[name][eye].find(picture)
                errors = (np.nan, np.nan)
                if found is not None:
                    errors = (
                        float(np.linalg.norm(found.pixel - true)),
                        1e3 * float(np.linalg.norm(found.centre_cam_m - T_cam_feature[:3, 3])),
                    )
                rows[name].append((angle, *errors))
    print(f"A picture takes {np.median(spent_ms):.0f} ms of processor time (median).\n")
    print("| window | off the normal | pictures | found | px: median / 90 % / 99 % | mm: median / 90 % / 99 % |")
    print("|---|---|---|---|---|---|")
    for name, values in rows.items():
        table = np.array(values)
        for low, high in pairwise(BANDS_DEG):
            band = table[(table[:, 0] >= low) & (table[:, 0] < high)]
            parts = [np.nanpercentile(band[:, column], [50, 90, 99]) for column in (1, 2)]
            cells = " | ".join(" / ".join(f"{value:.1f}" for value in part) for part in parts)
            found_percent = 100 * np.isfinite(band[:, 1]).mean()
            print(f"| {name} | {low}–{high}° | {len(band)} | {found_percent:.1f} % | {cells} |")


def draw(rng: np.random.Generator, path: Path) -> None:
    """A pair of pictures: the tag that was taken (green), the measured centre (red cross), the true one (circle).

    Without noise, which no PNG can pack.
    """
    T_world_feature = rigid_transform(rotation_from_vector(np.array([0.8, 0.35, 0.2])), np.zeros(3))
    T_world_camera = naive_pose(T_world_feature)
    eyes = [T_world_camera @ T_camera_eye for T_camera_eye in EYES]
    pairs = CentroidMeasurement(AUTOCAM_STEREO, noise=0.0, tool=True).look(eyes[0], eyes[1], T_world_feature, rng)
    true, _ = AUTOCAM_STEREO.see(T_world_camera, T_world_feature[:3, 3])
    drawn = []
    for name, (picture, found), centre in zip(("left", "right"), pairs, true, strict=True):
        grey = cv2.resize(picture, None, fx=ZOOM, fy=ZOOM, interpolation=cv2.INTER_CUBIC)
        canvas: NDArray[np.uint8] = np.repeat(np.asarray(grey, dtype=np.uint8)[..., None], 3, axis=2)
        middle = _at(np.array([CAMERAS[0].width / 2, CAMERAS[0].height / 2]))
        cv2.drawMarker(canvas, middle, (255, 200, 0), cv2.MARKER_TILTED_CROSS, 24, 2)
        cv2.circle(canvas, _at(centre), 14, (0, 220, 255), 2, cv2.LINE_AA)
        label = f"{name}: no tag"
        if found is not None:
            corners = np.array([_at(corner) for corner in found.corners_px], dtype=np.int32)
            cv2.polylines(canvas, [corners], True, (60, 220, 60), 2, cv2.LINE_AA)
            cv2.circle(canvas, _at(found.corners_px[0]), 5, (60, 220, 60), -1, cv2.LINE_AA)
            cv2.drawMarker(canvas, _at(found.pixel), (60, 60, 255), cv2.MARKER_CROSS, 28, 2)
            off = found.pixel - centre
            label = f"{name}: tag {found.index}, measured {np.hypot(off[0], off[1]):.1f} px from the true centre"
        cv2.putText(canvas, label, (16, 36), cv2.FONT_HERSHEY_SIMPLEX, 0.8, (255, 255, 255), 2, cv2.LINE_AA)
        drawn.append(canvas)
    write_atomic(path, cv2.imencode(".png", np.hstack(drawn))[1].tobytes())


def _at(pixel: FloatArray) -> tuple[int, int]:
    """A pixel in the enlarged picture."""
    u, v = np.rint((pixel + 0.5) * ZOOM - 0.5).astype(int)
    return int(u), int(v)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=600)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--picture", type=Path)
    options = parser.parse_args()
    rng = np.random.default_rng(options.seed)
    if options.picture is None:
        measure(rng, options.scenes)
    else:
        draw(rng, options.picture)


if __name__ == "__main__":
    main()
