"""COCO: masks as run-length codes and tips as keypoints, of datasets as annotations and of runs as results."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, ClassVar

import cv2
import numpy as np

from surgbench.contract import Mask, Plugin
from surgbench.exporting import Material
from surgbench.geometry import FloatArray
from surgbench.silhouette import SilhouetteEvaluator
from surgbench.tasks.instrument.dataset import InstrumentDataset, Sequence
from surgbench.tasks.instrument.exported import dataset_of, frames_in, rows_in
from surgbench.tasks.instrument.format import ARMS, Arm, frame_name
from surgbench.tasks.instrument.tracks import Row

ABOUT = (
    "Made by surgbench. Masks show each arm as if the other were not there; 'arm' says which. Pixel centres are whole "
    "numbers. Tips of recordings are in no particular order."
)
PAIR = "both"
# Of the two tips, where no marked points are they.
TIPS = ("tip1", "tip2")


class CocoExporter(Plugin):
    """``annotations.json`` and ``images/`` of a dataset; of runs a list of results each."""

    name: ClassVar[str] = "coco"
    summary: ClassVar[str] = "COCO: masks as RLE, tips as keypoints, pictures; of runs, results on the same image ids"

    def count(self, material: Material) -> int:
        """Frames."""
        return frames_in(material)

    def write(self, material: Material, folder: Path, progress: Callable[[float], None]) -> None:
        """Write annotations, or a file of results per row."""
        dataset = dataset_of(material)
        if dataset is not None:
            _write_dataset(dataset, folder, progress)
            return
        for row in rows_in(material):
            results = list(_results(row, progress))
            (folder / f"{row.name}.json").write_text(_lines(results) + "\n", encoding="utf-8")


def encode_rle(mask: Mask) -> dict[str, Any]:
    """COCO's compressed run-length code of a mask: runs go down the columns, the first is of background.

    Each run is told as its difference from the one before the last, in groups of five bits with a sixth for "more
    follows", as characters from 48 on.

    Args:
        mask: ``(height, width)`` bool.

    Returns:
        ``size`` (height, width) and ``counts``.
    """
    flat = mask.ravel(order="F")
    bounds = np.concatenate([[0], np.flatnonzero(flat[1:] != flat[:-1]) + 1, [flat.size]])
    runs = np.diff(bounds).tolist()
    if flat[0]:
        runs.insert(0, 0)
    text = []
    for place, run in enumerate(runs):
        left = run - runs[place - 2] if place > 2 else run
        more = True
        while more:
            bits = left & 31
            left >>= 5
            more = left != (-1 if bits & 16 else 0)
            text.append(chr(48 + (bits | 32 if more else bits)))
    return {"size": list(mask.shape), "counts": "".join(text)}


def _image_ids(dataset: InstrumentDataset) -> dict[str, int]:
    """Of each sequence the id of its first image; the others follow. Ids begin with 1."""
    firsts, following = {}, 1
    for sequence in dataset.sequences:
        firsts[sequence.id] = following
        following += sequence.frames
    return firsts


def _categories(dataset: InstrumentDataset) -> dict[str, int]:
    return {name: number for number, name in enumerate(sorted(dataset.manifest.instruments), start=1)}


def _write_dataset(dataset: InstrumentDataset, folder: Path, progress: Callable[[float], None]) -> None:
    firsts, categories, names = _image_ids(dataset), _categories(dataset), _names(dataset)
    images: list[dict[str, Any]] = []
    annotations: list[dict[str, Any]] = []
    for sequence in dataset.sequences:
        (folder / "images" / sequence.id).mkdir(parents=True)
        points = {arm: _points_of(dataset, sequence, arm, names) for arm in sequence.arms}
        shown = _shown(sequence)
        for frame in range(sequence.frames):
            image_id, name = firsts[sequence.id] + frame, f"images/{sequence.id}/{frame_name(frame)}"
            picture = _picture(sequence, frame)
            if picture is not None:
                (folder / name).write_bytes(picture)
            size = {"width": sequence.camera.width, "height": sequence.camera.height}
            when = {"frame": frame, "timestamp_s": float(sequence.timestamps_s[frame])}
            images.append({"id": image_id, "file_name": name, **size, "sequence": sequence.id, **when})
            for kind, arm in shown:
                seen = points[arm][frame] if kind == arm else np.zeros((len(names), 3))
                shape = _shape_in(sequence, kind, frame, seen)
                if shape is not None:
                    category = categories[sequence.entry.instruments[arm]]
                    head = {"id": len(annotations) + 1, "image_id": image_id, "category_id": category, "iscrowd": 0}
                    annotations.append({**head, **shape, **_keypoints(seen), "arm": kind})
        progress(sequence.frames * len(sequence.arms))
    cameras = {sequence.camera for sequence in dataset.sequences}
    if len(cameras) == 1:  # COCO has no place for it; so the importer finds it
        (folder / "camera.json").write_text(cameras.pop().model_dump_json(indent=1) + "\n", encoding="utf-8")
    info = {"description": f"{dataset.name}: {ABOUT}", "version": dataset.hash}
    named = [
        {"id": number, "name": name, "supercategory": "instrument", "keypoints": names, "skeleton": []}
        for name, number in categories.items()
    ]
    parts = [f'"info": {json.dumps(info)}', '"licenses": []', f'"categories": {_lines(named)}']
    parts += [f'"images": {_lines(images)}', f'"annotations": {_lines(annotations)}']
    (folder / "annotations.json").write_text("{" + ",\n".join(parts) + "}\n", encoding="utf-8")


def _results(row: Row, progress: Callable[[float], None]) -> Iterator[dict[str, Any]]:
    """What a row estimated, silhouettes and tips, arm by arm."""
    firsts, categories = _image_ids(row.dataset), _categories(row.dataset)
    further = len(_names(row.dataset)) - len(TIPS)
    for track in row.tracks():
        evaluator = SilhouetteEvaluator([track.instrument], track.camera)
        tips = track.camera.project(track.instrument.tips_cam(track.states))
        sequence = row.dataset.sequence(track.sequence)
        assert track.confidence is not None
        for place, frame in enumerate(track.frames.tolist()):
            head = {"image_id": firsts[track.sequence] + frame, "category_id": categories[track.instrument.name]}
            mask = evaluator.mask(track.states[place])
            points = _keypoints(np.pad(_flagged(sequence, tips[place], 2), ((0, further), (0, 0))))
            yield {**head, **_shape(mask), **points, "score": float(track.confidence[place]), "arm": track.arm}
            progress(1)


def _names(dataset: InstrumentDataset) -> list[str]:
    """Of all keypoints: the two tips, then the points that somebody marked; tips that are among these are called so."""
    labels = list(dict.fromkeys(label for sequence in dataset.sequences for label in sequence.entry.labels))
    marked = _marked_tips(dataset, labels)
    return [*marked, *(label for label in labels if label not in marked)]


def _marked_tips(dataset: InstrumentDataset, labels: list[str]) -> list[str]:
    """The two labels that tips are, wherever there is one; else names of their own."""
    found = []
    for tip, own in enumerate(TIPS):
        same = set(labels)
        for sequence in dataset.sequences:
            for arm in sequence.arms:
                points, by_label = sequence.keypoints(arm)[:, tip], sequence.labels(arm)
                known = ~np.isnan(points).any(axis=1)
                if known.any():
                    same &= {label for label, at in by_label.items() if np.array_equal(at[known], points[known])}
        found.append(next((label for label in labels if label in same), own))
    return found if len(set(found)) == len(TIPS) and not set(TIPS) & {*found} else list(TIPS)


def _points_of(dataset: InstrumentDataset, sequence: Sequence, arm: Arm, names: list[str]) -> FloatArray:
    """``(frames, keypoints, 3)``: u, v, and 2; 1 where a tip is marked and not seen; zeros where there is none."""
    labels = sequence.labels(arm)
    points = np.zeros((sequence.frames, len(names), 3))
    for place, name in enumerate(names):
        if name in labels:
            points[:, place] = _flagged(sequence, labels[name], 2 if place >= len(TIPS) else 1)
    tips = _tips(dataset, sequence, arm)
    for tip in range(len(TIPS)):
        seen = _flagged(sequence, tips[:, tip], 2)
        points[:, tip] = np.where(seen[:, 2:] > 0, seen, points[:, tip])
    return points


def _tips(dataset: InstrumentDataset, sequence: Sequence, arm: Arm) -> FloatArray:
    """``(frames, 2, 2)`` pixels, the true ones where they are known."""
    states = sequence.states(arm)
    if states is None:
        return sequence.keypoints(arm)
    return sequence.camera.project(dataset.instrument(sequence.entry.instruments[arm]).tips_cam(states))


def _flagged(sequence: Sequence, points: FloatArray, flag: int) -> FloatArray:
    """``(..., 3)`` of ``(..., 2)``: u, v and the flag of points in the picture, zeros of any other."""
    inside = sequence.camera.contains(np.nan_to_num(points, nan=-1e9))
    return np.where(inside[..., None], np.concatenate([points, np.full((*points.shape[:-1], 1), flag)], axis=-1), 0.0)


def _keypoints(points: FloatArray) -> dict[str, Any]:
    """``(keypoints, 3)`` as annotations have them."""
    numbers = [value for *place, flag in points.tolist() for value in (*place, int(flag))]
    return {"keypoints": numbers, "num_keypoints": int((points[:, 2] > 0).sum())}


def _shown(sequence: Sequence) -> list[tuple[str, Arm]]:
    """What is annotated: each arm, or the pair where there is only one mask of both."""
    own = set(sequence.entry.kinds) & set(ARMS)
    if PAIR in sequence.entry.kinds and not own:
        return [(PAIR, sequence.arms[0])]
    return [(arm, arm) for arm in sequence.arms]


def _shape_in(sequence: Sequence, kind: str, frame: int, points: FloatArray) -> dict[str, Any] | None:
    """Code, area and box of a mask; without masks the points' box, and no code. ``None`` where nothing is seen."""
    if kind in sequence.entry.kinds:
        mask = (sequence.clean_mask if sequence.entry.truth else sequence.mask)(kind, frame)
        return _shape(mask) if mask.any() else None
    there = points[points[:, 2] > 0, :2]
    if not len(there):
        return None
    (left, top), (width, height) = there.min(axis=0).tolist(), np.ptp(there, axis=0).tolist()
    return {"segmentation": [], "area": width * height, "bbox": [left, top, width, height]}


def _shape(mask: Mask) -> dict[str, Any]:
    """Code, area and box (left, top, width, height) of a mask."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    box = [0, 0, 0, 0]
    if rows.size:
        left, top = int(columns[0]), int(rows[0])
        box = [left, top, int(columns[-1]) - left + 1, int(rows[-1]) - top + 1]
    return {"segmentation": encode_rle(mask), "area": int(mask.sum()), "bbox": box}


def _picture(sequence: Sequence, frame: int) -> bytes | None:
    """The camera's picture, or where there are none the observed mask of all arms; ``None`` where there is neither."""
    path = sequence.image_path(frame)
    if path is not None:
        return path.read_bytes()
    kinds = [PAIR] if PAIR in sequence.entry.kinds else [arm for arm in sequence.arms if arm in sequence.entry.kinds]
    if not kinds:
        return None
    mask = np.logical_or.reduce([sequence.mask(kind, frame) for kind in kinds])
    return cv2.imencode(".png", mask.astype(np.uint8) * 255)[1].tobytes()


def _lines(rows: list[dict[str, Any]]) -> str:
    """A JSON list, an item a line."""
    return "[\n" + ",\n".join(json.dumps(row) for row in rows) + "\n]"
