"""JSON files of others with anything at all in any place: a dataset, or one line."""

from __future__ import annotations

import copy
import json
import math
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from others import bar, put_articulated, put_camera, put_json

from surgbench.errors import SurgbenchError
from surgbench.registry import create, find

JUNK: st.SearchStrategy[Any] = st.sampled_from(
    [
        None,
        [],
        {},
        "",
        "x",
        "²",
        "None",
        -1,
        0,
        2**70,
        1e308,
        math.nan,
        True,
        [[]],
        {"a": None},
        {"counts": 5, "size": 7},
    ]
)


def places(value: Any, place: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Of everything in a JSON value, the keys that lead to it."""
    yield place
    for key in value if isinstance(value, dict) else range(len(value)) if isinstance(value, list) else ():
        yield from places(value[key], (*place, key))


def put_points(folder: Path) -> Path:
    camera = json.loads(put_camera(folder).read_text())
    points = [
        {"class": name, "id": tool, "x": 5.0 + number, "y": 6.0}
        for tool in ("tool1", "tool4")
        for number, name in enumerate(("LeftClasperPoint", "RightClasperPoint", "ShaftPoint"))
    ]
    assert camera["width"] > 8
    return put_json(folder / "labels.json", [{"filename": f"img_{k}.png", "annotations": points} for k in range(2)])


def put_annotations(folder: Path) -> Path:
    put_camera(folder)
    height, width = bar(0).shape
    outline = [1, 8, 20, 8, 20, 14, 1, 14]
    images = [
        {"id": k + 1, "file_name": f"{k}.png", "width": width, "height": height, "sequence": "000", "frame": k}
        for k in range(2)
    ]
    shapes = [
        {"id": k, "image_id": k + 1, "category_id": 1, "segmentation": [outline], "keypoints": [3, 9, 2, 4, 9, 2]}
        for k in range(2)
    ]
    kinds = [{"id": 1, "name": "driver", "keypoints": ["tip1", "tip2"]}]
    return put_json(folder / "masks.json", {"images": images, "annotations": shapes, "categories": kinds})


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[str, Path, Path, dict[str, Any]]]:
    """Importer, source, file and options."""
    root = tmp_path_factory.mktemp("recordings")
    bop = put_articulated(root / "bop")
    coco = put_annotations(root / "coco")
    points = put_points(root / "points")
    scene = bop / "test/000000"
    return {
        "labels": ("endovis", points, points, {}),
        "camera": ("endovis", points, points.with_name("camera.json"), {}),
        "masks": ("masks", coco, coco, {}),
        "coco": ("coco", coco, coco, {"without_images": True, "arms": "left"}),
        **{
            name: ("bop", bop, place / f"{name}.json", {"masks": "whole"})
            for place, name in (
                (scene, "scene_gt"), (scene, "scene_camera"), (scene, "scene_joints"), (bop / "models", "objects"),
            )
        },
    }  # fmt: skip


@pytest.mark.parametrize(
    "name", ["labels", "camera", "masks", "coco", "scene_gt", "scene_camera", "scene_joints", "objects"]
)
@given(data=st.data())
@settings(max_examples=15, deadline=None, suppress_health_check=list(HealthCheck))
def test_anything_in_any_place_is_a_dataset_or_one_line(
    files: dict[str, tuple[str, Path, Path, dict[str, Any]]], name: str, data: st.DataObject
) -> None:
    importer, source, path, options = files[name]
    sound = path.read_text()
    content = json.loads(sound)
    *place, last = data.draw(st.sampled_from([place for place in places(content) if place]))
    changed = copy.deepcopy(content)
    here = changed
    for key in place:
        here = here[key]
    here[last] = data.draw(JUNK)
    out = source.with_name("out")
    shutil.rmtree(out, ignore_errors=True)
    path.write_text(json.dumps(changed))
    try:
        create(find("importer", importer), options).run(source, out, lambda frames: None)
    except SurgbenchError as error:
        said = str(error)
    else:
        return
    finally:
        path.write_text(sound)
    assert "\n" not in said
    assert not out.exists()
