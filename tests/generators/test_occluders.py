"""Occluders hide as much as their levels say, and a set preset crosses and is told apart from others."""

from __future__ import annotations

import numpy as np
import pytest

from surgbench.generators.occluders import InTheWay, _ends_px, drawn_back_by, drawn_outside, put_in_the_way
from surgbench.generators.place import BoolArray, Place, clearance_m
from surgbench.generators.presets import PAPER_CAMERA, Preset, load_preset
from surgbench.generators.sections import Occluders
from surgbench.generators.seen_tips import seen_tips
from surgbench.generators.trajectories import PairMotion, make_motion, make_pair
from surgbench.geometry import FloatArray
from surgbench.instrument import load_instrument
from surgbench.randomness import generator
from surgbench.silhouette import SilhouetteEvaluator, VisibilityEvaluator
from surgbench.state import POSITION
from surgbench.tasks.instrument.format import ARMS

DRIVER = load_instrument("large_needle_driver")
FRAMES = 300


@pytest.fixture(scope="module")
def states() -> FloatArray:
    pair: FloatArray = make_pair(load_preset("paper-wide"), DRIVER, "nominal", FRAMES, generator(test="occluders"))
    return pair


@pytest.mark.slow
@pytest.mark.parametrize("name", ["tissue", "dropout"])
def test_a_level_is_the_share_of_the_arms_ends_that_is_hidden(states: FloatArray, name: str) -> None:
    points = _ends_px(states, DRIVER, PAPER_CAMERA).reshape(FRAMES, -1, 2)
    hidden = {}
    for level in (0.1, 0.4):
        settings = Occluders.model_validate({name: level})
        way = put_in_the_way(settings, states, DRIVER, PAPER_CAMERA, 1 / 30, sequence="000")
        masks = np.stack([way.hidden(frame, PAPER_CAMERA) for frame in range(0, FRAMES, 5)])
        pixels = np.rint(points[::5])
        seen = np.isfinite(pixels[..., 0])
        place = np.nan_to_num(pixels).astype(int)
        covered = masks[np.arange(len(masks))[:, None], place[..., 1], place[..., 0]]
        assert covered[seen].mean() == pytest.approx(level, abs=0.04)
        hidden[level] = masks
    # The level changes the size, and nothing else.
    assert (hidden[0.1] & ~hidden[0.4]).sum() <= 0.02 * hidden[0.1].sum()
    assert not put_in_the_way(Occluders(), states, DRIVER, PAPER_CAMERA, 1 / 30).hidden(0, PAPER_CAMERA).any()


@pytest.mark.slow
def test_a_third_tool_is_there_for_about_its_share_of_the_frames(states: FloatArray) -> None:
    shares = []
    for sequence in ("000", "001", "002"):
        way = put_in_the_way(
            Occluders(third_tool=0.5), states, DRIVER, PAPER_CAMERA, 1 / 30, dataset=0, sequence=sequence
        )
        third = [way.third_state(frame) for frame in range(FRAMES)]
        shares.append(np.mean([state is not None for state in third]))
        there = [state for state in third if state is not None]
        assert np.isfinite(there).all()
        evaluator = SilhouetteEvaluator([DRIVER], PAPER_CAMERA)
        assert np.mean([evaluator.mask(state).any() for state in there[::10]]) > 0.7
    assert np.mean(shares) == pytest.approx(0.5, abs=0.2)


