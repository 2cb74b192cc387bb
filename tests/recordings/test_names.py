"""Numbers in file names, and when frames were taken."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from surgbench.errors import ConfigError, DatasetError
from surgbench.recordings.names import check_stray, number_files, time_of_frames

PLACE = Path("masks")


def numbers(*names: str) -> list[int]:
    return list(number_files(map(Path, names)))


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (("000000.png", "000001.png"), [0, 1]),
        (("seq01_000_mask.png", "seq01_001_mask.png"), [0, 1]),
        (("seq01_007_mask.png",), [7]),
        (("frame12_v2.png", "frame13_v2.png"), [12, 13]),
        (("9.png", "10.png"), [9, 10]),
        (("1403636579763555584.png", "1403636579813555584.png"), [1403636579763555584, 1403636579813555584]),
        (("1403636579.763.png", "1403636580.5.png"), [1403636579763000000, 1403636580500000000]),
        (("1403636579_763555584.png", "1403636580_000000001.png"), [1403636579763555584, 1403636580000000001]),
        (("frame_12.png", "000003.png"), [3, 12]),
    ],
)
def test_the_number_of_a_frame_is_the_one_that_tells_names_apart(names: tuple[str, ...], expected: list[int]) -> None:
    assert numbers(*names) == expected


def test_names_without_a_number_or_with_the_same_are_refused() -> None:
    with pytest.raises(DatasetError, match=r"last\.png: its name must hold the frame's number"):
        numbers("000000.png", "last.png")
    with pytest.raises(DatasetError, match=r"m1\.png: is frame 1, and so is 000001\.png"):
        numbers("000001.png", "m1.png")


@given(st.lists(st.integers(0, 10**6), min_size=2, unique=True), st.sampled_from(("f{}", "s07_{}_m2", "{:06d}")))
def test_any_numbers_come_back_whatever_stands_around_them(found: list[int], pattern: str) -> None:
    if pattern == "s07_{}_m2" and len(found) == 1:
        return
    assert numbers(*(f"{pattern.format(number)}.png" for number in found)) == sorted(found)


def test_one_stray_number_is_named() -> None:
    with pytest.raises(DatasetError, match=r"999999999\.png: its number is far from .* \(0 to 4\)"):
        check_stray(number_files(Path(f"{k}.png") for k in (0, 1, 2, 3, 4, 999999999)))
    with pytest.raises(DatasetError, match=r"masks/3\.png: .* \(90000 to 90004\)"):
        check_stray(number_files(Path(f"masks/{k}.png") for k in (3, *range(90000, 90005))))
    for sound in ((0, 5, 10), (0, 1, 2, 900, 901), (0, 100000), (*range(300), *range(9000, 9300))):
        check_stray({number: Path(f"{number}.png") for number in sound})


def test_frames_that_follow_one_another_have_nothing_said_of_them() -> None:
    timing = time_of_frames([4, 5, 6], PLACE, fps=25.0)
    np.testing.assert_array_equal(timing.times_s, np.arange(3) / 25.0)
    assert (timing.dt_s, timing.fps, timing.said) == (1 / 25, 25.0, None)


def test_strides_and_gaps_keep_their_time() -> None:
    third = time_of_frames([0, 3, 6, 15], PLACE)
    np.testing.assert_allclose(third.times_s, [0, 0.1, 0.2, 0.5])
    assert third.dt_s == pytest.approx(0.1)
    assert third.said == "frames 0 to 15, one in 3, 0.1 s apart; 1 gaps, the longest of 0.3 s after 6"


@pytest.mark.parametrize(("unit", "per_second"), [("s", 1), ("ms", 10**3), ("us", 10**6), ("ns", 10**9)])
def test_times_since_1970_are_known_by_their_size(unit: str, per_second: int) -> None:
    stamps = [(1403636579 + 2 * k) * per_second for k in range(4)]
    timing = time_of_frames(stamps, PLACE)
    np.testing.assert_allclose(timing.times_s, [0, 2, 4, 6])
    assert timing.fps is None
    assert timing.said == f"names are times in {unit}, 2 s apart"
    with pytest.raises(ConfigError, match=f"--fps: the names in masks are times in {unit}"):
        time_of_frames(stamps, PLACE, fps=30.0)
    assert time_of_frames(stamps, PLACE, "frames", fps=30.0).fps == 30.0


def test_other_times_are_told() -> None:
    np.testing.assert_allclose(time_of_frames([0, 40, 80], PLACE, "ms").times_s, [0, 0.04, 0.08])
