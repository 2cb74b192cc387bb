"""SurgPose's layout, made small."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import yaml
from others import HEIGHT, WIDTH, grey, put_video

FRAMES = 5
CALIBRATION = f"""\
[StereoLeft]
res_x={WIDTH}
res_y={HEIGHT}
fc_x=80.0
fc_y=81.0
cc_x=31.5
cc_y=23.5
kc_0={{k1}}
kc_1=0.0
kc_2=0.0
kc_3=0.0
kc_4=0.0
kc_5=0.0
kc_6=0.0
kc_7=0.0

[StereoRight]
res_x={WIDTH}
res_y={HEIGHT}
fc_x=90.0
fc_y=91.0
cc_x=30.5
cc_y=22.5
kc_0=0.0
kc_1=0.0
kc_2=0.0
kc_3=0.0
R_0=1.0
R_1=0.0
R_2=0.0
R_3=0.0
R_4=1.0
R_5=0.0
R_6=0.0
R_7=0.0
R_8=1.0
T_0=-5.5
T_1=0.1
T_2=0.0
"""


def joints_of(arm: str, frame: int) -> list[float]:
    sign = 1.0 if arm == "PSM1" else -1.0
    return [0.1, 0.2, 0.15, -2.8, sign * (0.3 + 0.01 * frame), sign * (-0.2 - 0.02 * frame)]


def point_of(identity: int, frame: int, eye: str = "left") -> list[float]:
    return [2.0 * identity + frame + (1.0 if eye == "right" else 0.0), 10.0 + identity]


def jaws_of(arm: str, count: int = FRAMES) -> list[float]:
    return [(0.4 if arm == "PSM1" else 0.2) + 0.1 * (frame + FRAMES - count) for frame in range(count)]


def put_trajectory(folder: Path, *, k1: float = 0.0, fps: float = 30.0) -> None:
    """All but the jaw; what nobody reads is there too."""
    folder.mkdir(parents=True)
    (folder / "StereoCalibrationDVRK.ini").write_text(CALIBRATION.format(k1=k1))
    for eye in ("left", "right"):
        put_video(folder / f"regular/{eye}_video.avi", map(grey, range(FRAMES)), fps=fps)
        (folder / f"regular/{eye}_video.avi").rename(folder / f"regular/{eye}_video.mp4")  # whatever is in it
        points: dict[int, Any] = {
            frame: {identity: point_of(identity, frame, eye) for identity in (*range(1, 6), *range(8, 13))}
            for frame in range(FRAMES)
        }
        points[1][4] = None
        points[2][6] = point_of(6, 2, eye)
        (folder / f"keypoints_{eye}.yaml").write_text(yaml.safe_dump(points))
    read = {str(frame): {arm: joints_of(arm, frame) for arm in ("PSM1", "PSM3")} for frame in range(FRAMES)}
    (folder / "api_jp_data.yaml").write_text(yaml.safe_dump(read))
    pose = {"R": [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0], "t": [0.0, 0.0, 0.1]}
    poses = {str(frame): {"PSM1": pose, "PSM3": pose} for frame in range(FRAMES)}
    (folder / "api_cp_data.yaml").write_text(yaml.safe_dump(poses))
    for eye in ("left", "right"):
        boxes = {str(frame): {"1": [1, 2, 30, 20], "2": None} for frame in range(FRAMES)}
        (folder / f"bbox_{eye}.json").write_text(json.dumps(boxes))


def put_jaw(path: Path, content: object) -> None:
    path.write_text(yaml.safe_dump(content))
