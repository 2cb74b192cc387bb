"""Exports of datasets that lack something (masks, pictures, truth, frames) or have an auxiliary view."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import others
import pandas as pd
import pytest
from commandline import surgbench
from surgpose_folder import put_trajectory

from surgbench.dataset.open import open_as
from surgbench.tasks.instrument.dataset import InstrumentDataset
from surgbench.tasks.instrument.format import ARMS


def export(source: Path, format_: str, out: Path) -> Path:
    surgbench("export", source, "--format", format_, "--out", out)
    return out


def load(path: Path) -> Any:
    return json.loads(path.read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def points(tmp_path_factory: pytest.TempPathFactory) -> InstrumentDataset:
    """Marked points alone: neither masks nor pictures; the right tool is not seen in the last frame."""
    root = tmp_path_factory.mktemp("points")
    left = [
        {"class": f"{side}ClasperPoint", "id": "a", "x": 3.0 + at, "y": 4.0}
        for at, side in enumerate(["Left", "Right"])
    ]
    right = [{"class": "ShaftPoint", "id": "b", "x": 40.5, "y": 9.0}]
    shaft = [{"class": "ShaftPoint", "id": "a", "x": 1.0, "y": 9.0}]
    pictures = [{"filename": f"f{k}.png", "annotations": [*left, *shaft, *(right if k < 2 else [])]} for k in range(3)]
    others.put_camera(root / "ev")
    path = others.put_json(root / "ev/labels.json", pictures)
    surgbench("import", "endovis", path, "--out", root / "data")
    return open_as(InstrumentDataset, root / "data")


@pytest.fixture(scope="module")
def stereo(tmp_path_factory: pytest.TempPathFactory) -> InstrumentDataset:
    """Frames 0, 2 and 4 of two arms, with labels and an auxiliary view."""
    root = tmp_path_factory.mktemp("stereo")
    put_trajectory(root / "SurgPose/000000")
    for eye in ("left", "right"):
        for arm, top in (("PSM1", 8), ("PSM3", 30)):
            for frame in (0, 2, 4):
                mask = 255 * others.bar(frame, top).astype(np.uint8)
                others.put(root / f"{eye}/000000/{arm}/{frame:05d}.png", mask)
    masks = ("--masks", root / "left", "--other-masks", root / "right")
    surgbench("import", "surgpose", root / "SurgPose", *masks, "--out", root / "data")
    return open_as(InstrumentDataset, root / "data")


@pytest.mark.parametrize("name", ["points", "stereo"])
def test_coco_of_points_and_of_frames_that_lack_comes_back(
    name: str, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    dataset: InstrumentDataset = request.getfixturevalue(name)
    (before,) = dataset.sequences
    out = export(dataset.path, "coco", tmp_path / "out")
    content = load(out / "annotations.json")
    assert len(content["annotations"]) == (6 if name == "stereo" else 5)
    (left, top, width, height), points = (content["annotations"][0][key] for key in ("bbox", "keypoints"))
    if name == "points":
        assert not list((out / "images").rglob("*.png"))
        assert content["annotations"][0]["segmentation"] == []
        assert (left, top, width, height) == (1.0, 4.0, 3.0, 5.0)
    assert len(points) == 3 * len(content["categories"][0]["keypoints"])
    others.put_camera(out, before.camera)
    tips = () if name == "stereo" else ("--tips", "left_clasper,right_clasper")
    (after,) = others.imported("coco", out, *tips, out=tmp_path / "again").sequences
    np.testing.assert_allclose(after.timestamps_s, before.timestamps_s)
    assert after.entry.kinds == before.entry.kinds
    for arm in ARMS:
        np.testing.assert_array_equal(after.keypoints(arm), before.keypoints(arm))
        labels = after.labels(arm)
        assert set(labels) == set(before.labels(arm))
        for label, values in before.labels(arm).items():
            np.testing.assert_array_equal(labels[label], values)
        for frame in range(before.frames) if before.entry.kinds else ():
            assert np.array_equal(after.mask(arm, frame), before.mask(arm, frame))


@pytest.mark.extras
@pytest.mark.filterwarnings("ignore")  # of pycocotools
def test_coco_of_points_is_read_by_pycocotools(points: InstrumentDataset, tmp_path: Path) -> None:
    pytest.importorskip("pycocotools")
    from pycocotools.coco import COCO
    from pycocotools.cocoeval import COCOeval

    out = export(points.path, "coco", tmp_path / "data")
    coco = COCO(str(out / "annotations.json"))
    results = [{**one, "score": 1.0} for one in load(out / "annotations.json")["annotations"] if one["num_keypoints"]]
    judge = COCOeval(coco, coco.loadRes(results), "keypoints")
    judge.params.kpt_oks_sigmas = np.full(3, 0.05)
    judge.evaluate()
    judge.accumulate()
    judge.summarize()
    assert judge.stats[0] == pytest.approx(1.0)


def test_csv_has_marked_points_and_all_joints(stereo: InstrumentDataset, tmp_path: Path) -> None:
    table = pd.read_csv(export(stereo.path, "csv", tmp_path / "out") / "observed.csv")
    (sequence,) = stereo.sequences
    right = table[table["arm"] == "right"]
    np.testing.assert_allclose(right["timestamp_s"], [0.0, 2 / 30, 4 / 30])
    np.testing.assert_allclose(right[["wrist_u_px", "wrist_v_px"]], sequence.labels("right")["wrist"])
    six = sequence.arm_joints("right")
    assert six is not None
    np.testing.assert_allclose(right["arm_insertion_m"], six[:, 2])
    assert right["q1_rad"].isna().all()


@pytest.mark.parametrize("name", ["points", "stereo"])
def test_croissant_names_every_file_once(name: str, tmp_path: Path, request: pytest.FixtureRequest) -> None:
    """But for the instrument's own; the sets of a dataset that lacks something are those that it has."""
    dataset: InstrumentDataset = request.getfixturevalue(name)
    content = load(export(dataset.path, "croissant", tmp_path / "out") / "croissant.json")
    sets = {one["@id"]: one["includes"] for one in content["distribution"] if one["@type"] == "cr:FileSet"}
    found = [path for includes in sets.values() for include in includes for path in dataset.path.glob(include)]
    every = [dataset.path / file for file in dataset.manifest.files if not file.startswith("instruments/")]
    assert sorted(found) == sorted(every)
    assert ("masks" in content["description"].partition(";")[0]) == (name == "stereo")
    (labels,) = [one for one in content["recordSet"] if one["name"] == "labels"]
    assert "labels/right_shaft_v_px" in [field["name"] for field in labels["field"]]


@pytest.mark.extras
@pytest.mark.filterwarnings("ignore")  # of mlcroissant and what it stands on
def test_croissant_of_views_is_read_by_mlcroissant(stereo: InstrumentDataset, tmp_path: Path) -> None:
    mlcroissant = pytest.importorskip("mlcroissant")
    shutil.copytree(stereo.path, tmp_path / "data")
    out = export(stereo.path, "croissant", tmp_path / "out")
    shutil.copy(out / "croissant.json", tmp_path / "data")
    read = mlcroissant.Dataset(jsonld=str(tmp_path / "data/croissant.json"))
    assert not read.metadata.ctx.issues.errors
    rows = list(read.records("view-right-eye"))
    assert {float(row["view-right-eye/both_view_x_m"]) for row in rows} == {-0.0055}
    assert len(list(read.records("labels"))) == 3
