"""The format of the BOP benchmark: one object per link, millimetres; poses, masks, models, results.

An instrument has joints and BOP's objects have none, so that each of its links is an object, and the joints stand
beside (``scene_joints.json``). The 180-degree twin is not a symmetry of any object: it turns the shaft, moves the
joints and puts each jaw where the other one was. It is a second set of poses, ``scene_gt_twin.json``, of instruments
that have a twin. A tube's turn about its axis is a continuous symmetry of its models.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any, ClassVar

import cv2
import numpy as np

from surgbench.contract import Mask, Plugin
from surgbench.exchange.exporters.bop_models import BopObject, objects_of, write_models
from surgbench.exporting import Material
from surgbench.geometry import FloatArray
from surgbench.silhouette import VisibilityEvaluator
from surgbench.state import twin
from surgbench.tasks.instrument.dataset import InstrumentDataset, Sequence
from surgbench.tasks.instrument.exported import dataset_of, frames_in, rows_in, with_truth
from surgbench.tasks.instrument.format import Arm
from surgbench.tasks.instrument.tracks import Row, Track, truth_tracks

SPLIT = "test"
ABOUT = """\
# {name} in the format of BOP

Made by surgbench from the dataset {sha256}.

- Every link of an instrument that has a body is an object; `models/objects.json` says which. Lengths are millimetres.
  Models have their origin in the centre of their bounding box; `link_from_model_mm` in `objects.json` is where that
  is in the link's frame.
- `scene_joints.json`: of every image and arm the sequence, arm, and state [alpha, beta, gamma, x, y, z, q1, q2, q3]
  (radians, metres) that all poses of its links follow from.
- `scene_gt_twin.json`, `scene_joints_twin.json`: the state turned by 180 degrees about the shaft with q1 and q2
  reversed, whose silhouette is nearly the same. It is a second set of poses, not a symmetry: joints differ, and each
  jaw is where the other one was. Instruments without a twin stand in it as they are; where none has one it is left out.
- `mask`: silhouette of a link as if it were alone; `mask_visib`: what no other link hides, of any arm.
- `{pictures}`: {what}.
"""


class BopExporter(Plugin):
    """A dataset with its truth, or the estimates of runs as result files."""

    name: ClassVar[str] = "bop"
    summary: ClassVar[str] = "BOP: an object per link, poses, masks and models in mm, joints beside; of runs, results"

    def count(self, material: Material) -> int:
        """Frames."""
        dataset = dataset_of(material)
        if dataset is not None:
            with_truth(dataset, "BOP")
        return frames_in(material)

    def write(self, material: Material, folder: Path, progress: Callable[[float], None]) -> None:
        """Write the scenes, or a file of results per row."""
        dataset = dataset_of(material)
        if dataset is not None:
            _write_dataset(with_truth(dataset, "BOP"), folder, progress)
            return
        for row in rows_in(material):
            _write_results(row, folder, progress)


def _write_dataset(dataset: InstrumentDataset, folder: Path, progress: Callable[[float], None]) -> None:
    objects = objects_of(dataset)
    write_models(folder / "models", objects)
    targets: list[dict[str, int]] = []
    pictures = "rgb" if all(sequence.entry.images for sequence in dataset.sequences) else "gray"
    for place, group in groupby(truth_tracks(dataset), key=lambda track: track.place):
        tracks, sequence = list(group), dataset.sequences[place]
        targets += _write_scene(sequence, tracks, objects, folder / SPLIT / f"{place:06d}", pictures, progress)
    camera = dataset.sequences[0].camera
    own = {key: getattr(camera, key) for key in ("cx", "cy", "fx", "fy", "height", "width")}
    _write_json(folder / "camera.json", {**own, "depth_scale": 1.0})
    _write_json(folder / "test_targets_bop19.json", targets)
    what = "the camera's pictures" if pictures == "rgb" else "the observed mask of all arms; there are no pictures"
    text = ABOUT.format(name=dataset.name, sha256=dataset.hash, pictures=pictures, what=what)
    (folder / "dataset_info.md").write_text(text, encoding="utf-8")


@dataclass(frozen=True)
class _Instance:
    """A link of an arm."""

    object: BopObject
    track: Track


def _write_scene(
    sequence: Sequence,
    tracks: list[Track],
    objects: list[BopObject],
    folder: Path,
    pictures: str,
    progress: Callable[[float], None],
) -> list[dict[str, int]]:
    """Write a sequence; returns what there is to be found in it, for the list of targets."""
    for name in ("mask", "mask_visib", pictures):
        (folder / name).mkdir(parents=True)
    instances = [
        _Instance(one, track) for track in tracks for one in objects if one.instrument.name == track.instrument.name
    ]
    visibility = VisibilityEvaluator([instance.object.alone for instance in instances], sequence.camera)
    cameras: dict[str, Any] = {}
    infos: dict[str, list[dict[str, Any]]] = {}
    for frame in range(sequence.frames):
        cameras[str(frame)] = {"cam_K": sequence.camera.matrix.ravel().tolist(), "depth_scale": 1.0}
        states = np.concatenate([instance.track.states[frame] for instance in instances])
        infos[str(frame)] = []
        layers = zip(visibility.silhouettes(states), visibility.visible_masks(states), strict=True)
        for number, (whole, visible) in enumerate(layers):
            name = f"{frame:06d}_{number:06d}.png"
            _write_mask(folder / "mask" / name, whole)
            _write_mask(folder / "mask_visib" / name, visible)
            infos[str(frame)].append(_info(whole, visible))
        _write_picture(folder / pictures / f"{frame:06d}.png", sequence, [track.arm for track in tracks], frame)
        progress(len(tracks))
    _write_json(folder / "scene_camera.json", cameras)
    _write_json(folder / "scene_gt_info.json", infos)
    for ending, change in (("", _own), ("_twin", _turned)):
        if ending and not any(track.instrument.symmetry == "twin" for track in tracks):
            continue
        poses = [instance.object.poses(change(instance.track)) for instance in instances]
        _write_json(
            folder / f"scene_gt{ending}.json",
            {
                str(frame): [_pose(one.object, pose[frame]) for one, pose in zip(instances, poses, strict=True)]
                for frame in range(sequence.frames)
            },
        )
        joints = {
            str(frame): [
                {"sequence": track.sequence, "arm": track.arm, "state": change(track)[frame].tolist()}
                for track in tracks
            ]
            for frame in range(sequence.frames)
        }
        _write_json(folder / f"scene_joints{ending}.json", joints)
    place = tracks[0].place
    counts = {one.id: sum(instance.object.id == one.id for instance in instances) for one in objects}
    return [
        {"scene_id": place, "im_id": frame, "obj_id": obj_id, "inst_count": count}
        for frame in range(sequence.frames)
        for obj_id, count in counts.items()
        if count
    ]


def _own(track: Track) -> FloatArray:
    return track.states


def _turned(track: Track) -> FloatArray:
    """States of the twins, of an instrument that has them."""
    return twin(track.states) if track.instrument.symmetry == "twin" else track.states


def _pose(one: BopObject, T_cam_model_mm: FloatArray) -> dict[str, Any]:
    return {
        "cam_R_m2c": T_cam_model_mm[:3, :3].ravel().tolist(),
        "cam_t_m2c": T_cam_model_mm[:3, 3].tolist(),
        "obj_id": one.id,
    }


def _info(whole: Mask, visible: Mask) -> dict[str, Any]:
    every, seen = int(whole.sum()), int(visible.sum())
    return {
        "bbox_obj": _box(whole),
        "bbox_visib": _box(visible),
        "px_count_all": every,
        "px_count_valid": every,  # there is no depth that could be missing
        "px_count_visib": seen,
        "visib_fract": seen / every if every else 0.0,
    }


def _box(mask: Mask) -> list[int]:
    """Left, top, width and height; -1 of an empty mask, as in BOP."""
    if not mask.any():
        return [-1, -1, -1, -1]
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    left, top = int(columns[0]), int(rows[0])
    return [left, top, int(columns[-1]) - left + 1, int(rows[-1]) - top + 1]


def _write_mask(path: Path, mask: Mask) -> None:
    path.write_bytes(cv2.imencode(".png", mask.astype(np.uint8) * 255)[1].tobytes())


def _write_picture(path: Path, sequence: Sequence, arms: list[Arm], frame: int) -> None:
    """The camera's picture, or the mask that was observed."""
    source = sequence.image_path(frame)
    if path.parent.name == "rgb" and source is not None:
        path.write_bytes(source.read_bytes())
        return
    kinds = ["both"] if "both" in sequence.entry.kinds else [arm for arm in arms if arm in sequence.entry.kinds]
    _write_mask(path, np.logical_or.reduce([sequence.mask(kind, frame) for kind in kinds]))


