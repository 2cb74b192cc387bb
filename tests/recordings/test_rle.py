"""Run lengths, held against texts that pycocotools 2.0 made."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from surgbench.errors import DatasetError
from surgbench.recordings.coco import MaskJson
from surgbench.recordings.rle import decode_counts, decode_rle, decode_segmentation, draw_polygons


def runs(mask: np.ndarray) -> list[int]:
    """Lengths of runs down the columns, the first of zeros."""
    flat = mask.T.ravel()
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flat.astype(int), [1 - int(flat[-1])]])))
    return [int(length) for length in np.diff(np.concatenate([[0], edges]))]


def text(counts: list[int]) -> str:
    """As ``rleToString`` in pycocotools' maskApi.c."""
    out = ""
    for k, count in enumerate(counts):
        value, more = count - (counts[k - 2] if k > 2 else 0), True
        while more:
            group = value & 0x1F
            value >>= 5
            more = value != -1 if group & 0x10 else value != 0
            out += chr(group + (0x20 if more else 0) + 48)
    return out


@given(arrays.arrays(np.bool_, st.tuples(st.integers(1, 40), st.integers(1, 40))))
def test_any_mask_comes_back(mask: np.ndarray) -> None:
    counts = runs(mask)
    assert sum(counts) == mask.size
    assert decode_counts(text(counts)) == counts
    assert np.array_equal(decode_rle(counts, *mask.shape), mask)
    assert np.array_equal(decode_rle(text(counts), *mask.shape), mask)


def test_damaged_runs_are_refused() -> None:
    with pytest.raises(ValueError, match="has 5 pixels, not 2x2"):
        decode_rle([2, 3], 2, 2)
    with pytest.raises(ValueError, match="cut off"):
        decode_rle("P", 2, 2)
    with pytest.raises(ValueError, match="cannot be in an RLE"):
        decode_rle("~ü", 2, 2)
    with pytest.raises(ValueError, match=r"size \[3, 2\]"):
        decode_segmentation({"size": [3, 2], "counts": [6]}, 2, 2)


def test_polygons_cover_their_pixels() -> None:
    mask = draw_polygons([[2, 1, 6, 1, 6, 4, 2, 4]], 6, 8)
    expected = np.zeros((6, 8), bool)
    expected[1:4, 2:6] = True
    assert np.array_equal(mask, expected)


@pytest.mark.parametrize("counts", [[2**62] * 4 + [48], [2**70], [None], [[1], 2]])
def test_runs_that_are_no_lengths_are_refused(counts: list[int]) -> None:
    with pytest.raises(ValueError, match=r"an RLE|inhomogeneous"):
        decode_rle(counts, 6, 8)


def test_polygons_are_as_large_as_their_area() -> None:
    """A disc's, that leaves the picture on the right; pixels count by their centres."""
    turn = np.linspace(0, 2 * np.pi, 400, endpoint=False)
    outline = np.stack([50 + 20.3 * np.cos(turn), 30.2 + 20.3 * np.sin(turn)], axis=1)
    mask = draw_polygons([outline.ravel().tolist()], 60, 64)
    rows, columns = np.indices(mask.shape)
    disc = np.hypot(columns + 0.5 - 50, rows + 0.5 - 30.2) < 20.3
    assert (mask ^ disc).sum() <= 2


@pytest.mark.parametrize(
    ("polygon", "counts"),
    [
        ([3.2, 1.7, 17.9, 4.4, 9.3, 15.1], "R23=2N2O1N2N2NO1N2O2N1O1N2O1Om0"),
        (  # beyond the picture on three sides
            [-4.0, 3.3, 22.6, -2.1, 25.0, 14.2, 6.5, 9.9, 11.1, 19.0],
            "35:2O1O1O1N2O1OLOJ062IM841000001O000000001O00",
        ),
        (  # a point that is there twice, and an outline that crosses itself
            [2.5, 2.5, 2.5, 2.5, 13.5, 2.5, 13.5, 9.5, 2.5, 9.5, 13.5, 6.1],
            "i11?0J0L040K15OK15OK150I17OI17OI170H084m2",
        ),
    ],
)
def test_polygons_are_filled_as_pycocotools_did(polygon: list[float], counts: str) -> None:
    assert np.array_equal(draw_polygons([polygon], 16, 20), decode_rle(counts, 16, 20))


