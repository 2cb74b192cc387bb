"""What the console shows, made of a wire chaser drawn with OpenCV: the picture of docs/viewpoint-view.md.

    python benchmarks/view_pictures.py --out docs/images/console-view.png

Three columns, the endoscope's picture above the auxiliary camera's: the left eye's as the cameras took them, then both
eyes' as the console shows them. The auxiliary camera has the lenses and the baseline of the article's; its picture is
drawn as a camera without lens would see it, bent by Brown's model and softened. The right way up, unlike AutoCam's.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np

from surgbench.camera import Camera
from surgbench.geometry import FloatArray, inverse_transform, rigid_transform
from surgbench.report.drawing import Picture, below, beside, heading, save_png, scaled
from surgbench.viewpoint.optics.console import ConsoleSettings, ConsoleView, StereoPicture, fusing_separation_px, join
from surgbench.viewpoint.optics.stereo import AUTOCAM_STEREO

LEFT, RIGHT, BASELINE_M = AUTOCAM_STEREO.left, AUTOCAM_STEREO.right, AUTOCAM_STEREO.baseline_m
# A da Vinci endoscope at the size of the article's capture; its focal length and baseline are assumed.
ENDOSCOPE = Camera(width=1400, height=986, fx=1500, fy=1500, cx=700, cy=493)
ENDOSCOPE_BASELINE_M = 0.005
DISTANCE_M = 0.11

SQUARE_M = 0.013
RING_RADIUS_M, RING_AT = 0.009, 0.42
TOOL, RING, WIRE = (170, 172, 178), (235, 235, 240), (70, 140, 220)
MARGIN_PX, FINER = 64, 2


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--sharpening", type=float, default=1.0, help="alpha; 3 in the code")
    arguments = parser.parse_args()
    ring_m = wire(np.array(RING_AT))
    auxiliary = look_at(ring_m + DISTANCE_M * np.array([0.40, -0.68, 0.61]), ring_m)
    endoscope = look_at(ring_m + np.array([-0.06, -0.13, 0.11]), np.array([0.0, 0.0, 0.02]))
    taken = stereo(LEFT, RIGHT, BASELINE_M, auxiliary)
    above = stereo(ENDOSCOPE, ENDOSCOPE, ENDOSCOPE_BASELINE_M, endoscope)
    separation_px = round(fusing_separation_px(LEFT.fx, BASELINE_M, DISTANCE_M))
    settings = ConsoleSettings(sharpening=arguments.sharpening, separation_px=separation_px)
    console = ConsoleView(LEFT, RIGHT, settings)(above, taken)
    columns = {
        "left eye, as taken": join(above.left, taken.left),
        f"left eye, as shown (-{separation_px} px)": console.left,
        f"right eye, as shown (+{separation_px} px)": console.right,
    }
    sheet = beside([below([heading(text, LEFT.width, 18), shown]) for text, shown in columns.items()], 8)
    save_png(arguments.out, scaled(sheet, 0.625))


def look_at(from_m: FloatArray, to_m: FloatArray) -> FloatArray:
    """T_world_camera with OpenCV's axes, the horizon level, the world's z up in the picture."""
    z = (to_m - from_m) / np.linalg.norm(to_m - from_m)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    return rigid_transform(np.stack([x, np.cross(z, x), z], axis=-1), from_m)


def wire(share: FloatArray) -> FloatArray:
    """Points of the wire, ``(...)`` shares of its length to ``(..., 3)`` metres; world z up, the board at z = 0."""
    x = 0.04 * np.cos(np.pi * share)
    y = 0.016 * np.sin(2 * np.pi * share)
    z = 0.045 * np.sin(np.pi * share) ** 0.7 * (1 - 0.25 * np.sin(3 * np.pi * share) ** 2)
    return np.stack([x, y, z], axis=-1)


def stereo(left: Camera, right: Camera, baseline_m: float, T_world_left: FloatArray) -> StereoPicture:
    """Both eyes' pictures; the right eye is ``baseline_m`` along the left one's x."""
    T_left_right = rigid_transform(np.eye(3), np.array([baseline_m, 0.0, 0.0]))
    return StereoPicture(photograph(left, T_world_left), photograph(right, T_world_left @ T_left_right))


def photograph(camera: Camera, T_world_camera: FloatArray) -> Picture:
    """Draw the scene without the lens, larger and finer; bend it; soften it."""
    wide = Camera(
        width=FINER * (camera.width + 2 * MARGIN_PX),
        height=FINER * (camera.height + 2 * MARGIN_PX),
        fx=FINER * camera.fx,
        fy=FINER * camera.fy,
        cx=FINER * (camera.cx + MARGIN_PX),
        cy=FINER * (camera.cy + MARGIN_PX),
    )
    ideal = draw(wide, inverse_transform(T_world_camera))
    pixels = np.stack(np.meshgrid(np.arange(float(camera.width)), np.arange(float(camera.height))), axis=-1)
    # The middle of each pixel in the finer picture, which has its margin around.
    seen = FINER * (camera.lens.undistort(pixels) + MARGIN_PX)
    # The camera's lens and its compression: what sharpening is for.
    soft = cv2.GaussianBlur(ideal, (0, 0), 1.1 * FINER)
    return np.asarray(cv2.remap(soft, seen.astype(np.float32), None, cv2.INTER_LINEAR), np.uint8)  # type: ignore[call-overload]


def draw(camera: Camera, T_camera_world: FloatArray) -> Picture:
    """Board, wire, ring and tool, far things first."""
    picture = np.full((camera.height, camera.width, 3), (60, 34, 34), np.uint8)

    def seen(points_m: FloatArray) -> FloatArray:
        return points_m @ T_camera_world[:3, :3].T + T_camera_world[:3, 3]

    for row in range(-6, 6):
        for column in range(-7, 7):
            corners = SQUARE_M * np.array([[column, row], [column + 1, row], [column + 1, row + 1], [column, row + 1]])
            square = seen(np.c_[corners, np.zeros(4)])
            if square[:, 2].min() > 0.01:
                shade = (196, 150, 140) if (row + column) % 2 else (120, 74, 70)
                cv2.fillPoly(picture, [fixed(camera.project(square))], shade, cv2.LINE_AA, 4)
    share = np.linspace(0, 1, 200)
    line = seen(wire(share))
    centre, along = wire(np.array(RING_AT)), wire(np.array(RING_AT + 0.01)) - wire(np.array(RING_AT - 0.01))
    along /= np.linalg.norm(along)
    side = np.cross(along, [0.0, 0.0, 1.0])
    side /= np.linalg.norm(side)
    up = np.cross(side, along)
    angle = np.linspace(0, 2 * np.pi, 90)
    circle = centre + RING_RADIUS_M * (np.cos(angle)[:, None] * side + np.sin(angle)[:, None] * up)
    grip = centre + RING_RADIUS_M * up
    shaft = grip + np.linspace(0.006, 0.16, 40)[:, None] * (0.75 * up + 0.55 * side + 0.35 * along)
    jaws = np.linspace(0.0, 0.008, 6)[:, None] * (0.75 * up + 0.55 * side + 0.35 * along) + grip
    parts = [
        (line, 0.0022, WIRE),
        (seen(circle), 0.0016, RING),
        (seen(jaws), 0.003, (120, 122, 128)),
        (seen(shaft), 0.0084, TOOL),
    ]
    pieces = [
        (points[i : i + 2], width_m, colour)
        for points, width_m, colour in parts
        for i in range(len(points) - 1)
        if points[i : i + 2, 2].min() > 0.01
    ]
    for piece, width_m, colour in sorted(pieces, key=lambda entry: -float(entry[0][:, 2].mean())):
        depth = float(piece[:, 2].mean())
        red, green, blue = (round(value * min(1.15, 0.11 / depth)) for value in colour)
        ends = fixed(camera.project(piece))
        cv2.line(
            picture,
            ends[0].tolist(),
            ends[1].tolist(),
            (red, green, blue),
            max(1, round(camera.fx * width_m / depth)),
            16,
            4,
        )
    return picture


def fixed(pixels: FloatArray) -> np.ndarray:
    """OpenCV's drawing coordinates, with four fractional bits."""
    return np.round(16 * pixels).astype(np.int32)


if __name__ == "__main__":
    main()
