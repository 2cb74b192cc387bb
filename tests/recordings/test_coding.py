"""What masks mean: decided once over a recording, refused with the option that tells it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from surgbench.errors import ConfigError, SurgbenchError
from surgbench.geometry import FloatArray
from surgbench.recordings.coding import WHOLE, Told, read_coding
from surgbench.recordings.labels import (
    colour_code,
    parse_codes,
    parse_instances,
    pixel_codes,
    write_codes,
    write_instances,
)

SHAPE = (12, 20)


class Given:
    """Masks in memory."""

    def __init__(self, *pictures: NDArray[Any], lossy: str | None = None, several: str | None = None) -> None:
        self.place = Path("masks")
        self.size = (SHAPE[1], SHAPE[0])
        self.numbers = list(range(len(pictures)))
        self.names = [str(number) for number in self.numbers]
        self.times_s: FloatArray | None = None
        self.lossy, self.several = lossy, several
        self._pictures = pictures

    def pictures(self) -> Iterator[NDArray[Any]]:
        return iter(self._pictures)


def instrument(frame: int = 0, where: int = 0) -> NDArray[np.bool_]:
    mask = np.zeros(SHAPE, dtype=bool)
    mask[3 + where : 6 + where, : 8 + frame] = True
    return mask


def painted(values: Mapping[int, NDArray[np.bool_]], dtype: Any = np.uint8, ground: int = 0) -> NDArray[Any]:
    picture = np.full(SHAPE, ground, dtype)
    for value, mask in values.items():
        picture[mask] = value
    return picture


def with_alpha(grey: NDArray[np.uint8], alpha: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return np.dstack([grey, grey, grey, alpha])


FRAMES = [instrument(k) for k in range(4)]
WHITE = np.full(SHAPE, 255, np.uint8)


@pytest.mark.parametrize(
    ("pictures", "said"),
    [
        ([painted({255: m}) for m in FRAMES], "values {0, 255}"),
        ([painted({1: m}) for m in FRAMES], "values {0, 1}"),
        ([painted({5: m}) for m in FRAMES], "values {0, 5}, 5 is instrument"),
        ([painted({65535: m}, np.uint16) for m in FRAMES], "values {0, 65535}"),
        ([with_alpha(0 * WHITE, painted({255: m})) for m in FRAMES], "values {0, 255} (transparency)"),
        ([with_alpha(WHITE, painted({255: m})) for m in FRAMES], "values {0, 255} (transparency)"),
        ([with_alpha(painted({255: m}), painted({255: m})) for m in FRAMES], "values {0, 255}"),
        ([with_alpha(painted({255: m}), WHITE) for m in FRAMES], "values {0, 255}"),
        ([np.dstack([painted({}), painted({}), painted({64: m})]) for m in FRAMES], "values {0, 64/0/0}, 64/0/0 is"),
        # One frame without an instrument says nothing against the others.
        ([painted({}), *(painted({255: m}) for m in FRAMES[1:])], "values {0, 255}"),
    ],
)
def test_one_value_or_colour_is_the_instrument(pictures: list[NDArray[Any]], said: str) -> None:
    coding = read_coding(Given(*pictures), Told())
    assert coding.said.startswith(said)
    assert not coding.warnings
    for picture, mask in zip(pictures, FRAMES, strict=True):
        expected = mask if pixel_codes(picture[..., :3] if picture.ndim == 3 else picture).any() else 0 * mask
        if "transparency" in said:
            expected = mask
        assert np.array_equal(coding.masks(picture)[WHOLE], expected)


def test_labels_are_decided_over_the_whole_recording() -> None:
    """Class 1 in even frames and 2 in odd ones: each frame alone would look like a mask of one value."""
    pictures = [painted({1 + k % 2: mask}) for k, mask in enumerate(FRAMES)]
    with pytest.raises(ConfigError, match=r"values \{0, 1, 2\}.*--label 1,2 .*--instances 1=left,2=right"):
        read_coding(Given(*pictures), Told())
    coding = read_coding(Given(*pictures), Told(label=frozenset((1, 2))))
    assert all(np.array_equal(coding.masks(p)[WHOLE], m) for p, m in zip(pictures, FRAMES, strict=True))


@pytest.mark.parametrize(
    ("picture", "message"),
    [
        (painted({10: instrument(), 20: instrument(where=4)}), "--label 10,20 for parts of one"),
        (painted({255: instrument(), 1: instrument(where=6)[::-1]}), r"values {0, 1, 255}"),
        (painted({2: instrument()}, ground=1), r"--label 2 for parts"),
        (painted({}), r"no instrument in any of 1 masks: every pixel is 0"),
        (painted({}, ground=7), "every pixel is 7"),
        (painted({255: ~instrument()}), r"90\.0 % of all pixels would be instrument .*--invert; .*--label 255"),
        (
            with_alpha(painted({255: instrument()}), painted({255: instrument(3)})),
            "--channel alpha or --channel colour",
        ),
        (np.arange(240, dtype=np.uint8).reshape(SHAPE), "neither labels nor nearly black and white; --threshold 128"),
    ],
)
def test_what_does_not_fit_is_refused_with_the_option_that_tells_it(picture: NDArray[Any], message: str) -> None:
    with pytest.raises(SurgbenchError, match=message.replace("{", r"\{").replace("}", r"\}")) as caught:
        read_coding(Given(picture), Told())
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("told", "message"),
    [
        (Told(label=frozenset((7,))), "--label: 7 is in none of the masks"),
        (Told(ignore=frozenset((9,))), "--ignore: 9 is in none"),
        (Told(instances={"left": frozenset((3,))}), "--instances: 3 is in none"),
        (Told(threshold=300), r"--threshold 300: no pixel .*largest value is 255"),
        (Told(label=frozenset((1,)), threshold=3), "--label and --threshold cannot both"),
        (Told(label=frozenset((1,)), invert=True), "--invert says nothing beside --label"),
        (Told(label=frozenset((1,)), ignore=frozenset((1,))), "--label and --ignore both name 1"),
        (Told(channel="alpha"), "--channel alpha: the masks in masks have no transparency"),
    ],
)
def test_options_that_cannot_be_meant_are_refused(told: Told, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        read_coding(Given(painted({255: instrument()})), told)


def test_inverted_masks_are_turned_round() -> None:
    picture = painted({255: ~instrument()})
    assert np.array_equal(read_coding(Given(picture), Told(invert=True)).masks(picture)[WHOLE], instrument())
    coding = read_coding(Given(picture), Told(label=frozenset((255,))))  # it was meant
    assert np.array_equal(coding.masks(picture)[WHOLE], ~instrument())


def test_ignored_values_are_nothing() -> None:
    picture = painted({1: instrument(), 255: instrument(where=5)})
    coding = read_coding(Given(picture), Told(ignore=frozenset((255,))))
    assert np.array_equal(coding.masks(picture)[WHOLE], instrument())


@pytest.mark.parametrize(("dtype", "half"), [(np.uint8, 128), (np.uint16, 32768)])
def test_smeared_masks_are_cut_at_half_with_a_warning(dtype: Any, half: int) -> None:
    full = np.iinfo(dtype).max
    ramp = np.zeros(SHAPE)
    ramp[:, :10], ramp[2:8, 10] = 1.0, np.linspace(0.1, 0.9, 6)
    ramp[:9] = 0.0
    ramp[9:, 10] = (0.2, 0.6, 0.9)
    noisy = np.clip(ramp + np.random.default_rng(0).uniform(-0.02, 0.02, SHAPE), 0, 1)
    picture = np.rint(noisy * full).astype(dtype)
    coding = read_coding(Given(picture, lossy="JPEG" if dtype == np.uint8 else None), Told())
    (warning,) = coding.warnings
    assert f"pixels of at least {half} are taken for instrument (--threshold says otherwise)" in warning
    assert np.array_equal(coding.masks(picture)[WHOLE], picture >= half)
    told = read_coding(Given(picture), Told(threshold=half // 2))
    assert not told.warnings
    assert np.array_equal(told.masks(picture)[WHOLE], picture >= half // 2)


def test_colours_are_parts_of_one_instrument_unless_told() -> None:
    picture = np.zeros((*SHAPE, 3), np.uint8)
    picture[instrument()], picture[instrument(where=4)] = (0, 0, 255), (255, 0, 0)  # red and blue, in OpenCV's order
    coding = read_coding(Given(picture), Told())
    assert "--instances 0/0/255=left,255/0/0=right" in coding.warnings[0]
    assert np.array_equal(coding.masks(picture)[WHOLE], instrument() | instrument(where=4))
    told = Told(instances=parse_instances("255/0/0=left,0/0/255=right", "--instances", ("left", "right")))
    masks = read_coding(Given(picture), told).masks(picture)
    assert np.array_equal(masks["left"], instrument())
    assert np.array_equal(masks["right"], instrument(where=4))


def test_several_objects_of_a_kind_are_asked_about() -> None:
    source = Given(painted({1: instrument()}), several="frame 0 has 2 objects of category 1")
    with pytest.raises(ConfigError, match=r"2 objects of category 1; .* --label 1, two instruments with --arms both"):
        read_coding(source, Told())
    assert read_coding(source, Told(several=True)).groups == {WHOLE: frozenset((1,))}


CODES = st.integers(1, 255) | st.builds(colour_code, *[st.integers(0, 255)] * 3).filter(bool)


@given(st.sets(CODES, min_size=1, max_size=5), st.data())
def test_whatever_the_coding_named_values_come_back(codes: set[int], data: st.DataObject) -> None:
    """Any values or colours, any of them named: a pixel is instrument if and only if its value is named."""
    palette = np.array([0, *sorted(codes)])
    seed = data.draw(st.integers(0, 2**32 - 1))
    drawn = palette[np.random.default_rng(seed).integers(0, len(palette), (3, *SHAPE))]
    drawn[0].ravel()[: len(palette)] = palette  # all are there
    channels = [np.where(drawn < 1 << 48, drawn, drawn >> shift & 0xFFFF) for shift in (0, 16, 32)]
    pictures = list(np.stack(channels, axis=-1).astype(np.uint8))
    assert all(np.array_equal(pixel_codes(p), one) for p, one in zip(pictures, drawn, strict=True))
    named = data.draw(st.sets(st.sampled_from(sorted(codes)), min_size=1))
    text = write_codes(named, ",")
    told = Told(label=parse_codes(text, "--label"))
    assert told.label == named
    coding = read_coding(Given(*pictures), told)
    for picture, values in zip(pictures, drawn, strict=True):
        assert np.array_equal(coding.masks(picture)[WHOLE], np.isin(values, sorted(named)))


@given(st.dictionaries(st.sampled_from(("left", "right")), st.frozensets(CODES, min_size=1, max_size=3), min_size=1))
def test_instances_come_back_from_their_text(groups: dict[str, frozenset[int]]) -> None:
    if len(frozenset().union(*groups.values())) == sum(map(len, groups.values())):
        assert parse_instances(write_instances(groups), "--instances", ("left", "right")) == groups
    else:
        with pytest.raises(ConfigError, match="cannot be of two arms"):
            parse_instances(write_instances(groups), "--instances", ("left", "right"))


@pytest.mark.parametrize("text", ["", "red", "1,", "1/2", "70000", "1/2/3/4", "-1"])
def test_no_values_are_refused_with_an_example(text: str) -> None:
    with pytest.raises(ConfigError, match=r"--label: must be values \(5 or 1,2\) or colours as red/green/blue"):
        parse_codes(text, "--label")


def test_a_value_of_one_mask_alone_is_named_with_the_option_that_does_without() -> None:
    noise = painted({1: np.indices(SHAPE).sum(axis=0) % 3 == 0})
    masks = [painted({255: instrument(frame)}) for frame in range(5)]
    says = r"1 are 80 pixels in the mask of frame 2; without: --label 255\)"
    with pytest.raises(ConfigError, match=says):
        read_coding(Given(*masks[:2], noise, *masks[2:]), Told())
