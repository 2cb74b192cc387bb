"""How exactly the stereo camera is calibrated from rendered pictures of the authors' checkerboard.

    python benchmarks/stereo_calibration.py

Prints Markdown: parameters as they are and as they are found from pairs of pictures, how far apart both see the same
rays, and what the errors are.
"""

from __future__ import annotations

import argparse

import numpy as np

from surgbench.geometry import rotation_angle
from surgbench.viewpoint.optics.calibration import board_poses, calibrate, displacement_px, photograph_board
from surgbench.viewpoint.optics.grasp_object import Checkerboard
from surgbench.viewpoint.optics.stereo import AUTOCAM_STEREO

BOARD = Checkerboard()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pairs", type=int, default=42)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    rng = np.random.default_rng(options.seed)
    poses = board_poses(AUTOCAM_STEREO, BOARD, options.pairs, rng)
    found = calibrate(photograph_board(AUTOCAM_STEREO, BOARD, poses, rng), BOARD, AUTOCAM_STEREO)
    print(f"{options.pairs} pairs rendered (seed {options.seed}), the board found in both pictures of {found.pairs}.\n")
    print("| | left: true | found | right: true | found |\n|---|---|---|---|---|")
    columns = AUTOCAM_STEREO.left, found.cameras.left, AUTOCAM_STEREO.right, found.cameras.right
    for name in ("fx", "fy", "cx", "cy"):
        print(f"| {name} (px) | " + " | ".join(f"{getattr(camera, name):.2f}" for camera in columns) + " |")
    for index, name in enumerate(("k1", "k2", "p1", "p2", "k3")):
        print(f"| {name} | " + " | ".join(f"{camera.distortion[index]:.4f}" for camera in columns) + " |")
    apart = [displacement_px(true, seen) for true, seen in (columns[:2], columns[2:])]
    for name, number in (("mean", np.mean), ("largest", np.max)):
        cells = " | ".join(f"| {number(one):.2f}" for one in apart)
        print(f"| same ray seen apart, {name} (px) | {cells} |")
    print(f"| reprojection, rms (px) | | {found.left_rms_px:.3f} | | {found.right_rms_px:.3f} |")
    turned = np.degrees(rotation_angle(found.cameras.T_left_right[:3, :3]))
    print(
        f"\nBoth: baseline {1e3 * found.cameras.baseline_m:.2f} mm (true {1e3 * AUTOCAM_STEREO.baseline_m:.2f}), "
        f"turned by {turned:.3f}° (true 0), reprojection {found.stereo_rms_px:.3f} px."
    )


if __name__ == "__main__":
    main()
