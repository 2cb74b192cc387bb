"""The trackers pycma, xnes, adam and adam-mitsuba on short synthetic sequences."""

from __future__ import annotations

import json
import os
import pickle
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support import observe, resting_state, scene_of

from surgbench.camera import Camera
from surgbench.contract import InstrumentTracker, Observation, Scene, Trace
from surgbench.errors import SurgbenchError
from surgbench.geometry import FloatArray
from surgbench.objective import LossWeights, Objective
from surgbench.rendering import backends as mitsuba_backends
from surgbench.trackers.adam import AdamTracker
from surgbench.trackers.adam_mitsuba import AdamMitsubaTracker
from surgbench.trackers.cmaes import CmaesTracker
from surgbench.trackers.pycma import PycmaTracker
from surgbench.trackers.xnes import XnesTracker

TRACKERS: list[Callable[[], Any]] = [PycmaTracker, XnesTracker, AdamTracker]
SAMPLING: list[Callable[[], Any]] = [PycmaTracker, XnesTracker]


def two_arms() -> FloatArray:
    left, right = resting_state(), resting_state()
    left[[2, 3]], right[[2, 3]] = [0.8, -0.02], [-0.8, 0.025]
    return np.concatenate([left, right])


def frames(camera: Camera, arms: int = 1, count: int = 4) -> tuple[Scene, list[Observation]]:
    """Frames whose search begins about one natural step away from the truth."""
    scene = scene_of(camera, arms)
    first = resting_state() if arms == 1 else two_arms()
    drift = np.tile([0.005, 0.03, 0.005, 5e-4, 5e-4, 5e-4, 0.02, 0.02, 0.01], arms)
    away = np.tile([0.01, -0.1, 0.01, 1e-3, -1e-3, 1e-3, 0.1, 0.1, 0.05], arms)
    seen = [observe(scene, first + k * drift, k) for k in range(count)]
    return scene, [replace(frame, start=frame.start + away) for frame in seen]


def run(tracker: InstrumentTracker, scene: Scene, seen: list[Observation], seed: int = 0) -> FloatArray:
    tracker.reset(scene, seen[0].start, np.random.default_rng(seed))
    return np.array([tracker.step(frame).state for frame in seen])  # type: ignore[union-attr]


@pytest.mark.slow
@pytest.mark.parametrize("arms", [1, 2])
@pytest.mark.parametrize("make", TRACKERS)
def test_a_tracker_lowers_the_loss(make: Callable[[], Any], arms: int, camera: Camera) -> None:
    scene, seen = frames(camera, arms)
    estimates = run(make(), scene, seen)
    assert estimates.shape == (len(seen), 9 * arms)
    objective = Objective(scene, LossWeights())
    before, after = [], []
    for frame, estimate in zip(seen, estimates, strict=True):
        objective.observe(frame)
        start, end = objective(np.stack([frame.start, estimate]))[0]
        before.append(start)
        after.append(end)
    assert (np.array(after) < np.array(before)).all()
    assert np.mean(after) < 0.7 * np.mean(before)


@pytest.mark.parametrize("make", TRACKERS)
def test_readings_keep_the_joints_near(make: Callable[[], Any], small_camera: Camera) -> None:
    """Joints have a tenth of the freedom where they are read."""
    scene, seen = frames(small_camera, count=2)
    free = run(make(), scene, seen)
    read = run(make(), scene, [replace(frame, joints=frame.start[6:]) for frame in seen])
    moved, held = (np.abs(states - [frame.start for frame in seen])[:, 6:].mean() for states in (free, read))
    assert held < 0.3 * moved


@pytest.mark.parametrize("make", SAMPLING)
def test_the_same_seed_gives_the_same_result(make: Callable[[], Any], small_camera: Camera) -> None:
    scene, seen = frames(small_camera, count=2)
    one, again, other = (run(make(), scene, seen, seed) for seed in (0, 0, 1))
    np.testing.assert_array_equal(one, again)
    assert not np.array_equal(one, other)


@pytest.mark.parametrize("arms", [1, 2])
@pytest.mark.parametrize("make", TRACKERS)
def test_empty_and_full_masks_make_no_nan(make: Callable[[], Any], arms: int, small_camera: Camera) -> None:
    scene, seen = frames(small_camera, arms, count=1)
    tracker = make()
    tracker.reset(scene, seen[0].start, np.random.default_rng(0))
    for fill in (False, True):
        mask = np.full_like(seen[0].mask, fill)
        estimate = tracker.step(replace(seen[0], views=(replace(seen[0].views[0], mask=mask),)))
        assert np.isfinite(estimate.state).all()
        assert np.all(estimate.lost)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("make", TRACKERS)