@pytest.mark.slow
def test_arms_outside_are_drawn_back_by_as_much_as_asked(states: FloatArray) -> None:
    preset = load_preset("paper-wide")
    places = [Place(arm, preset.workspace, preset.camera, DRIVER) for arm in ARMS]
    back = None
    for attempt in range(20):
        back = drawn_outside(0.5, places, states, generator(test=attempt))
        if back is not None:
            break
    assert back is not None
    moved = drawn_back_by(states, back)
    farthest = back[:, 0].argmax()
    links = DRIVER.link_transforms(moved[farthest, 0])
    points = np.concatenate(
        [
            mesh.vertices_m @ links[DRIVER.link_index[name], :3, :3].T + links[DRIVER.link_index[name], :3, 3]
            for name, mesh in DRIVER.meshes.items()
            if name != "shaft"
        ]
    )
    assert (PAPER_CAMERA.project(points)[:, 0] < -0.5).mean() == pytest.approx(0.5, abs=0.03)
    assert np.array_equal(np.delete(moved, [3, 4, 5], axis=2), np.delete(states, [3, 4, 5], axis=2))


@pytest.mark.slow
@pytest.mark.parametrize(("name", "frames"), [("occlusion", 260), ("occlusion-long", 260), ("occlusion-rcm", 120)])
def test_arms_cross_clear_of_each_other_and_hide_each_others_jaws(name: str, frames: int) -> None:
    preset = load_preset(name)
    motion = make_motion(preset, DRIVER, "fast", frames, generator(test="crossing"))
    gaps = clearance_m(DRIVER, motion.states[:, 0], motion.states[:, 1])
    assert gaps.min() >= preset.workspace.clearance_m
    overlapping, hidden = crossed(motion, preset)
    assert preset.motion.crossing is not None
    assert overlapping.mean() == pytest.approx(preset.motion.crossing.share, abs=0.25)
    assert hidden.any(axis=1).sum() >= 5
    tips = seen_tips(motion.states[::2], DRIVER, preset.camera, InTheWay())
    assert tips[~overlapping].all()
    assert tips[hidden].mean() < 0.3
    # The arm behind is hidden by one that is nearer, not by one that it runs into.
    assert np.linalg.norm(np.diff(motion.states[..., POSITION], axis=0), axis=-1).max() < 0.003


@pytest.mark.slow
def test_what_is_outside_does_not_change_how_arms_move_otherwise() -> None:
    preset = load_preset("paper-dual")
    plain = make_motion(preset, DRIVER, "nominal", 120, generator(test=3))
    away = load_preset("paper-dual", settings={"occluders.outside": 0.6})
    drawn = make_motion(away, DRIVER, "nominal", 120, generator(test=3))
    assert np.array_equal(plain.states[..., :3], drawn.states[..., :3])
    assert not np.array_equal(plain.states[..., POSITION], drawn.states[..., POSITION])


@pytest.mark.slow
def test_a_whole_arm_that_is_outside_is_where_its_joints_say() -> None:
    settings = {"instances.swap_rate": 0.0, "occluders.outside": 0.5}
    motion = make_motion(load_preset("paper-rcm", settings=settings), DRIVER, "nominal", 150, generator(test=1))
    for index, own in enumerate(motion.arms):
        assert own is not None
        wrist = own.T_cam_base @ own.arm.forward(own.arm_joints)
        assert np.abs(wrist[:, :3, 3] - motion.states[:, index, POSITION]).max() < 1e-9
        assert own.arm.within_limits(own.arm_joints).all()


def crossed(motion: PairMotion, preset: Preset) -> tuple[BoolArray, BoolArray]:
    """Of every second frame, whether the arms overlap, and whether at most a tenth of an arm's jaws is seen."""
    evaluator = VisibilityEvaluator([DRIVER] * 2, preset.camera)
    body = type(DRIVER)(DRIVER.spec, {name: mesh for name, mesh in DRIVER.meshes.items() if name != "shaft"})
    tool = SilhouetteEvaluator([body], preset.camera)
    overlapping, hidden = [], []
    for states in motion.states[::2]:
        alone, seen = evaluator.silhouettes(states.ravel()), evaluator.visible_masks(states.ravel())
        overlapping.append(bool((alone[0] & alone[1]).any()))
        tools = [tool.mask(state) for state in states]
        hidden.append([(mask & own).sum() <= 0.1 * mask.sum() for mask, own in zip(tools, seen, strict=True)])
    return np.array(overlapping), np.array(hidden)
