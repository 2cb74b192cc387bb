"""What the benchmark of real recordings says of a tracker without truth, where the numbers are known."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from support import resting_state

from surgbench.state import JOINTS, STATE_SIZE, twin
from surgbench.tasks.instrument.conformance.scenes import make_play

SCRIPT = Path(__file__).parents[2] / "benchmarks" / "real_recordings.py"


@pytest.fixture(scope="module")
def script() -> ModuleType:
    if not SCRIPT.is_file():
        pytest.skip("a wheel holds no benchmarks")
    spec = importlib.util.spec_from_file_location("real_recordings", SCRIPT)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_twins_do_not_count_as_unsteadiness(script: ModuleType) -> None:
    """Neither a seed that found the other twin nor a track that changes over to it has any spread."""
    track = np.tile(resting_state(), (4, 1))
    changing = np.where(np.arange(4)[:, None] < 2, track, twin(track))
    joints = script.same_twins(np.stack([changing, track, twin(track)]))[..., JOINTS]
    np.testing.assert_allclose(joints, np.broadcast_to(track[:, JOINTS], joints.shape), atol=1e-12)


def test_readings_are_those_of_either_twin(script: ModuleType) -> None:
    readings = np.array([[0.7, -0.3, 0.6], [0.7, -0.3, 0.6], [0.7, -0.3, 0.6]])
    states = np.zeros((3, STATE_SIZE))
    states[:, JOINTS] = readings + np.array([0.1, 0.0, 0.0])
    states[1] = twin(states[1])
    states[2, JOINTS] *= [-1.0, 1.0, 1.0]  # one joint reversed alone is no twin
    off = script.off_readings(states, readings)
    np.testing.assert_allclose(off[:2], [[0.1, 0.0, 0.0]] * 2, atol=1e-12)
    assert off[2].max() > 0.5


def test_edge_on_is_where_the_outline_tells_little_of_yaw(script: ModuleType) -> None:
    information = np.array([[9.0, 10.0, 2.0, 11.0, 2.0], [9.0, 10.0, 2.0, 11.0, 12.0], [9.0, 10.0, 2.0, 11.0, 12.0]])
    np.testing.assert_array_equal(script.seen_edge_on(information), [False, False, True, False, False])


def test_a_state_is_judged_by_its_mask_and_jaws(script: ModuleType) -> None:
    """The true state has no error; with its jaws shut it leaves jaws unexplained, and far off no mask agrees."""
    play = make_play()
    data = type("Data", (), {"instruments": play.scene.instruments, "camera": play.scene.views[0].camera})()
    judge, mask, truth = script.Judge(data), play.observations[0].views[0].mask, play.truth[0]
    right = judge(truth, mask)
    assert right.mask_error == 0.0
    assert right.jaws_unexplained < script.EXPLAINED
    shut = truth.copy()
    shut[7], shut[8] = truth[7] - truth[8], 0.0
    assert judge(shut, mask).jaws_unexplained > script.EXPLAINED
    away = truth + np.array([0, 0, 0, 0.05, 0, 0, 0, 0, 0])
    assert judge(away, mask).mask_error > 0.9
    assert judge(truth, np.zeros_like(mask)).jaws_unexplained > script.EXPLAINED


def test_stretches_are_told_by_their_ends(script: ModuleType) -> None:
    assert script._stretches(np.array([True, True, False, True])) == "0-1, 3"
    assert script._stretches(np.zeros(3, dtype=bool)) == "none"