def test_tips_behind_the_camera_are_no_trouble(
    make: Callable[[], Any], small_camera: Camera, capfd: pytest.CaptureFixture[str]
) -> None:
    """Every candidate has an infinite loss: no NaN, and not a word."""
    scene, seen = frames(small_camera, count=1)
    tips = (np.array([[40.0, 30.0], [44.0, 32.0]]),)
    behind = seen[0].start.copy()
    behind[5] = -0.1
    lost = replace(seen[0], start=behind, views=(replace(seen[0].views[0], keypoints=tips),))
    assert np.isfinite(run(make(), scene, [lost])).all()
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("make", TRACKERS)
def test_a_tracker_can_be_sent_to_another_process_in_the_middle(make: Callable[[], Any], small_camera: Camera) -> None:
    scene, seen = frames(small_camera, count=2)
    tracker = make()
    tracker.reset(scene, seen[0].start, np.random.default_rng(0))
    tracker.step(seen[0])
    moved = pickle.loads(pickle.dumps(tracker))
    np.testing.assert_array_equal(moved.step(seen[1]).state, tracker.step(seen[1]).state)


# --- pycma


def test_pycma_leaves_numpys_global_generator_alone(small_camera: Camera) -> None:
    """The package seeds it unless it is told not to."""
    scene, seen = frames(small_camera, count=1)
    before = np.random.get_state()  # noqa: NPY002
    run(PycmaTracker(), scene, seen)
    after = np.random.get_state()  # noqa: NPY002
    assert all(np.array_equal(one, other) for one, other in zip(before, after, strict=True))


def test_pycma_first_looks_where_cmaes_looks(small_camera: Camera) -> None:
    """The same normals of the same Sobol sequence: the first generations differ by what the package calls a hack."""
    scene, seen = frames(small_camera, count=1)
    first = []
    for tracker in (CmaesTracker(), PycmaTracker()):
        tracker.trace = Trace()
        run(tracker, scene, seen)
        states = tracker.trace.states[0]
        first.append(states[np.argsort(states[:, 0])])
    np.testing.assert_allclose(first[1], first[0], atol=1e-3)


@pytest.mark.parametrize("options", [{"elites": 1}, {"elites": 70}, {"population": 4}, {"covariance_rate": 100.0}])
def test_pycma_never_breaks_its_covariance(options: dict[str, Any], small_camera: Camera) -> None:
    scene, seen = frames(small_camera, count=3)
    config = PycmaTracker.Config(**options, iterations=10)
    assert np.isfinite(run(PycmaTracker(config), scene, seen)).all()


# --- adam


def test_adam_moves_a_joint_off_its_limit(camera: Camera) -> None:
    """With the cosine, whose slope is zero there."""
    scene = scene_of(camera)
    truth = resting_state()
    closed = truth.copy()
    closed[8] = scene.limits[0].lower_rad[2]
    tracker = AdamTracker(AdamTracker.Config(joints="cosine", estimate="last"))
    estimate = run(tracker, scene, [replace(observe(scene, truth), start=closed)])[0]
    assert estimate[8] > closed[8] + 2.5e-4


def test_clamped_joints_stay_on_their_limits(camera: Camera) -> None:
    """However far a step would carry them."""
    scene = scene_of(camera)
    truth = resting_state()
    frame = replace(observe(scene, truth), start=truth)
    config = AdamTracker.Config(learning_rate=100.0, iterations=3, estimate="last")
    tracker = AdamTracker(config)
    tracker.trace = Trace()
    run(tracker, scene, [frame])
    limits = scene.limits[0]
    joints = np.array(tracker.trace.states)[:, 0, 6:]
    assert (joints >= limits.lower_rad).all()
    assert (joints <= limits.upper_rad).all()
    assert np.isin(joints, [limits.lower_rad, limits.upper_rad]).any()


def test_adam_takes_the_last_state_or_the_best(camera: Camera) -> None:
    """With a large step it overshoots, and its best state is not its last."""
    scene, seen = frames(camera, count=1)
    losses = {}
    for estimate in ("last", "best"):
        config = AdamTracker.Config(learning_rate=3.0, iterations=7, estimate=estimate)
        tracker = AdamTracker(config)
        tracker.trace = Trace()
        state = run(tracker, scene, seen)[0]
        assert len(tracker.trace.states) == 8
        objective = Objective(scene, LossWeights())
        objective.observe(seen[0])
        losses[estimate] = float(objective(state[None])[0][0])
    assert losses["best"] == min(float(loss[0]) for loss in tracker.trace.losses)
    assert losses["best"] < losses["last"]


# --- adam-mitsuba


