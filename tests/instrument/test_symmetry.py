"""What turns an instrument into one that looks the same stands in its file, and everything goes by it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from support import resting_state

from surgbench.camera import Camera
from surgbench.errors import ConfigError
from surgbench.geometry import look_at_angles, rigid_transform, rotation_angle, rotation_from_vector
from surgbench.handeye.fit import HALF_TURN, NOMINAL, costs, nearest_alike, residuals, robust_fit
from surgbench.instrument import Instrument, load_instrument, save_instrument
from surgbench.metrics import choose_twin, interval_coverages, pose_errors
from surgbench.references import reference_joint_errors
from surgbench.state import ANGLES, BETA, JOINTS, Symmetry, twin
from surgbench.trackers.registration.proposals import Move, propose, widest_rolls

CAMERA = Camera(width=160, height=120, fx=200, fy=200, cx=80, cy=60)
TRUTH = np.stack([resting_state(), resting_state()])
TRUTH[1, JOINTS] = [0.4, -0.3, 0.2]
SYMMETRIES: tuple[Symmetry, ...] = ("twin", "none", "axis")
turns = st.tuples(*[st.floats(-2.0, 2.0)] * 3).map(lambda turn: rotation_from_vector(np.array(turn)))


def changed(folder: Path, **changes: Any) -> Instrument:
    """The built-in needle driver, with other keys."""
    [path, *_] = save_instrument(load_instrument("large_needle_driver"), folder)
    path.write_text(yaml.safe_dump({**yaml.safe_load(path.read_text()), **changes}))
    return load_instrument(path)


def test_a_file_says_it_or_it_is_a_twin(tmp_path: Path) -> None:
    assert load_instrument("large_needle_driver").symmetry == "twin"
    for symmetry in SYMMETRIES:
        own = changed(tmp_path, symmetry=symmetry)
        assert own.symmetry == symmetry
        # It travels with a dataset.
        [path, *_] = save_instrument(own, tmp_path / "copy")
        assert load_instrument(path).symmetry == symmetry
    with pytest.raises(ConfigError, match="symmetry"):
        changed(tmp_path, symmetry="mirror")


def test_only_a_twin_is_forgiven(tmp_path: Path) -> None:
    one, other = load_instrument("large_needle_driver"), changed(tmp_path, symmetry="none")
    estimate = twin(TRUTH)
    forgiven, counted = (pose_errors(each, CAMERA, estimate, TRUTH) for each in (one, other))
    assert not any(values.any() for values in forgiven.values())
    np.testing.assert_allclose(counted["rotation_error_rad"], np.pi)
    np.testing.assert_allclose(counted["q1_error_rad"], 2 * np.abs(TRUTH[:, 6]))
    assert (counted["tip_error_m"][1:] > 1e-3).all()
    assert choose_twin(estimate, TRUTH, "none") is not estimate
    np.testing.assert_array_equal(choose_twin(estimate, TRUTH, "none"), estimate)
    shares = [interval_coverages(estimate, np.full(9, 1e-3), TRUTH, symmetry=each.symmetry) for each in (one, other)]
    assert [float(share["interval_coverage_rotation"].mean()) for share in shares] == [1.0, pytest.approx(2 / 3)]
    readings = TRUTH[:, JOINTS]
    off = [
        reference_joint_errors(estimate, readings, each.search_limits, each.observed, each.symmetry)
        for each in (one, other)
    ]
    assert not off[0].any()
    np.testing.assert_allclose(off[1], np.abs(estimate[:, JOINTS] - readings))


def test_a_turn_of_a_tube_is_nothing(tmp_path: Path) -> None:
    tube = changed(tmp_path, symmetry="axis", observable=[])
    assert not tube.observed[BETA]
    errors = pose_errors(tube, CAMERA, TRUTH + np.eye(9)[BETA], TRUTH)
    np.testing.assert_allclose(errors["rotation_error_rad"], 0.0, atol=1e-7)


def test_one_tip_counts_once(tmp_path: Path) -> None:
    two = load_instrument("large_needle_driver")
    tip = two.spec.tips[0].model_dump(mode="json")
    one = changed(tmp_path, tips=[tip])
    assert (two.has_two_tips, one.has_two_tips) == (True, False)
    tips = one.tips_cam(TRUTH)
    np.testing.assert_array_equal(tips[:, 0], tips[:, 1])
    np.testing.assert_array_equal(tips[:, 0], two.tips_cam(TRUTH)[:, 0])
    estimate = TRUTH + 0.002 * np.eye(9)[3]
    errors = pose_errors(one, CAMERA, estimate, TRUTH)
    np.testing.assert_allclose(errors["tip_error_m"], 0.002)
    places = CAMERA.project(tips[:, 0])
    moved = CAMERA.project(one.tips_cam(estimate)[:, 0])
    np.testing.assert_allclose(errors["keypoint_error_px"], np.linalg.norm(moved - places, axis=1))


@given(turns, turns)
def test_the_nearest_that_looks_the_same(tracked: np.ndarray, expected: np.ndarray) -> None:
    left = {
        symmetry: float(rotation_angle(nearest_alike(tracked[None], expected[None], symmetry)[0].T @ expected))
        for symmetry in SYMMETRIES
    }
    own = float(rotation_angle(tracked.T @ expected))
    turned = float(rotation_angle((tracked @ HALF_TURN[:3, :3]).T @ expected))
    assert left["none"] == own
    assert left["twin"] == pytest.approx(min(own, turned), abs=1e-7)
    # What no turn about the shaft mends is the angle between the two shafts.
    between = np.arccos(np.clip(tracked[:, 2] @ expected[:, 2], -1.0, 1.0))
    assert left["axis"] == pytest.approx(between, abs=1e-6)


@pytest.mark.parametrize("symmetry", SYMMETRIES)
def test_a_hand_eye_transform_goes_by_it(symmetry: Symmetry) -> None:
    rng = np.random.default_rng(2)
    arm = rigid_transform(rotation_from_vector(0.5 * rng.standard_normal((60, 3))), 0.03 * rng.standard_normal((60, 3)))
    T_cam_base = rigid_transform(rotation_from_vector(np.array([0.3, -1.0, 0.4])), np.array([0.02, -0.01, 0.15]))
    about = np.zeros((60, 3))
    angles = {"twin": np.pi * (np.arange(60) % 2), "none": np.zeros(60), "axis": rng.uniform(-3, 3, 60)}
    about[:, 2] = angles[symmetry]
    turn = rigid_transform(rotation_from_vector(about), np.zeros((60, 3)))
    tracked = T_cam_base @ arm @ turn
    found = robust_fit(tracked, arm, NOMINAL, symmetry)
    np.testing.assert_allclose(found, T_cam_base, atol=1e-4)
    np.testing.assert_allclose(residuals(found, tracked, arm, symmetry), 0.0, atol=1e-4)
    assert costs(found, tracked, arm, NOMINAL, symmetry) == pytest.approx(0.0, abs=1e-4)
    if symmetry != "none":  # each of these would be half a turn off, or more
        assert costs(found, tracked, arm, NOMINAL, "none") > 1.0


def test_a_slip_is_looked_for_all_around_where_no_twin_looks_the_same(tmp_path: Path) -> None:
    one, other = load_instrument("large_needle_driver"), changed(tmp_path, symmetry="none")
    rolls = widest_rolls((one, other))
    assert rolls[0] < rolls[1] == np.pi
    limits = type(one.search_limits)(
        np.stack([one.search_limits.lower_rad] * 2), np.stack([one.search_limits.upper_rad] * 2)
    )
    states, moves = propose(np.tile(resting_state(), 2)[None], 400, limits, True, np.random.default_rng(0), rolls)
    turned = np.abs(states.reshape(-1, 2, 9)[moves == Move.TURN][..., BETA] - resting_state()[BETA]).max(axis=0)
    assert turned[0] < rolls[0] < 0.9 * np.pi < turned[1] < np.pi


def test_angles_of_a_state_turned_by_half_a_turn() -> None:
    turned = look_at_angles(_rotation(TRUTH[0]) @ HALF_TURN[:3, :3])
    np.testing.assert_allclose(np.exp(1j * turned), np.exp(1j * twin(TRUTH[0])[ANGLES]), atol=1e-12)


def _rotation(state: np.ndarray) -> np.ndarray:
    return load_instrument("large_needle_driver").link_transforms(state)[0, :3, :3]
