"""What is seen of each arm, rendered, written and disturbed."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from surgbench.camera import Camera
from surgbench.dataset import tables
from surgbench.dataset.open import open_as
from surgbench.dataset.storage import file_entry
from surgbench.dataset.validate import validate
from surgbench.errors import ConfigError
from surgbench.generators.generate import generate, plan_dataset
from surgbench.generators.instances import swapped_frames, told_apart
from surgbench.generators.presets import CORRUPTION_LEVELS, Preset, load_preset
from surgbench.generators.sections import Instances, Occluders
from surgbench.generators.visible import ArmsRenderer
from surgbench.geometry import FloatArray
from surgbench.instrument import load_instrument
from surgbench.randomness import generator
from surgbench.silhouette import VisibilityEvaluator
from surgbench.tasks.instrument.dataset import InstrumentDataset
from surgbench.tasks.instrument.format import ARMS, visibility_path

DRIVER = load_instrument("large_needle_driver")
SMALL = Camera(width=175, height=123, fx=226.5, fy=224.0, cx=73.2, cy=59.3)
TOLD = Preset(
    name="told",
    pairs=1,
    frames=6,
    camera=SMALL,
    corruption=CORRUPTION_LEVELS["none"],
    instances=Instances(swap_rate=0.5, swap_frames=(2, 2)),
)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset whose masks are not corrupted, but exchanged in half of the frames."""
    out = tmp_path_factory.mktemp("made") / "told"
    assert generate(plan_dataset(TOLD), out)
    return out


arm_states = st.tuples(
    *[st.floats(-np.pi, np.pi)] * 3,
    *[st.floats(-0.03, 0.03)] * 2,
    st.floats(0.05, 0.15),
    *[st.floats(-1.39, 1.39)] * 2,
    st.floats(0, 0.7),
).map(np.array)


@pytest.mark.slow
@settings(max_examples=80)
@given(left=arm_states, right=arm_states, near=st.booleans())
def test_what_mitsuba_shows_of_each_arm_is_what_the_evaluator_does(
    left: FloatArray, right: FloatArray, near: bool
) -> None:
    if near:  # so that they cross, whatever else
        right[3:6] = left[3:6] + np.array([0.004, -0.003, 0.02])
    states = np.stack([left, right])
    renderer, evaluator = _renderers()
    seen = renderer.seen(states)
    assume(seen.union.any())
    assert np.count_nonzero(seen.visible != evaluator.visible_masks(states.ravel())) <= 2
    assert np.array_equal(seen.visible.any(axis=0), seen.union)
    assert not (seen.visible[0] & seen.visible[1]).any()
    assert not (seen.tools & ~seen.alone).any()
    fronts = [share["front"] for share in seen.shares()]
    if fronts[0] is not None and (seen.alone[0] & seen.alone[1]).sum() > 100:
        assert np.abs(evaluator.front_fractions(states.ravel()) - np.array(fronts)).max() <= 0.02


_made: list[tuple[ArmsRenderer, VisibilityEvaluator]] = []


def _renderers() -> tuple[ArmsRenderer, VisibilityEvaluator]:
    if not _made:
        camera = Camera(width=350, height=246, fx=453.0, fy=452.4, cx=146.9, cy=119.1)
        _made.append((ArmsRenderer(DRIVER, camera, 1, told_apart=True), VisibilityEvaluator([DRIVER] * 2, camera)))
    return _made[0]


def test_arms_are_exchanged_at_the_rate_and_for_as_long_as_asked() -> None:
    asked = Instances(swap_rate=0.2, swap_frames=(3, 9))
    swapped = np.stack([swapped_frames(asked, 1000, generator(test=index)) for index in range(60)])
    assert swapped.mean() == pytest.approx(0.2, abs=0.02)
    assert swapped[:, 0].mean() == pytest.approx(0.2, abs=0.15)  # from the first frame on
    edges = np.diff(swapped[0].astype(int))
    assert (edges == 1).sum() >= 15
    assert not swapped_frames(Instances(), 1000, generator(test=0)).any()