def test_mitsubas_backends_are_asked_without_loading_them() -> None:
    import drjit

    found = mitsuba_backends.llvm_version()
    here = drjit.detail.llvm_version()
    assert (found or (-1, -1, -1)) == tuple(here)


def test_adam_mitsuba_refuses_an_llvm_that_kills(monkeypatch: pytest.MonkeyPatch, small_camera: Camera) -> None:
    monkeypatch.setattr("surgbench.trackers.adam_mitsuba.cuda_problem", lambda: "no GPU")
    monkeypatch.setattr(mitsuba_backends, "llvm_version", lambda: (17, 0, 6))
    assert AdamMitsubaTracker.unavailable() is None
    for version, found in (((16, 0, 6), "16.0.6"), (None, "none that loads")):
        monkeypatch.setattr(mitsuba_backends, "llvm_version", lambda version=version: version)
        reason = str(AdamMitsubaTracker.unavailable())
        assert f"needs LLVM 17 or later, found {found}" in reason
        assert "\n" not in reason
        with pytest.raises(SurgbenchError, match=r"tracker 'adam-mitsuba' needs LLVM 17"):
            AdamMitsubaTracker().reset(scene_of(small_camera), resting_state(), np.random.default_rng(0))
    monkeypatch.setattr("surgbench.trackers.adam_mitsuba.cuda_problem", lambda: None)
    assert AdamMitsubaTracker.unavailable() is None


MITSUBA_SCRIPT = """
import json
from test_optimising_trackers import *
from surgbench.state import STATE_SCALE
from surgbench.trackers.optimisers.projective import ProjectiveObjective

camera = Camera(width=175, height=123, fx=226.5, fy=215.0, cx=73.4, cy=59.4)  # two focal lengths
answer = {}
for arms in (1, 2):
    scene, (frame,) = frames(camera, arms, count=1)
    tips = tuple(camera.project(scene.instruments[0].tips_cam(part)) + 20.0 for part in frame.start.reshape(arms, 9))
    frame = replace(frame, views=(replace(frame.views[0], keypoints=tips),))
    slopes = []
    for objective in (
        Objective(scene, LossWeights()),
        ProjectiveObjective(scene, LossWeights(), "llvm_ad_rgb", np.random.default_rng(0)),
    ):
        objective.observe(frame)
        slopes.append(objective.gradient(frame.start[None])[0] * np.tile(STATE_SCALE, arms))
    one, other = slopes
    answer[f"cosine{arms}"] = float(one @ other / np.linalg.norm(one) / np.linalg.norm(other))
    answer[f"ratio{arms}"] = float(np.linalg.norm(other) / np.linalg.norm(one))

scene, (frame,) = frames(camera, count=1)
objective = Objective(scene, LossWeights())
objective.observe(frame)
tracker = AdamMitsubaTracker(AdamMitsubaTracker.Config(iterations=4))
one, again = (run(tracker, scene, [frame])[0] for _ in range(2))
answer["lower"] = bool(np.diff(objective(np.stack([frame.start, one]))[0])[0] < 0)
answer["same"] = bool(np.array_equal(one, again))
moved = pickle.loads(pickle.dumps(tracker))
answer["moved"] = bool(np.array_equal(moved.step(frame).state, tracker.step(frame).state))
hidden = replace(frame, start=frame.start - 0.3 * np.eye(9)[5])  # behind the camera
masks = np.zeros_like(frame.mask), np.ones_like(frame.mask)
odd = [hidden, *(replace(frame, views=(replace(frame.views[0], mask=mask),)) for mask in masks)]
answer["finite"] = all(bool(np.isfinite(tracker.step(one).state).all()) for one in odd)
print(json.dumps(answer))
"""


@pytest.mark.slow
def test_adam_mitsuba_follows_the_gradient_of_the_engine() -> None:
    """In a process of its own: Mitsuba's variant and Dr.Jit's threads are set for a whole process."""
    problem = mitsuba_backends.llvm_problem()
    if problem is not None:
        pytest.skip(problem)
    done = subprocess.run(
        [sys.executable, "-c", MITSUBA_SCRIPT],
        capture_output=True,
        text=True,
        check=False,
        cwd=Path(__file__).parent,
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parents[1])},
    )
    assert done.returncode == 0, done.stderr
    answer = json.loads(done.stdout.splitlines()[-1])
    for arms in (1, 2):
        assert answer[f"cosine{arms}"] > 0.99
        assert answer[f"ratio{arms}"] == pytest.approx(1.0, abs=0.1)
    assert {key: answer[key] for key in ("lower", "same", "moved", "finite")} == dict.fromkeys(
        ("lower", "same", "moved", "finite"), True
    )
