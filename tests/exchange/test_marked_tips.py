"""``tips.csv``: tips that were not seen, and fractions of the picture."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from surgbench.camera import Camera
from surgbench.errors import DatasetError
from surgbench.geometry import FloatArray
from surgbench.recordings.tips import read_tips

CAMERA = Camera(width=640, height=480, fx=600, fy=600, cx=319.5, cy=239.5)


def write(path: Path, rows: list[str], header: str = "frame,u1,v1,u2,v2") -> Path:
    path.write_text("\n".join([header, *rows]) + "\n")
    return path


@pytest.mark.parametrize("unseen", ["0,0", "0.0,0.00", "-1,-1", ",", "nan,nan"])
def test_a_tip_at_the_corner_was_not_seen(tmp_path: Path, unseen: str) -> None:
    found = read_tips(write(tmp_path / "tips.csv", [f"0,320,240,{unseen}", f"1,{unseen},{unseen}"]), [0, 1, 2], CAMERA)
    assert found is not None
    assert found.points is not None
    np.testing.assert_array_equal(found.points[0], [[320, 240], [np.nan, np.nan]])
    assert np.isnan(found.points[1:]).all()
    assert found.note.startswith("tips.csv: 1 tips in 1 frames, pixels")


def test_where_no_tip_was_ever_seen_there_are_none(tmp_path: Path) -> None:
    found = read_tips(write(tmp_path / "tips.csv", ["0,0,0,0,0", "1,0,0,0,0"]), [0, 1], CAMERA)
    assert found is not None
    assert found.points is None
    assert "no tip was seen in any frame" in found.note
    assert read_tips(tmp_path / "none.csv", [0], CAMERA) is None


@given(st.lists(st.tuples(*[st.floats(0.001, 0.999)] * 4), min_size=1, max_size=5))
@settings(max_examples=40, deadline=None)
def test_fractions_are_refused_and_scaled_when_told(
    tmp_path_factory: pytest.TempPathFactory, fractions: list[tuple[float, float, float, float]]
) -> None:
    numbers = range(len(fractions))
    rows = [",".join([str(frame), *map(repr, row)]) for frame, row in enumerate(fractions)]
    path = write(tmp_path_factory.mktemp("tips") / "tips.csv", rows)
    with pytest.raises(DatasetError, match="--tips-unit fraction"):
        read_tips(path, numbers, CAMERA)
    told = read_tips(path, numbers, CAMERA, "fraction")
    assert told is not None
    assert told.points is not None
    expected: FloatArray = np.array(fractions).reshape(-1, 2, 2) * [640, 480] - 0.5
    np.testing.assert_allclose(told.points, expected)
    as_pixels = read_tips(path, numbers, CAMERA, "px")
    assert as_pixels is not None
    assert as_pixels.points is not None
    np.testing.assert_allclose(as_pixels.points, np.array(fractions).reshape(-1, 2, 2))


def test_pixels_are_no_fractions(tmp_path: Path) -> None:
    path = write(tmp_path / "tips.csv", ["0,0.5,0.5,0.4,0.4", "7,347.5,0.5,0.4,0.4"])
    with pytest.raises(DatasetError, match=r"frame 7: 347.5 is no fraction of the picture; leave --tips-unit fraction"):
        read_tips(path, [0, 7], CAMERA, "fraction")


@pytest.mark.parametrize(
    "header",
    ["frame,u1,v1,u2,v2", "Frame, X1 ,Y1,x2,y2", "frame,tip1_x,tip1_y,tip2_x,tip2_y", "frame,u1_px,v1 [px],U2,V2"],
)
def test_columns_by_their_usual_names(tmp_path: Path, header: str) -> None:
    found = read_tips(write(tmp_path / "tips.csv", ["0,1,2,3,4"], header), [0], CAMERA)
    assert found is not None
    np.testing.assert_array_equal(found.points, [[[1, 2], [3, 4]]])


@pytest.mark.parametrize("header", ["frame,u1,v1,u2", "frame,a,b,c,d", "frame,u1,v1,x1,y1"])
def test_other_columns_are_refused(tmp_path: Path, header: str) -> None:
    with pytest.raises(DatasetError, match=r"line 1 must be 'frame,u1,v1,u2,v2'|are the same column"):
        read_tips(write(tmp_path / "tips.csv", [",".join("01234"[: header.count(",") + 1])], header), [0], CAMERA)