def test_a_pixel_of_both_noisy_masks_goes_to_the_arm_that_it_is_of() -> None:
    clean = np.array([[[1, 0, 0, 0]], [[0, 1, 0, 0]]], dtype=bool)
    noisy = np.array([[[1, 1, 1, 0]], [[1, 1, 1, 1]]], dtype=bool)
    one, other = told_apart(noisy, clean, generator(test="apart"))
    assert not (one & other).any()
    assert np.array_equal(one | other, noisy.any(axis=0))
    assert (one[0, 0], other[0, 1], other[0, 3]) == (True, True, True)


@pytest.mark.slow
def test_a_dataset_tells_what_is_seen_of_each_arm(made: Path, tmp_path: Path) -> None:
    assert validate(made) == []
    dataset = open_as(InstrumentDataset, made)
    sequence = dataset.sequences[0]
    evaluator = VisibilityEvaluator([DRIVER] * 2, SMALL)
    states = np.concatenate([state for arm in ARMS if (state := sequence.states(arm)) is not None], axis=1)
    told = {arm: shares for arm in ARMS if (shares := sequence.visibility(arm)) is not None}
    swapped = told["left"]["swapped"]
    assert 0 < swapped.sum() < 6
    for frame in range(sequence.frames):
        clean = np.stack([sequence.clean_mask(f"visible_{arm}", frame) for arm in ARMS])
        assert np.count_nonzero(clean != evaluator.visible_masks(states[frame])) <= 2
        seen = np.stack([sequence.mask(f"visible_{arm}", frame) for arm in ARMS])
        assert np.array_equal(seen, clean[::-1] if swapped[frame] else clean)
        for arm, mask in zip(ARMS, clean, strict=True):
            share = mask.sum() / sequence.clean_mask(arm, frame).sum()
            assert told[arm]["visible"][frame] == pytest.approx(share)


@pytest.mark.slow
def test_masks_that_older_presets_have_stay_what_they_are(made: Path, tmp_path: Path) -> None:
    plain = TOLD.model_copy(update={"instances": None})
    assert generate(plan_dataset(plain), tmp_path / "plain")
    one, other = (json.loads((folder / "dataset.json").read_text()) for folder in (made, tmp_path / "plain"))
    assert "visibility" not in other["sequences"][0]
    assert "instances" not in other["configuration"]["preset"]
    assert "occluders" not in other["configuration"]["preset"]
    assert other["files"].items() <= one["files"].items()


@pytest.mark.slow
def test_validation_doubts_what_is_no_share(made: Path, tmp_path: Path) -> None:
    bad = Path(shutil.copytree(made, tmp_path / "bad"))
    sequence = open_as(InstrumentDataset, made).sequences[0]
    columns = {f"{arm}_{name}": v.copy() for arm in ARMS for name, v in (sequence.visibility(arm) or {}).items()}
    columns["left_visible"][2] = 1.5
    columns["right_swapped"][3] = 0.5
    columns["left_front"][1] = 0.75
    file = visibility_path("000")
    data = tables.encode_table(columns)
    (bad / file).write_bytes(data)
    manifest = json.loads((bad / "dataset.json").read_text())
    manifest["files"][file] = file_entry(data).model_dump()
    (bad / "dataset.json").write_text(json.dumps(manifest))
    said = "\n".join(validate(bad))
    assert "frame 2: 'left_visible' is 1.5, no share" in said
    assert "frame 3: 'right_swapped' is 0.5, neither 0 nor 1" in said
    assert "frame 1: the arms' shares in front do not add up to 1" in said


def test_paper_dual_is_paper_told_apart() -> None:
    paper, dual = load_preset("paper"), load_preset("paper-dual")
    assert dual.model_copy(update={"name": "paper", "instances": None}) == paper
    assert plan_dataset(dual).sequences[0].kinds == ("left", "right", "both", "visible_left", "visible_right")


def test_occluders_need_to_say_what_they_hide() -> None:
    with pytest.raises(ConfigError, match="occluders needs the section instances"):
        load_preset("paper", settings={"occluders.tissue": 0.2})
    assert load_preset("paper-dual", settings={"occluders.tissue": 0.0}).occluders == Occluders()