coordinates = st.one_of(st.integers(-90, 190).map(lambda third: third / 3), st.floats(-30, 70))
outlines = st.lists(coordinates, min_size=6, max_size=30).map(lambda numbers: numbers[: len(numbers) // 2 * 2])


@pytest.mark.extras
@pytest.mark.filterwarnings("ignore:__array__:DeprecationWarning")  # of pycocotools
@given(polygons=st.lists(outlines, min_size=1, max_size=3), height=st.integers(1, 50), width=st.integers(1, 50))
def test_polygons_are_filled_as_pycocotools_does(polygons: list[list[float]], height: int, width: int) -> None:
    coco_mask = pytest.importorskip("pycocotools.mask")
    theirs = coco_mask.decode(coco_mask.merge(coco_mask.frPyObjects(polygons, height, width)))
    assert np.array_equal(draw_polygons(polygons, height, width), theirs.astype(bool))


def test_polygons_that_cannot_be_drawn_are_refused() -> None:
    with pytest.raises(ValueError, match="less than three points"):
        draw_polygons([[1.0, 2.0, 3.0, 4.0]], 6, 8)
    with pytest.raises(ValueError, match="reaches 1e\\+09, far outside of 8x6"):
        draw_polygons([[0.0, 0.0, 1e9, 0.0, 3.0, 4.0]], 6, 8)


def annotation(image: int, mask: np.ndarray, category: int = 1) -> dict[str, Any]:
    size = list(mask.shape)
    return {"image_id": image, "category_id": category, "segmentation": {"size": size, "counts": text(runs(mask))}}


def masks() -> list[np.ndarray]:
    drawn = np.random.default_rng(0).random((3, 10, 14)) > 0.5
    return list(drawn)


@pytest.mark.parametrize("shape", ["dataset", "results", "list", "by name"])
def test_every_shape_of_file_gives_the_same_masks(tmp_path: Path, shape: str) -> None:
    one = [annotation(k, mask) for k, mask in enumerate(masks())]
    images = [{"id": k, "file_name": f"video/{k:05d}.jpg", "width": 14, "height": 10} for k in range(3)]
    content: Any = {
        "dataset": {"images": images, "annotations": one, "categories": [{"id": 1, "name": "needle driver"}]},
        "results": one,
        "list": [annotation["segmentation"] for annotation in one],
        "by name": {f"{k:05d}": annotation["segmentation"] for k, annotation in enumerate(one)},
    }[shape]
    path = tmp_path / "masks.json"
    path.write_text(json.dumps(content))
    source = MaskJson(path, (14, 10))
    assert source.numbers == [0, 1, 2]
    assert source.several is None
    assert all(np.array_equal(picture > 0, mask) for picture, mask in zip(source.pictures(), masks(), strict=True))
    assert len(list(source.pictures())) == 3  # as often as it is asked
    assert MaskJson(path).size == (14, 10)  # which the file says itself


def test_categories_are_values_and_two_objects_of_one_are_told(tmp_path: Path) -> None:
    path = tmp_path / "masks.json"
    first, second, _ = masks()
    path.write_text(json.dumps([annotation(0, first, 3), annotation(0, second & ~first, 4), annotation(1, first, 3)]))
    (picture, _) = MaskJson(path, (14, 10)).pictures()
    assert np.array_equal(picture == 3, first)
    assert np.array_equal(picture == 4, second & ~first)
    path.write_text(json.dumps([annotation(5, first, 3), annotation(5, second, 3)]))
    assert MaskJson(path, (14, 10)).several == "frame 5 has 2 objects of category 3"


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{", "not valid JSON"),
        ("[]", "holds no masks"),
        ("3", "must be a COCO dataset"),
        ('{"info": 1}', "must be a COCO dataset"),
        ('{"images": [{"id": 0, "width": 3, "height": 3}], "annotations": []}', "'0' is 3x3 pixels, not 14x10"),
        ('[{"image_id": 0, "category_id": -1, "segmentation": []}]', "'category_id' must be 1 to 65535"),
    ],
)
def test_other_files_are_one_line(tmp_path: Path, content: str, message: str) -> None:
    path = tmp_path / "masks.json"
    path.write_text(content)
    with pytest.raises(DatasetError, match=message) as caught:
        MaskJson(path, (14, 10))
    assert "\n" not in str(caught.value)


def test_polygons_alone_say_no_size(tmp_path: Path) -> None:
    path = tmp_path / "masks.json"
    path.write_text(json.dumps([{"image_id": 0, "category_id": 1, "segmentation": [[2, 2, 8, 2, 8, 6, 2, 6]]}]))
    assert MaskJson(path).size is None
    with pytest.raises(DatasetError, match="says no size of the pictures"):
        next(MaskJson(path).pictures())
    (picture,) = MaskJson(path, (14, 10)).pictures()
    assert int((picture > 0).sum()) >= 24
