"""What sound files of each kind look like, and what reads them: for tests and ``benchmarks/fuzz_readers.py``."""

from __future__ import annotations

import functools
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import fabricate
import numpy as np
from small_dataset import CAMERA, FRAMES

from surgbench.camera.formats import read_stated
from surgbench.config import locate, read_yaml
from surgbench.dataset.masks import decode_image, decode_mask, encode_mask
from surgbench.dataset.open import open_dataset
from surgbench.dataset.tables import decode_table, encode_table
from surgbench.recordings.frame_table import read_frame_table
from surgbench.recordings.pose_table import read_pose_table
from surgbench.records.reader import read_record
from surgbench.viewpoint.arm_files import load_camera_arm


@functools.cache
def samples() -> dict[str, bytes]:
    """What sound files of each kind look like."""
    mask = np.zeros((CAMERA.height, CAMERA.width), bool)
    mask[20:40, 30:] = True
    return {
        "dataset.json": b'{"format": "surgbench-dataset-1", "task": "instrument", "name": "a", "files": {}}',
        "record.json": json.dumps(fabricate.as_written(fabricate.record(frames=2))).encode(),
        "mask.png": encode_mask(mask),
        "table.parquet": encode_table({"a": np.arange(FRAMES) / 3, "b": np.full(FRAMES, np.nan)}),
        "camera.json": b'{"width": 88, "height": 62, "fx": 113.2, "fy": 113.1, "cx": 36.3, "cy": 29.4}',
        "camera.yaml": b"image_width: 88\nimage_height: 62\ncamera_matrix: {data: [9, 0, 3, 0, 9, 2, 0, 0, 1]}\n",
        "file.yaml": b"a: &x [1, 2.5, 2026-01-01]\nb: {c: *x, d: !!binary aGFsbG8=}\n",
        "poses.csv": b"t,x,y,z,qx,qy,qz,qw\n0.0,1,2,3,0,0,0,1\n0.1,1,2,3.5,0,0,0,1\n",
        "frames.csv": b"frame,u [px],v [px]\n0,12.5,30\n1,,\n",
        "arm.yaml": locate("camera_arms", "camera arm", "psm_classic").read_bytes(),
    }


READERS: dict[str, Callable[[Path, bytes], Any]] = {
    "dataset.json": lambda path, data: open_dataset(path.parent),
    "record.json": lambda path, data: read_record(path),
    "mask.png": lambda path, data: (decode_mask(data, "x", 88, 62), decode_image(data, "x", 88, 62)),
    "table.parquet": lambda path, data: decode_table(data, "x", FRAMES, ["a", "b"]),
    "camera.json": lambda path, data: read_stated(path),
    "camera.yaml": lambda path, data: read_stated(path),
    "file.yaml": lambda path, data: read_yaml(path, "any"),
    "poses.csv": lambda path, data: read_pose_table(path),
    "frames.csv": lambda path, data: read_frame_table(path, "0,1,2"),
    "arm.yaml": lambda path, data: load_camera_arm(path),
}
