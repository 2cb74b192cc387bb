"""COCO as others publish it: categories or tracks become arms, keypoints become tips."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commandline import surgbench
from others import CAMERA, HEIGHT, WIDTH, bar, grey, imported, put, put_camera, put_json, refused

from surgbench.dataset.open import open_as
from surgbench.kinds import KINDS
from surgbench.tasks.instrument.dataset import InstrumentDataset

FRAMES = 3
POINTS = ["left tip", "right tip", "wrist"]


def runs(mask: np.ndarray) -> dict[str, Any]:
    """Uncompressed RLE: runs down the columns, the first of zeros."""
    flat = mask.ravel(order="F")
    bounds = [0, *(np.flatnonzero(flat[1:] != flat[:-1]) + 1).tolist(), flat.size]
    counts = np.diff(bounds).tolist()
    return {"size": list(mask.shape), "counts": [0, *counts] if flat[0] else counts}


def polygon(frame: int, top: int = 8) -> list[list[float]]:
    """The outline of :func:`bar`, whose corners are pixels' corners."""
    right = 24 + 2 * frame
    return [[0, top, right, top, right, top + 8, 0, top + 8]]


def annotation(image: int, category: int, segmentation: Any, **more: Any) -> dict[str, Any]:
    return {"image_id": image, "category_id": category, "segmentation": segmentation, **more}


def put_coco(folder: Path, annotations: list[dict[str, Any]], **changes: Any) -> Path:
    put_camera(folder)
    images = [
        {"id": 10 + frame, "file_name": f"img_{frame:03d}.png", "width": WIDTH, "height": HEIGHT}
        for frame in range(FRAMES)
    ]
    categories = [{"id": 1, "name": "driver", "keypoints": POINTS}, {"id": 2, "name": "scissors", "keypoints": POINTS}]
    numbered = [{"id": number, **one} for number, one in enumerate(annotations)]
    content = {"images": images, "annotations": numbered, "categories": categories, **changes}
    return put_json(folder / "annotations.json", content)


def of_two(**more: Any) -> list[dict[str, Any]]:
    """Polygons of one category, RLE of the other."""
    first = [annotation(10 + frame, 1, polygon(frame), **more) for frame in range(FRAMES)]
    return first + [annotation(10 + frame, 2, runs(bar(frame, 30)), **more) for frame in range(FRAMES)]


def test_categories_become_arms(tmp_path: Path) -> None:
    points = {"keypoints": [5.0, 9.0, 2, 6.0, 9.5, 1, 0, 0, 0]}
    path = put_coco(tmp_path / "set", of_two(**points))
    for frame in range(FRAMES):
        put(tmp_path / f"set/images/img_{frame:03d}.png", grey(frame))
    options = ("--categories", "scissors=left,1=right", "--fps", 10)
    sequence = imported("coco", path, *options, out=tmp_path / "data").sequences[0]
    assert sequence.entry.kinds == ("left", "right", "both")
    np.testing.assert_allclose(sequence.timestamps_s, [0.0, 0.1, 0.2])
    for frame in range(FRAMES):
        assert np.array_equal(sequence.mask("right", frame), bar(frame))
        assert np.array_equal(sequence.mask("left", frame), bar(frame, 30))
        image = sequence.image(frame)
        assert image is not None
        assert image.mean() == 20 + 10 * frame
    # What is hidden is a label, but no tip that was seen.
    np.testing.assert_allclose(sequence.labels("left")["right_tip"][0], [6.0, 9.5])
    np.testing.assert_allclose(sequence.keypoints("left")[0], [[5.0, 9.0], [np.nan, np.nan]])
    assert np.isnan(sequence.labels("left")["wrist"]).all()


def test_tracks_become_arms_and_frames_without_an_object_are_empty(tmp_path: Path) -> None:
    both = [annotation(10, 1, runs(bar(0)), track_id=7), annotation(10, 1, runs(bar(0, 30)), track_id=9)]
    path = put_coco(tmp_path / "set", [*both, annotation(12, 1, runs(bar(2)), track_id=7)])
    sequence = imported("coco", path, "--tracks", "7=left,9=right", out=tmp_path / "data").sequences[0]
    assert np.array_equal(sequence.mask("right", 0), bar(0, 30))
    assert not sequence.mask("right", 2).any()
    assert not sequence.mask("left", 1).any()


