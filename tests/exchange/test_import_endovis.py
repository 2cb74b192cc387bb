"""Points that people marked on two instruments."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from others import bar, grey, imported, put, put_camera, put_json, refused

CLASSES = ("LeftClasperPoint", "RightClasperPoint", "HeadPoint", "ShaftPoint", "EndPoint")


def points(tool: str | None, column: float, classes: tuple[str, ...] = CLASSES) -> list[dict[str, Any]]:
    """Of a tool whose points begin at a column."""
    every = [{"class": name, "x": column + k, "y": 10.0 + k} for k, name in enumerate(classes)]
    return [one if tool is None else {**one, "id": tool} for one in every]


def put_labels(folder: Path, pictures: list[list[dict[str, Any]]]) -> Path:
    put_camera(folder)
    content = [
        {"class": "image", "filename": f"img_{number:04d}.png", "annotations": marked}
        for number, marked in enumerate(pictures, start=1)
    ]
    return put_json(folder / "labels.json", content)


def test_points_become_tips_and_labels_of_two_arms(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = put_labels(tmp_path / "ds1", [points("tool1", 40) + points("tool4", 5), [], points("tool1", 42), []])
    dataset = imported("endovis", path, out=tmp_path / "data")
    said = capsys.readouterr().err
    assert "2 of 4 pictures are marked" in said
    assert "tool4 is the left arm, tool1 is the right arm" in said
    (sequence,) = dataset.sequences
    assert (dataset.name, sequence.frames, sequence.entry.images, sequence.entry.kinds) == ("ds1", 4, False, ())
    np.testing.assert_allclose(sequence.timestamps_s, np.arange(4) / 25)
    np.testing.assert_allclose(sequence.keypoints("right")[0], [[40, 10], [41, 11]])
    np.testing.assert_allclose(sequence.labels("left")["end"][0], [9, 14])
    for frame, arm in ((1, "left"), (1, "right"), (2, "left")):
        assert np.isnan(sequence.keypoints(arm)[frame]).all()  # type: ignore[arg-type]
    assert not np.isnan(sequence.keypoints("right")[2]).any()
    assert sequence.entry.source_frames[0] == "img_0001"


def test_a_missing_id_is_that_of_the_only_tool_without_such_a_point(tmp_path: Path) -> None:
    four = CLASSES[:4]
    clear = points("a", 5) + points("b", 40, four) + points(None, 44, ("EndPoint",))
    unclear = points("a", 5, four) + points("b", 40, four) + points(None, 44, ("EndPoint",))
    path = put_labels(tmp_path, [clear, unclear])
    labels = imported("endovis", path, out=tmp_path / "out/data").sequences[0].labels("right")
    np.testing.assert_allclose(labels["end"][0], [44, 10])
    assert np.isnan(labels["end"][1]).all()


def test_a_point_in_two_places_is_none(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = put_labels(tmp_path, [points("a", 5) + points("b", 40) + points("a", 8, ("HeadPoint",))])
    labels = imported("endovis", path, out=tmp_path / "out/data").sequences[0].labels("left")
    assert "warning: labels.json: 'img_0001.png' has 2 points 'head' of a" in capsys.readouterr().err
    assert np.isnan(labels["head"]).all()
    assert not np.isnan(labels["shaft"]).any()


def test_pictures_and_masks_beside_it(tmp_path: Path) -> None:
    path = put_labels(tmp_path / "ds", [points("a", 5) + points("b", 40)] * 3)
    for number in (1, 2, 3):
        put(tmp_path / f"ds/images/img_{number:04d}.png", grey(number))
    for number in (2, 3):
        mask = bar(number).astype(np.uint8) + 2 * bar(number, 30).astype(np.uint8)
        put(tmp_path / f"seg/img_{number:04d}.png", mask)
    options = ("--masks", tmp_path / "seg", "--instances", "1=left,2=right", "--fps", 10, "--tools", "a=right,b=left")
    sequence = imported("endovis", path, *options, out=tmp_path / "data").sequences[0]
    assert sequence.entry.source_frames == ("img_0002", "img_0003")
    image = sequence.image(1)
    assert image is not None
    assert image.mean() == 50
    assert np.array_equal(sequence.mask("right", 0), bar(2, 30))
    np.testing.assert_allclose(sequence.keypoints("right")[0, 0], [5, 10])
    np.testing.assert_allclose(sequence.timestamps_s, [0.0, 0.1])


def test_what_does_not_fit_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out/data"
    out.parent.mkdir()
    path = put_labels(tmp_path, [points("a", 5) + points("b", 40) + points("c", 20)])
    assert "--tools a=left,c=right says which two" in refused(capsys, "endovis", path, out=out)
    assert "--tools: must be like" in refused(capsys, "endovis", path, "--tools", "d=left", out=out)
    put(tmp_path / "images/img_0009.png", grey(0))
    told = ("--tools", "a=left,b=right")
    assert "img_0001.png: missing; --images FOLDER" in refused(
        capsys, "endovis", path, *told, "--images", tmp_path / "images", out=out
    )
    (tmp_path / "camera.json").unlink()
    assert "--camera FILE" in refused(capsys, "endovis", path, *told, out=out)
    path.write_text('[{"annotations": []}]')
    assert "must be a list of pictures, each with 'filename'" in refused(capsys, "endovis", path, out=out)