def _write_results(row: Row, folder: Path, progress: Callable[[float], None]) -> None:
    """``METHOD_DATASET-test.csv``: of every image the estimated pose of every link.

    The time of an image is that of all its arms, in seconds, and -1 where it is not known.
    """
    objects, tracks = objects_of(row.dataset), row.tracks()
    times = _image_times(tracks, {track.sequence for track in tracks if len(row.records[0].spec.arms) == 2})
    lines = ["scene_id,im_id,obj_id,score,R,t,time"]
    for track in sorted(tracks, key=lambda track: track.place):
        poses = [(one, one.poses(track.states)) for one in objects if one.instrument.name == track.instrument.name]
        assert track.confidence is not None
        for place, frame in enumerate(track.frames.tolist()):
            for one, pose in poses:
                turn, where = _numbers(pose[place, :3, :3]), _numbers(pose[place, :3, 3])
                score, time_s = track.confidence[place], times[track.sequence, frame]
                lines.append(f"{track.place},{frame},{one.id},{float(score)!r},{turn},{where},{time_s!r}")
        progress(len(track.frames))
    # BOP reads the method, the dataset and the split from the name, by these signs.
    method, dataset = row.name.replace("_", "-"), row.dataset.name.replace("_", "").replace("-", "")
    (folder / f"{method}_{dataset}-{SPLIT}.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")


def _image_times(tracks: list[Track], pairs: set[str]) -> dict[tuple[str, int], float]:
    """Seconds by sequence and frame: of arms that were tracked on their own the sum, of a pair once."""
    times: dict[tuple[str, int], float] = {}
    for track in tracks:
        assert track.latency_ms is not None
        for frame, latency_ms in zip(track.frames.tolist(), track.latency_ms.tolist(), strict=True):
            key = (track.sequence, frame)
            times[key] = 1e-3 * latency_ms + (0.0 if track.sequence in pairs else times.get(key, 0.0))
    return {key: -1.0 if np.isnan(time_s) else time_s for key, time_s in times.items()}


def _numbers(values: FloatArray) -> str:
    return " ".join(repr(value) for value in values.ravel().tolist())


def _write_json(path: Path, content: Any) -> None:
    """A line per image, as BOP's own writer does, so that files can be compared."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if isinstance(content, dict):
        body = ",\n".join(f"  {json.dumps(key)}: {json.dumps(value)}" for key, value in content.items())
        path.write_text(f"{{\n{body}\n}}\n", encoding="utf-8")
    else:
        path.write_text("[\n" + ",\n".join(f"  {json.dumps(one)}" for one in content) + "\n]\n", encoding="utf-8")