def test_tracks_are_the_values_of_masks_where_categories_are_not_two(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """As `import masks` has them: of one category, in another order in each frame, as RLE and as polygons."""
    objects = [
        annotation(10 + frame, 1, segmentation, track_id=track)
        for frame in range(FRAMES)
        for track, segmentation in sorted([(7, polygon(frame)), (9, runs(bar(frame, 30)))], reverse=frame % 2 == 0)
    ]
    path = put_coco(tmp_path / "set", objects)
    options = ("--instances", "9=left,7=right")
    sequence = imported("masks", path, *options, out=tmp_path / "data").sequences[0]
    for frame in range(FRAMES):
        assert np.array_equal(sequence.mask("right", frame), bar(frame))
        assert np.array_equal(sequence.mask("left", frame), bar(frame, 30))
    assert "--instances 7=left,9=right for two arms" in refused(capsys, "masks", path, out=tmp_path / "other")
    named = put_coco(tmp_path / "named", [{**one, "track_id": f"tool {one['track_id']}"} for one in objects])
    said = refused(capsys, "masks", named, *options, out=tmp_path / "other")
    assert "import coco --tracks tool 7=left,tool 9=right takes such" in said
    tracks = ("--tracks", "tool 9=left,tool 7=right", "--without-images")
    again = imported("coco", named, *tracks, out=tmp_path / "again").sequences[0]
    assert np.array_equal(again.mask("left", 2), bar(2, 30))


@pytest.mark.parametrize("importer", ["coco", "masks"])
def test_objects_of_a_video_are_followed(tmp_path: Path, capsys: pytest.CaptureFixture[str], importer: str) -> None:
    """YouTube-VIS: an annotation for each object, with its masks in all frames."""
    names = [f"case/{5 * frame:05d}.jpg" for frame in range(FRAMES)]
    content: dict[str, Any] = {
        "videos": [{"id": 1, "file_names": names, "width": WIDTH, "height": HEIGHT, "length": FRAMES}],
        "categories": [{"id": 1, "name": "driver"}],
        "annotations": [
            {"id": 7, "video_id": 1, "category_id": 1, "segmentations": [runs(bar(frame)) for frame in range(FRAMES)]},
            {"id": 9, "video_id": 1, "category_id": 1, "segmentations": [None, runs(bar(1, 30)), None]},
        ],
    }
    put_camera(tmp_path / "set")
    path = put_json(tmp_path / "set/annotations.json", content)
    options = ("--tracks" if importer == "coco" else "--instances", "7=left,9=right")
    sequence = imported(importer, path, *options, out=tmp_path / "data").sequences[0]
    np.testing.assert_allclose(sequence.timestamps_s, [0.0, 5 / 30, 10 / 30])
    for frame in range(FRAMES):
        assert np.array_equal(sequence.mask("left", frame), bar(frame))
        assert np.array_equal(sequence.mask("right", frame), bar(frame, 30) & (frame == 1))
    content["annotations"][1]["segmentations"].pop()
    put_json(path, content)
    said = refused(capsys, importer, path, *options, out=tmp_path / "other")
    assert "annotation 9: 2 segmentations, and its video 1 has 3 frames" in said


def test_folders_become_sequences(tmp_path: Path) -> None:
    images = [
        {"id": number, "file_name": f"{folder}/frame_{frame}.png", "width": WIDTH, "height": HEIGHT}
        for number, (folder, frame) in enumerate([("a/left", 5), ("a/left", 1), ("b/left", 0)])
    ]
    annotations = [annotation(number, 1, runs(bar(number))) for number in range(3)]
    path = put_coco(tmp_path / "set", annotations, images=images)
    dataset = imported("coco", path, out=tmp_path / "data")
    assert [(one.id, one.entry.source_frames) for one in dataset.sequences] == [
        ("a-left", ("frame_1", "frame_5")),
        ("b-left", ("frame_0",)),
    ]
    np.testing.assert_allclose(dataset.sequences[0].timestamps_s, [0.0, 4 / 30])
    assert np.array_equal(dataset.sequences[0].mask("left", 0), bar(1))


def test_keypoints_alone_are_a_dataset_without_masks(tmp_path: Path) -> None:
    marked = [annotation(10, 1, [], keypoints=[5, 9, 2, 6, 9, 2, 7, 9, 2])]
    path = put_coco(tmp_path / "set", marked)
    dataset = imported("coco", path, "--tips", "left tip,wrist", "--arms", "right", out=tmp_path / "data")
    sequence = dataset.sequences[0]
    assert (sequence.arms, sequence.entry.kinds) == (("right",), ())
    np.testing.assert_allclose(sequence.keypoints("right")[0], [[5, 9], [7, 9]])


def test_what_does_not_fit_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out/data"
    out.parent.mkdir()
    path = put_coco(tmp_path, of_two())
    assert "--categories driver=left,scissors=right says which arm" in refused(capsys, "coco", path, out=out)
    assert "--categories: must be like" in refused(capsys, "coco", path, "--categories", "hook=left", out=out)
    assert "--tracks: objects in" in refused(capsys, "coco", path, "--tracks", "1=left", out=out)
    assert "--tips: must be two of the keypoints left_tip" in refused(
        capsys, "coco", path, "--arms", "both", "--tips", "a,b", out=out
    )
    put(tmp_path / "img_000.png", grey(0))
    line = refused(capsys, "coco", path, "--arms", "both", out=out)
    assert "img_001.png: missing; --without-images" in line
    twice = put_coco(tmp_path, [annotation(10, 1, polygon(0)), annotation(10, 1, polygon(0, 30))])
    line = refused(capsys, "coco", twice, "--without-images", out=out)
    assert "has 2 objects 'driver' of one arm; --pieces" in line
    followed = [annotation(10, 1, polygon(0), track_id="b"), annotation(10, 1, polygon(0, 30), track_id="a")]
    line = refused(capsys, "coco", put_coco(tmp_path, followed), "--without-images", out=out)
    assert "of one arm; --tracks b=left,a=right tells two instruments apart, --pieces" in line
    wrong = put_coco(tmp_path, [annotation(10, 1, {"size": [1, 2], "counts": [2]})])
    assert "an RLE has the size [1, 2]" in refused(capsys, "coco", wrong, "--without-images", out=out)
    none = put_coco(tmp_path, [])
    assert "holds no annotations" in refused(capsys, "coco", none, out=out)
    put_json(path, {"images": []})
    assert "a COCO dataset must have 'annotations'" in refused(capsys, "coco", path, out=out)


def test_pieces_and_both(tmp_path: Path) -> None:
    pieces = [annotation(10, 1, polygon(0)), annotation(10, 1, polygon(0, 30))]
    path = put_coco(tmp_path / "set", pieces)
    one = imported("coco", path, "--pieces", out=tmp_path / "one").sequences[0]
    assert np.array_equal(one.mask("left", 0), bar(0) | bar(0, 30))
    pair = imported("coco", path, "--arms", "both", out=tmp_path / "pair").sequences[0]
    assert (pair.arms, pair.entry.kinds) == (("left", "right"), ("both",))


@pytest.mark.skipif("exporter" not in KINDS, reason="there are no exporters")
def test_what_is_exported_comes_back(tmp_path: Path) -> None:
    for frame in range(FRAMES):
        mask = bar(frame).astype(np.uint8) + 2 * bar(frame, 30).astype(np.uint8)
        put(tmp_path / f"rec/masks/{frame:06d}.png", mask)
    (tmp_path / "rec/tips.csv").write_text(
        "frame,left_u1,left_v1,left_u2,left_v2,right_u1,right_v1,right_u2,right_v2\n0,5,9,6,9,7,31,8,32\n"
    )
    put_camera(tmp_path / "rec")
    surgbench("import", "masks", tmp_path / "rec", "--instances", "1=left,2=right", "--out", tmp_path / "first")
    surgbench("export", tmp_path / "first", "--format", "coco", "--out", tmp_path / "coco")
    second = imported("coco", tmp_path / "coco", "--without-images", out=tmp_path / "second").sequences[0]
    first = open_as(InstrumentDataset, tmp_path / "first").sequences[0]
    assert (second.id, second.arms, second.camera) == (first.id, first.arms, CAMERA)
    for kind in first.entry.kinds:
        for frame in range(FRAMES):
            assert np.array_equal(second.mask(kind, frame), first.mask(kind, frame))
    for arm in first.arms:
        np.testing.assert_allclose(second.keypoints(arm), first.keypoints(arm))
