"""Datasets and estimates in other people's formats, each held against a reader that is not ours, or its own rules."""

from __future__ import annotations

import csv
import json
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pandas as pd
import pytest
import trimesh
from commandline import surgbench
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays
from scipy.spatial.transform import Rotation
from small_dataset import CAMERA, DRIVER, DT_S, FRAMES, list_anew, make_pair, states_of

from surgbench.dataset.open import open_as
from surgbench.dataset.validate import validate
from surgbench.errors import DatasetError
from surgbench.exchange.exporters.coco import encode_rle
from surgbench.geometry import FloatArray, look_at_rotation
from surgbench.instrument import load_instrument
from surgbench.registry import discover
from surgbench.state import twin
from surgbench.tasks.instrument.dataset import InstrumentDataset
from surgbench.tasks.instrument.format import ARMS

FORMATS = ("bop", "card", "coco", "croissant", "csv", "tum")


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> InstrumentDataset:
    return make_pair(tmp_path_factory.mktemp("data") / "pairs")


@pytest.fixture(scope="module")
def runs(dataset: InstrumentDataset, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of estimates that are 2 mm too far to the right."""
    folder = tmp_path_factory.mktemp("runs")
    surgbench("export", dataset.path, "--format", "csv", "--out", folder / "csv")
    off = pd.read_csv(folder / "csv" / "truth.csv", dtype={"sequence": str})
    off.assign(x_m=off["x_m"] + 0.002, ms=12.5, confidence=0.5).to_csv(folder / "off.csv", index=False)
    command = ("score", dataset.path, folder / "off.csv", "--time-ms", "ms", "--out", folder / "runs")
    surgbench(*command, "--name", "mine")
    return folder / "runs"


def export(source: Path, format_: str, out: Path, *more: object) -> Path:
    surgbench("export", source, "--format", format_, "--out", out, *more)
    assert [path.name for path in out.parent.iterdir() if path.name.startswith(".")] == []
    return out


def load(path: Path) -> Any:
    return json.loads(path.read_text(encoding="utf-8"))


def test_every_format_is_listed() -> None:
    assert set(discover("exporter")) == set(FORMATS)


def test_csv_has_what_is_true_and_what_was_observed(dataset: InstrumentDataset, tmp_path: Path) -> None:
    out = export(dataset.path, "csv", tmp_path / "out")
    with (out / "truth.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 2 * 2 * FRAMES
    row = next(row for row in rows if (row["sequence"], row["arm"], row["frame"]) == ("001", "right", "2"))
    state = states_of("right", sequence=1)[2]
    assert float(row["timestamp_s"]) == pytest.approx(2 * DT_S)
    assert [float(row[name]) for name in ("x_m", "y_m", "z_m", "q1_rad")] == [*state[3:6], state[6]]
    turned = Rotation.from_quat([float(row[name]) for name in ("qx", "qy", "qz", "qw")]).as_matrix()
    np.testing.assert_allclose(turned, look_at_rotation(state[:3]), atol=1e-12)
    tips = load_instrument(DRIVER).tips_cam(state)
    np.testing.assert_allclose([float(row[f"tip2_{axis}_m"]) for axis in "xyz"], tips[1], atol=1e-12)
    observed = pd.read_csv(out / "observed.csv")
    # Older pandas reads numbers but for their last bit.
    np.testing.assert_allclose(observed["q3_rad"], [float(row["q3_rad"]) for row in rows], rtol=1e-14)
    assert observed["u1_px"].notna().all()


def test_csv_of_a_recording_is_what_was_observed(tmp_path: Path) -> None:
    recording = make_pair(tmp_path / "recording", truth=False, sequences=1)
    out = export(recording.path, "csv", tmp_path / "out")
    assert [path.name for path in out.iterdir()] == ["observed.csv"]


@pytest.mark.extras
def test_tum_is_read_by_evo(dataset: InstrumentDataset, runs: Path, tmp_path: Path) -> None:
    pytest.importorskip("evo")
    from evo.core import metrics
    from evo.tools import file_interface

    true = export(dataset.path, "tum", tmp_path / "true") / "truth"
    mine = export(runs, "tum", tmp_path / "mine") / "mine"
    assert {path.name for path in true.iterdir()} == {path.name for path in mine.iterdir()}
    driver = load_instrument(DRIVER)
    for name, place in (("wrist", lambda s: s[:, 3:6]), ("tip2", lambda s: driver.tips_cam(s)[:, 1])):
        path = f"001-left-{name}.tum"
        reference = file_interface.read_tum_trajectory_file(true / path)
        estimate = file_interface.read_tum_trajectory_file(mine / path)
        assert reference.check()[0], reference.check()
        np.testing.assert_allclose(reference.timestamps, DT_S * np.arange(FRAMES))
        np.testing.assert_allclose(reference.positions_xyz, place(states_of("left", sequence=1)), atol=1e-12)
        error = metrics.APE(metrics.PoseRelation.translation_part)
        error.process_data((reference, estimate))
        np.testing.assert_allclose(error.error, 0.002, atol=1e-9)
        turned = metrics.APE(metrics.PoseRelation.rotation_angle_rad)
        turned.process_data((reference, estimate))
        np.testing.assert_allclose(turned.error, 0.0, atol=1e-6)
    joints = np.loadtxt(true / "000-right-joints.txt")
    np.testing.assert_allclose(joints[:, 1:], states_of("right")[:, 6:])


@given(arrays(np.bool_, array_shapes(min_dims=2, max_dims=2, max_side=40)))
def test_run_lengths_are_the_mask(mask: np.ndarray) -> None:
    """The code of COCO, read by its own description."""
    code = encode_rle(mask)
    runs: list[int] = []
    value = shift = 0
    for character in code["counts"]:
        bits = ord(character) - 48
        value |= (bits & 31) << shift
        shift += 5
        if not bits & 32:
            if bits & 16:
                value -= 1 << shift
            runs.append(value + (runs[-2] if len(runs) > 2 else 0))
            value = shift = 0
    flat = np.repeat(np.arange(len(runs)) % 2 == 1, runs)
    assert np.array_equal(flat.reshape(mask.shape, order="F"), mask)


@pytest.mark.extras
@given(mask=arrays(np.bool_, st.tuples(st.integers(1, 70), st.integers(1, 70))))
def test_run_lengths_are_those_of_pycocotools(mask: np.ndarray) -> None:
    coco_mask = pytest.importorskip("pycocotools.mask")
    theirs = coco_mask.encode(np.asfortranarray(mask.astype(np.uint8)))
    assert encode_rle(mask)["counts"] == theirs["counts"].decode()


@pytest.mark.extras
@pytest.mark.filterwarnings("ignore")  # of pycocotools
def test_coco_is_read_by_pycocotools(dataset: InstrumentDataset, runs: Path, tmp_path: Path) -> None:
    pytest.importorskip("pycocotools")
    from pycocotools.coco import COCO
    from pycocotools.cocoeval import COCOeval

    out = export(dataset.path, "coco", tmp_path / "data")
    coco = COCO(str(out / "annotations.json"))
    assert len(coco.getImgIds()) == 2 * FRAMES
    assert len(coco.getAnnIds()) == 2 * 2 * FRAMES
    for annotation in coco.loadAnns(coco.getAnnIds()):
        (image,) = coco.loadImgs(annotation["image_id"])
        sequence = dataset.sequence(image["sequence"])
        mask = sequence.clean_mask(annotation["arm"], image["frame"])
        assert np.array_equal(coco.annToMask(annotation) > 0, mask)
        assert annotation["area"] == mask.sum()
        left, top, width, height = annotation["bbox"]
        assert mask[top : top + height, left : left + width].sum() == mask.sum()
        states = sequence.states(annotation["arm"])
        assert states is not None
        tips = CAMERA.project(load_instrument(DRIVER).tips_cam(states[image["frame"]]))
        inside = CAMERA.contains(tips)
        assert inside.any()
        points = np.reshape(annotation["keypoints"], (2, 3))
        np.testing.assert_allclose(points[inside, :2], tips[inside])
        assert points[:, 2].tolist() == (2 * inside).tolist()
        picture = cv2.imread(str(out / image["file_name"]), cv2.IMREAD_GRAYSCALE)
        assert picture is not None
        assert np.array_equal(picture > 0, sequence.mask("both", image["frame"]))
    results = coco.loadRes(str(export(runs, "coco", tmp_path / "mine") / "mine.json"))
    assert len(results.getAnnIds()) == 2 * 2 * FRAMES
    judged = COCOeval(coco, results, "segm")
    judged.evaluate()
    ious = np.concatenate([np.ravel(values) for values in judged.ious.values() if len(values)])
    assert 0.5 < ious.max() < 1.0  # 2 mm off


# What the format says of its fields (docs/bop_datasets_format.md of bop_toolkit).
def check_bop(folder: Path) -> list[tuple[Path, dict[str, Any]]]:
    """Field rules of a dataset; returns its scenes with their poses."""
    models = load(folder / "models" / "models_info.json")
    for number, info in models.items():
        mesh = trimesh.load_mesh(folder / "models" / f"obj_{int(number):06d}.ply", process=False)
        low, high = mesh.bounds
        np.testing.assert_allclose([info[f"min_{axis}"] for axis in "xyz"], low, atol=1e-4)
        np.testing.assert_allclose([info[f"size_{axis}"] for axis in "xyz"], high - low, atol=1e-4)
        np.testing.assert_allclose(low + high, 0.0, atol=1e-4)  # the origin is the centre of the box
        apart = mesh.vertices[:, None] - mesh.vertices[None]
        assert info["diameter"] == pytest.approx(np.linalg.norm(apart, axis=-1).max(), abs=1e-3)
        assert mesh.is_watertight
        assert mesh.volume > 0
        assert not {"symmetries_discrete", "symmetries_continuous"} & info.keys()
    camera = load(folder / "camera.json")
    assert set(camera) == {"cx", "cy", "fx", "fy", "width", "height", "depth_scale"}
    scenes = []
    for scene in sorted((folder / "test").iterdir()):
        assert scene.name.isdecimal()
        assert len(scene.name) == 6
        cameras, poses, infos = (load(scene / f"scene_{name}.json") for name in ("camera", "gt", "gt_info"))
        assert cameras.keys() == poses.keys() == infos.keys()
        for image in poses:
            assert np.shape(cameras[image]["cam_K"]) == (9,)
            picture = cv2.imread(str(scene / "gray" / f"{int(image):06d}.png"))
            assert picture is not None
            assert picture.shape[:2] == (camera["height"], camera["width"])
            for number, (pose, info) in enumerate(zip(poses[image], infos[image], strict=True)):
                assert str(pose["obj_id"]) in models
                turned = np.reshape(pose["cam_R_m2c"], (3, 3))
                np.testing.assert_allclose(turned @ turned.T, np.eye(3), atol=1e-9)
                assert np.linalg.det(turned) > 0
                assert 50 < np.linalg.norm(pose["cam_t_m2c"]) < 500  # millimetres
                masks = [
                    cv2.imread(str(scene / kind / f"{int(image):06d}_{number:06d}.png"), cv2.IMREAD_GRAYSCALE)
                    for kind in ("mask", "mask_visib")
                ]
                whole, visible = (np.asarray(mask) > 0 for mask in masks)
                assert not (visible & ~whole).any()
                assert info["px_count_all"] == whole.sum()
                assert info["px_count_visib"] == visible.sum()
                if whole.any():
                    left, top, width, height = info["bbox_obj"]
                    assert whole[top : top + height, left : left + width].sum() == whole.sum()
                    assert info["visib_fract"] == pytest.approx(visible.sum() / whole.sum())
        scenes.append((scene, poses))
    for target in load(folder / "test_targets_bop19.json"):
        shown = load(folder / "test" / f"{target['scene_id']:06d}" / "scene_gt.json")[str(target["im_id"])]
        assert sum(pose["obj_id"] == target["obj_id"] for pose in shown) == target["inst_count"]
    return scenes


def test_bop_keeps_its_field_rules_and_shows_the_instrument(dataset: InstrumentDataset, tmp_path: Path) -> None:
    out = export(dataset.path, "bop", tmp_path / "out")
    scenes = check_bop(out)
    assert len(scenes) == 2
    driver, links = load_instrument(DRIVER), load(out / "models" / "objects.json")
    for place, (scene, poses) in enumerate(scenes):
        for image, shown in poses.items():
            whole, visible = np.zeros((2, CAMERA.height, CAMERA.width), dtype=np.int64)
            for number, pose in enumerate(shown):
                # The model's own points, by the format's own equation, are where the link is.
                about = links[str(pose["obj_id"])]
                vertices_mm = 1e3 * driver.meshes[about["link"]].vertices_m - about["link_from_model_mm"]
                points_mm = vertices_mm @ np.reshape(pose["cam_R_m2c"], (3, 3)).T + pose["cam_t_m2c"]
                state = states_of(ARMS[number // len(links)], sequence=place)[int(image)]
                T_cam_link = driver.link_transforms(state)[driver.link_index[about["link"]]]
                expected_m = driver.meshes[about["link"]].vertices_m @ T_cam_link[:3, :3].T + T_cam_link[:3, 3]
                np.testing.assert_allclose(points_mm, 1e3 * expected_m, atol=1e-6)
                for kind, sums in (("mask", whole), ("mask_visib", visible)):
                    path = scene / kind / f"{int(image):06d}_{number:06d}.png"
                    sums += np.asarray(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)) > 0
            sequence = dataset.sequences[place]
            assert np.array_equal(visible, sequence.clean_mask("both", int(image)))  # every pixel belongs to one link
            assert np.array_equal(whole > 0, visible > 0)


def test_the_twin_of_bop_is_a_second_set_of_poses_that_swaps_the_jaws(
    dataset: InstrumentDataset, tmp_path: Path
) -> None:
    out = export(dataset.path, "bop", tmp_path / "out")
    scene, links = out / "test" / "000000", load(out / "models" / "objects.json")
    numbers = {about["link"]: int(number) for number, about in links.items()}
    poses, twins = (load(scene / f"scene_gt{ending}.json")["1"][: len(links)] for ending in ("", "_twin"))

    def place(shown: list[dict[str, Any]], link: str) -> FloatArray:
        return np.array(next(pose["cam_t_m2c"] for pose in shown if pose["obj_id"] == numbers[link]))

    for one, other in (("jaw_left", "jaw_right"), ("jaw_right", "jaw_left")):
        np.testing.assert_allclose(place(twins, one), place(poses, other), atol=0.05)  # mm
        assert np.linalg.norm(place(twins, one) - place(poses, one)) > 1.0
    own, turned = (load(scene / f"scene_joints{ending}.json")["1"][0] for ending in ("", "_twin"))
    assert (own["sequence"], own["arm"]) == ("000", "left")
    np.testing.assert_allclose(own["state"], states_of("left")[1])
    np.testing.assert_allclose(turned["state"], twin(states_of("left")[1]))


@pytest.mark.parametrize("symmetry", ["none", "axis"])
def test_bop_has_no_twin_of_an_instrument_without_one(symmetry: str, tmp_path: Path) -> None:
    root = make_pair(tmp_path / "pairs").path
    path = root / "instruments" / DRIVER / "instrument.yaml"
    path.write_text(path.read_text() + f"symmetry: {symmetry}\n")
    list_anew(root)
    out = export(root, "bop", tmp_path / "out")
    assert not list(out.rglob("*_twin.json"))
    infos, links = load(out / "models" / "models_info.json"), load(out / "models" / "objects.json")
    for number, about in links.items():
        turns = infos[number].get("symmetries_continuous", [])
        # BOP's turns are about a point of the model's frame: the shaft's axis in the link's.
        assert [turn["axis"] for turn in turns] == ([[0, 0, 1]] if symmetry == "axis" else [])
        for turn in turns:
            np.testing.assert_allclose(np.add(turn["offset"], about["link_from_model_mm"]), 0.0, atol=1e-9)


def test_bop_results_have_a_line_for_every_link_and_one_time_per_image(runs: Path, tmp_path: Path) -> None:
    out = export(runs, "bop", tmp_path / "out")
    (path,) = out.iterdir()
    method, _, dataset_info = path.stem.partition("_")
    assert (method, dataset_info.split("-")) == ("mine", ["pairs", "test"])
    with path.open() as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == ["scene_id", "im_id", "obj_id", "score", "R", "t", "time"]
    assert len(rows) == 2 * FRAMES * 2 * 5
    assert {row["score"] for row in rows} == {"0.5"}
    times: dict[tuple[str, str], set[str]] = {}
    for row in rows:
        turned = np.reshape([float(value) for value in row["R"].split(" ")], (3, 3))
        np.testing.assert_allclose(turned @ turned.T, np.eye(3), atol=1e-9)
        assert len(row["t"].split(" ")) == 3
        times.setdefault((row["scene_id"], row["im_id"]), set()).add(row["time"])
    assert all(len(found) == 1 and float(*found) == pytest.approx(0.025) for found in times.values())


@pytest.mark.extras
@pytest.mark.filterwarnings("ignore")  # of mlcroissant and what it stands on
def test_croissant_is_read_by_mlcroissant(tmp_path: Path) -> None:
    mlcroissant = pytest.importorskip("mlcroissant")
    dataset = make_pair(tmp_path / "pairs")
    told = {"license": "https://creativecommons.org/licenses/by/4.0/", "creator": "A. Surgeon"}
    sets = [word for key, value in told.items() for word in ("--set", f"croissant.{key}={value}")]
    out = export(dataset.path, "croissant", tmp_path / "out", *sets)
    shutil.copy(out / "croissant.json", dataset.path)  # its place
    assert validate(dataset.path) == []
    assert open_as(InstrumentDataset, dataset.path).hash == dataset.hash
    read = mlcroissant.Dataset(jsonld=str(dataset.path / "croissant.json"))
    assert not read.metadata.ctx.issues.errors
    assert read.metadata.name == "pairs"
    hashes = [getattr(one, "sha256", None) for one in read.metadata.distribution]
    assert dataset.hash in hashes
    rows = list(read.records("states"))
    assert len(rows) == 2 * FRAMES
    places = sorted(float(row["states/left_x_m"]) for row in rows)
    expected = np.concatenate([states_of("left", sequence=number)[:, 3] for number in (0, 1)])
    np.testing.assert_allclose(places, np.sort(expected))
    assert len(list(read.records("observations"))) == 2 * FRAMES


def test_croissant_names_where_it_is_published(dataset: InstrumentDataset, tmp_path: Path) -> None:
    out = export(dataset.path, "croissant", tmp_path / "out", "--set", "croissant.url=https://example.org/pairs/")
    content = load(out / "croissant.json")
    assert content["url"] == "https://example.org/pairs/"
    assert content["distribution"][0]["contentUrl"] == "https://example.org/pairs/dataset.json"


def test_what_cannot_be_exported_is_one_line(
    dataset: InstrumentDataset, runs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recording = make_pair(tmp_path / "recording", truth=False, sequences=1)
    full = tmp_path / "full"
    full.mkdir()
    (full / "mine.txt").touch()
    out = tmp_path / "out"
    for arguments, words in (
        ((recording.path, "--format", "bop", "--out", out), "has no true poses"),
        ((recording.path, "--format", "tum", "--out", out), "has no true poses"),
        ((runs, "--format", "croissant", "--out", out), "describes datasets"),
        ((dataset.path, "--format", "cocco", "--out", out), "unknown exporter 'cocco'; did you mean 'coco'"),
        ((dataset.path, "--format", "csv", "--out", full), "holds something already"),
        ((tmp_path / "nowhere", "--format", "csv", "--out", out), "no such file or folder"),
        ((full, "--format", "csv", "--out", out), "holds no records"),
        ((runs, "--format", "csv", "--dataset", recording.path, "--out", out), "not the dataset that the records"),
        ((dataset.path, "--format", "csv", "--set", "coco.a=1", "--out", out), "this is the format 'csv'"),
        ((dataset.path, "--format", "croissant", "--set", "croissant.ulr=x", "--out", out), "did you mean 'url'"),
    ):
        surgbench("export", *arguments, expect=2)
        (line,) = capsys.readouterr().err.strip().splitlines()
        assert words in line
    assert not out.exists()
    assert [path.name for path in full.iterdir()] == ["mine.txt"]


def test_an_export_that_fails_leaves_nothing(tmp_path: Path) -> None:
    dataset = make_pair(tmp_path / "pairs", sequences=1)
    (dataset.path / "sequences/000/observed/both/000002.png").write_bytes(b"")
    for format_ in ("bop", "coco"):
        surgbench("export", dataset.path, "--format", format_, "--out", tmp_path / "out", expect=2)
    assert [path.name for path in tmp_path.iterdir()] == ["pairs"]


def test_estimates_of_a_dataset_that_moved_are_exported(
    dataset: InstrumentDataset, runs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    moved = Path(shutil.copytree(dataset.path, tmp_path / "elsewhere"))
    record = sorted(runs.rglob("*.json"))[0]
    out = export(record, "csv", tmp_path / "out", "--dataset", moved)
    assert len(pd.read_csv(out / "mine.csv")) == FRAMES
    with pytest.raises(DatasetError, match="no such folder"):
        open_as(InstrumentDataset, tmp_path / "nowhere")
