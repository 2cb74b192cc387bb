"""A dataset of a pair of needle drivers, small enough to be made for every test that wants one."""

from __future__ import annotations

import json
from collections.abc import Collection
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from surgbench.camera import Camera
from surgbench.dataset.manifest import MANIFEST_NAME, observations_path
from surgbench.dataset.masks import Mask, encode_image, encode_mask
from surgbench.dataset.open import open_as
from surgbench.dataset.storage import file_entry
from surgbench.dataset.tables import encode_table
from surgbench.files import sha256_file
from surgbench.geometry import FloatArray
from surgbench.instrument import load_instrument, save_instrument
from surgbench.silhouette import SilhouetteEvaluator
from surgbench.tasks.instrument.dataset import InstrumentDataset
from surgbench.tasks.instrument.format import (
    ARMS,
    IMAGE_KIND,
    InstrumentManifest,
    MaskKind,
    SequenceEntry,
    clean_mask_path,
    observed_path,
    states_path,
    visibility_path,
)
from surgbench.tasks.instrument.tables import (
    KEYPOINT_COLUMNS,
    READING_COLUMNS,
    STATE_COLUMNS,
    VISIBILITY_COLUMNS,
    arm_columns,
)

CAMERA = Camera(width=88, height=62, fx=113.2, fy=113.1, cx=36.3, cy=29.4)
DRIVER = "large_needle_driver"
FRAMES = 4
DT_S = 0.1
# Shafts from the left and from the right; they move a little, and some angle of each is negative.
FIRST = {
    "left": np.array([0.3, 0.4, 0.8, -0.012, 0.0, 0.13, 0.3, -0.2, 0.3]),
    "right": np.array([-0.2, -2.5, -0.9, 0.02, 0.005, 0.14, -0.1, 0.4, 0.1]),
}
STEP = np.array([0.01, 0.02, -0.01, 0.001, 0.0005, -0.001, 0.02, -0.03, 0.01])


def states_of(arm: str, frames: int = FRAMES, sequence: int = 0) -> FloatArray:
    """``(frames, 9)``."""
    states: FloatArray = FIRST[arm] + STEP * (np.arange(frames)[:, None] + 3 * sequence)
    return states


def paint(mask: Mask) -> NDArray[np.uint8]:
    """White instruments on dark red, ``(height, width, 3)`` RGB."""
    picture = np.zeros((*mask.shape, 3), np.uint8)
    picture[..., 0] = 60
    picture[mask] = 220
    return picture


def make_pair(
    root: Path,
    *,
    truth: bool = True,
    frames: int = FRAMES,
    sequences: int = 2,
    name: str = "pairs",
    visible: tuple[MaskKind, ...] = (),
    hidden: Collection[int] | None = None,
    steps: tuple[int, ...] | None = None,
    images: bool = False,
) -> InstrumentDataset:
    """Pairs whose masks are the silhouettes of their states, uncorrupted, with tips and readings.

    The left arm is taken to be in front in masks of what is ``visible``. In frames that are ``hidden`` so are the right
    arm's wrist and jaws, by the table of visibility alone. Frames follow one another, or are those of ``steps``, with
    gaps between them. Images, where they are wanted, show both arms (:func:`paint`).
    """
    driver = load_instrument(DRIVER)
    save_instrument(driver, root / f"instruments/{DRIVER}")
    alone, pair = SilhouetteEvaluator([driver], CAMERA), SilhouetteEvaluator([driver, driver], CAMERA)
    entries = []
    for number in range(sequences):
        id_ = f"{number:03d}"
        states = {arm: states_of(arm, frames, number) for arm in ARMS}
        for frame in range(frames):
            masks: dict[str, Mask] = {arm: alone.mask(states[arm][frame]) for arm in ARMS}
            masks |= {"both": pair.mask(np.concatenate([states[arm][frame] for arm in ARMS]))}
            seen = {"visible_left": masks["left"], "visible_right": masks["right"] & ~masks["left"]}
            masks |= {kind: seen[kind] for kind in visible}
            for kind, mask in masks.items():
                _put(root / observed_path(id_, kind, frame), encode_mask(mask))
                if truth:
                    _put(root / clean_mask_path(id_, kind, frame), encode_mask(mask))
            if images:
                _put(root / observed_path(id_, IMAGE_KIND, frame), encode_image(paint(masks["both"])))
        columns: dict[str, FloatArray] = {"timestamp_s": DT_S * np.array(steps or range(frames), dtype=np.float64)}
        for arm in ARMS:
            tips = CAMERA.project(driver.tips_cam(states[arm])).reshape(-1, 4)
            columns |= dict(zip(arm_columns(arm, KEYPOINT_COLUMNS), tips.T, strict=True))
            columns |= dict(zip(arm_columns(arm, READING_COLUMNS), states[arm][:, 6:].T, strict=True))
        _put(root / observations_path(id_), encode_table(columns))
        if truth:
            true = {c: v for arm in ARMS for c, v in zip(arm_columns(arm, STATE_COLUMNS), states[arm].T, strict=True)}
            _put(root / states_path(id_), encode_table(true))
        if hidden is not None:
            shares = {f"{arm}_{name}": np.ones(frames) for arm in ARMS for name in VISIBILITY_COLUMNS}
            shares |= {
                f"{arm}_{name}": np.full(frames, v) for arm in ARMS for name, v in (("front", 0.5), ("swapped", 0))
            }
            shares["right_tool_visible"][list(hidden)] = 0.0
            _put(root / visibility_path(id_), encode_table(shares))
        entries.append(
            SequenceEntry(
                id=id_,
                frames=frames,
                dt_s=DT_S,
                camera="camera",
                arms=ARMS,
                instruments={arm: DRIVER for arm in ARMS},
                kinds=("left", "right", "both", *visible),
                keypoints=True,
                readings=True,
                truth=truth,
                images=images,
                visibility=hidden is not None,
            )
        )
    paths = [path for path in root.rglob("*") if path.is_file()]
    manifest = InstrumentManifest.model_validate(
        {
            "format": "surgbench-dataset-1",
            "name": name,
            "created_by": "test",
            "origin": "generated" if truth else "imported",
            "configuration": {},
            "cameras": {"camera": CAMERA},
            "instruments": {DRIVER: f"instruments/{DRIVER}/instrument.yaml"},
            "sequences": tuple(entries),
            "files": {
                path.relative_to(root).as_posix(): {"bytes": path.stat().st_size, "sha256": sha256_file(path)}
                for path in paths
            },
        }
    )
    (root / "dataset.json").write_bytes(manifest.to_bytes())
    return open_as(InstrumentDataset, root)


def _put(path: Path, data: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)


def list_anew(root: Path) -> None:
    """Put what the files of a dataset hold now into its manifest: it was made so."""
    path = root / MANIFEST_NAME
    manifest = json.loads(path.read_text())
    manifest["files"] = {
        name: file_entry((root / name).read_bytes()).model_dump(mode="json") for name in manifest["files"]
    }
    path.write_text(json.dumps(manifest))
