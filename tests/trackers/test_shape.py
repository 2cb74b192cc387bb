"""What is learned of an instrument and a camera that are not quite the declared ones."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from support import observe, resting_state, scene_of

from surgbench.camera import Camera
from surgbench.contract import Observation, Scene
from surgbench.generators.mismatch import real_instrument
from surgbench.generators.sections import Mismatch
from surgbench.geometry import FloatArray
from surgbench.silhouette import SilhouetteEvaluator
from surgbench.trackers.hybrid import HybridTracker
from surgbench.trackers.registration.edges import find_edges
from surgbench.trackers.registration.parts import Parts
from surgbench.trackers.registration.shape import Shape

SHAFT_M = 0.00415
SHAFT, JAWS, LONGER, ASPECT = range(4)


def stretched(camera: Camera, share: float) -> Camera:
    """A camera whose fx is larger by a share, and fy smaller."""
    return camera.model_copy(update={"fx": camera.fx * (1 + share), "fy": camera.fy * (1 - share)})


def really(scene: Scene, mismatch: Mismatch, aspect: float = 0.0) -> Scene:
    """The scene as it is, where the declared one is another."""
    camera = stretched(scene.views[0].camera, aspect)
    instruments = tuple(real_instrument(one, mismatch) for one in scene.instruments)
    return replace(scene, instruments=instruments, views=(replace(scene.views[0], camera=camera),))


def declared(scene: Scene, real: Scene, state: FloatArray, index: int = 0) -> Observation:
    """A frame of the real scene, said to be of the declared one's camera."""
    frame = observe(real, state, index)
    return replace(frame, views=(replace(frame.views[0], camera=scene.views[0].camera),))


@pytest.mark.parametrize(
    ("mismatch", "aspect", "unknown", "value"),
    [
        ({"shaft_radius_scale": 1.1}, 0.0, SHAFT, 0.1 * SHAFT_M),
        ({"jaw_extra_m": 0.0006}, 0.0, LONGER, 0.0006),
        ({}, 0.01, ASPECT, 0.01),
    ],
)
def test_contours_lie_where_the_unknowns_say(
    camera: Camera, mismatch: dict[str, Any], aspect: float, unknown: int, value: float
) -> None:
    """Edges of a mask of another instrument, or by another camera, are off the contour by ``jacobian @ shape``."""
    scene, state = scene_of(camera), resting_state()
    frame = declared(scene, really(scene, Mismatch(**mismatch), aspect), state)
    contour = SilhouetteEvaluator(scene.instruments, camera).contour_points(state, 1)
    shape = np.zeros(4)
    shape[unknown] = value
    moved = Shape(scene.instruments).jacobian(contour, state, camera, reference=True) @ shape
    found = find_edges(contour, frame.mask, 14)
    far = np.abs(moved) > 1.0
    assert far.sum() > 20
    off = np.abs(found - moved)
    assert np.nanmedian(off[far]) < 0.5
    assert np.nanmedian(off) < 0.5


def test_only_the_reference_camera_is_learned_of(camera: Camera) -> None:
    scene, state = scene_of(camera, arms=2), np.tile(resting_state(), 2)
    state[12] += 0.03
    contour = SilhouetteEvaluator(scene.instruments, camera).contour_points(state, 1)
    shape = Shape(scene.instruments)
    assert shape.scale.shape == (7,)
    own, other = (shape.jacobian(contour, state, camera, reference=reference) for reference in (True, False))
    assert own[:, -1].any()
    assert not other[:, -1].any()
    np.testing.assert_array_equal(own[:, :-1], other[:, :-1])
    # Each arm's unknowns move its own contour alone.
    assert not own[contour.arm == 1, :3].any()
    assert not own[contour.arm == 0, 3:6].any()


def swaying(frames: int) -> FloatArray:
    """An instrument that is seen from many sides."""
    t = np.arange(frames)[:, None] / 30
    swing = np.array([0.15, 0.6, 0.15, 0.008, 0.008, 0.012, 0.35, 0.3, 0.15])
    phase = np.arange(9)
    return np.asarray(resting_state() + swing * (np.sin(np.pi * t + phase) - np.sin(phase)), dtype=np.float64)


def follow(scene: Scene, real: Scene, states: FloatArray, **options: Any) -> tuple[FloatArray, FloatArray, FloatArray]:
    """States, what was stated of them, and what was learned of the shape."""
    tracker = HybridTracker(HybridTracker.Config(**options))
    tracker.reset(scene, states[0], np.random.default_rng(0))
    answers = [
        tracker.step(replace(declared(scene, real, state, index), start=state)) for index, state in enumerate(states)
    ]
    return (
        np.array([answer.state for answer in answers]),
        np.array([answer.standard_deviations for answer in answers]),
        tracker.shape,
    )


@pytest.mark.slow
def test_a_shape_is_learned_and_a_declared_one_is_left(camera: Camera) -> None:
    """By evidence: of an instrument that is as declared nothing is made up, of another most is found."""
    scene, states = scene_of(camera), swaying(60)
    mismatch = Mismatch(shaft_radius_scale=1.03, jaw_extra_m=0.0004)
    _, sure, nothing = follow(scene, scene, states)
    _, unsure, learned = follow(scene, really(scene, mismatch, 0.01), states)
    steps = Shape(scene.instruments).scale
    assert (np.abs(nothing) < 0.1 * steps).all()
    assert learned[SHAFT] == pytest.approx(0.03 * SHAFT_M, rel=0.5)
    assert learned[LONGER] == pytest.approx(0.0004, rel=0.4)
    assert learned[ASPECT] == pytest.approx(0.01, rel=0.4)
    # What contours do tell of is off: so what they tell nothing of may be, and the distance is stated to be less known.
    assert np.median(unsure[20:, 5]) > 3 * np.median(sure[20:, 5])


def test_a_tip_shows_where_its_jaws_contour_passes(camera: Camera) -> None:
    """Both tips of open jaws do; of a jaw that lies behind the wrist, the one that is out."""
    scene, state = scene_of(camera), resting_state()
    evaluator, parts = SilhouetteEvaluator(scene.instruments, camera), Parts(scene.instruments)
    tips = camera.project(scene.instruments[0].tips_cam(state))
    contour = evaluator.contour_points(state, 1)
    assert parts.shows(contour, 0, tips, 5.0).all()
    without = contour._replace(
        **{
            name: getattr(contour, name)[
                contour.link != scene.instruments[0].link_index[scene.instruments[0].spec.tips[0].link]
            ]
            for name in ("points_px", "normals", "lengths_px", "arm", "link", "jacobian")
        }
    )
    assert parts.shows(without, 0, tips, 5.0).tolist() == [False, True]
