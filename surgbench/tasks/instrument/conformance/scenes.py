"""Short synthetic sequences with everything that an observation may hold."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any

import cv2
import numpy as np

from surgbench.camera import Camera
from surgbench.conformance.subject import Subject
from surgbench.contract import Mask, Observation, Scene, View
from surgbench.geometry import FloatArray, look_at_rotation
from surgbench.instrument import Instrument, load_instrument
from surgbench.instrument.spec import LinkPoint, Marker
from surgbench.silhouette import SilhouetteEvaluator, VisibilityEvaluator
from surgbench.state import ANGLES, JOINTS, POSITION, split_arms

FRAMES = 6
# A quarter of the paper's camera, so that hundreds of steps take seconds.
CAMERA = Camera(width=175, height=123, fx=226.5, fy=226.2, cx=73.2, cy=59.3)
INSTRUMENT = "large_needle_driver"
DT_S = 1 / 30
# What some trackers refuse to run without. Images come with kinematics.
KINEMATICS = "kinematics"
IMAGES = "images of painted instruments"
READING_ERROR_RAD = np.array([0.01, -0.02, 0.01])

_ALONE = np.array([0.3, 0.4, 0.8, 0.0, 0.0, 0.13, 0.3, -0.2, 0.3])
_ELSEWHERE = np.array([0.2, 2.0, -0.7, 0.01, 0.005, 0.14, -0.4, 0.3, 0.5])
# Large enough to show at this size, of colours that are far apart.
_MARKERS = tuple(
    Marker(name=f"spot_{number}", point=LinkPoint(link=link, point_m=place), radius_m=0.002, colour=colour)
    for number, (link, place, colour) in enumerate(
        [
            ("shaft", (0.00415, 0.0, -0.012), (0.8, 0.8, 0.01)),
            ("shaft", (-0.00415, 0.0, -0.012), (0.01, 0.8, 0.01)),
            ("shaft", (0.0, 0.00415, -0.018), (0.01, 0.8, 0.8)),
            ("shaft", (0.0, -0.00415, -0.018), (0.01, 0.01, 0.8)),
            ("jaw_left", (-0.0003, 0.007, -0.0006), (0.8, 0.01, 0.8)),
        ]
    )
)
_TISSUE, _STEEL = (150, 85, 75), (70, 70, 70)
_LEFT, _RIGHT = _ALONE.copy(), _ALONE.copy()
_LEFT[[2, 3]], _RIGHT[[2, 3]] = [0.8, -0.02], [-0.8, 0.025]
X_LEFT, Z_RIGHT = 3, 14
# How far the left arm is on its way at first, and how far it goes in a frame; how far behind it the right one is.
_CROSSING_M, _BEHIND_M = (0.03, 0.0015), 0.02
_MOTION_PER_FRAME = np.array([0.005, 0.01, 0.005, 4e-4, 3e-4, 2e-4, 0.02, 0.01, 0.0])


@dataclass(frozen=True)
class Play:
    """A sequence to run a tracker on.

    Attributes:
        scene: Its constants.
        observations: Its frames; their ``start`` is the true state of the first.
        truth: ``(T, 9 * arms)`` true states.
    """

    scene: Scene
    observations: tuple[Observation, ...]
    truth: FloatArray

    def with_masks(self, masks: dict[int, Mask]) -> Play:
        """Some frames with another mask, and no tips."""
        frames = [
            replace(
                frame, views=(replace(frame.views[0], mask=masks[frame.index], keypoints=(None,) * self.scene.arms),)
            )
            if frame.index in masks
            else frame
            for frame in self.observations
        ]
        return replace(self, observations=tuple(frames))


@cache
def instrument() -> Instrument:
    """The instrument that all plays show."""
    return load_instrument(INSTRUMENT)


@cache
def painted_instrument() -> Instrument:
    """The same with markers."""
    return Instrument(instrument().spec.model_copy(update={"markers": _MARKERS}), instrument().meshes)


@cache
def evaluator(arms: int) -> SilhouetteEvaluator:
    """Paints the masks, and says how well an estimate covers one."""
    return SilhouetteEvaluator((instrument(),) * arms, CAMERA)


def make_play(
    *,
    arms: int = 1,
    readings: bool = False,
    kinematics: bool = False,
    keypoints: bool = True,
    elsewhere: bool = False,
    instances: bool = False,
    crossing: bool = False,
    images: bool = False,
    frames: int = FRAMES,
) -> Play:
    """An instrument, or two, in slow steady motion.

    Args:
        arms: 1 or 2.
        readings: With joint readings, which are off by a constant.
        kinematics: With the arms' own readings of their tool pose, and with joint readings, without which there
            are none.
        keypoints: With the tips.
        elsewhere: Another sequence: one arm begins at another place.
        instances: With a mask for each of two arms, of what is seen of it.
        crossing: Two arms cross, the right one behind: at most a quarter of it is hidden.
        images: With images of painted instruments, in plain colours.
        frames: How many.

    Returns:
        Arrays that nobody else holds.
    """
    first = np.concatenate([_LEFT, _RIGHT]) if arms == 2 else _ELSEWHERE if elsewhere else _ALONE
    truth = first + np.arange(frames)[:, None] * np.tile(_MOTION_PER_FRAME, arms)
    if crossing:
        truth[:, X_LEFT] += _CROSSING_M[0] + _CROSSING_M[1] * np.arange(frames)
        truth[:, Z_RIGHT] += _BEHIND_M
    empty = np.zeros((CAMERA.height, CAMERA.width), dtype=bool)
    scene = Scene(
        instruments=(painted_instrument() if images else instrument(),) * arms,
        views=(View(CAMERA, np.eye(4), empty, keypoints=(None,) * arms),),
        limits=(instrument().search_limits,) * arms,
        dt_s=DT_S,
        arms=arms,
        T_cam_base=_bases(arms) if kinematics else None,
    )
    observations = [_observe(scene, truth, frame, readings or kinematics, keypoints) for frame in range(frames)]
    if instances:
        observations = [_with_instances(frame, truth[frame.index]) for frame in observations]
    if images:
        observations = [_with_image(frame, truth[frame.index]) for frame in observations]
    return Play(scene, tuple(observations), truth)


def play_of(subject: Subject, *, readings: bool = False, kinematics: bool = False, **how: Any) -> Play:
    """A sequence as :func:`make_play` makes it, with the kinematics and images that the tracker may need."""
    images = IMAGES in subject.aids
    return make_play(
        readings=readings, kinematics=kinematics or images or KINEMATICS in subject.aids, images=images, **how
    )


def _observe(scene: Scene, truth: FloatArray, frame: int, readings: bool, keypoints: bool) -> Observation:
    per_arm = split_arms(truth[frame])
    tips = [CAMERA.project(instrument().tips_cam(state)) for state in per_arm]
    mask = evaluator(scene.arms).mask(truth[frame])
    joints = scene.joint_limits.clip(per_arm[:, JOINTS] + READING_ERROR_RAD)
    return Observation(
        index=frame,
        timestamp_s=frame * scene.dt_s,
        views=(View(CAMERA, np.eye(4), mask, keypoints=tuple(tips) if keypoints else (None,) * scene.arms),),
        start=truth[0].copy(),
        joints=(joints[0] if scene.arms == 1 else joints) if readings else None,
        kinematics=None if scene.T_cam_base is None else np.linalg.inv(scene.T_cam_base) @ _tool_poses(per_arm),
    )


def _with_instances(frame: Observation, state: FloatArray) -> Observation:
    masks = tuple(VisibilityEvaluator((instrument(), instrument()), CAMERA).visible_masks(state))
    return replace(frame, views=(replace(frame.views[0], instance_masks=masks),))


def _with_image(frame: Observation, state: FloatArray) -> Observation:
    """Grey arms before tissue, and of their markers those on the camera's side, as if nothing else hid them."""
    image = np.where(frame.mask[..., None], _STEEL, _TISSUE).astype(np.uint8)
    for own in split_arms(state):
        places = painted_instrument().points_cam(own, tuple(marker.point for marker in _MARKERS))
        axis = painted_instrument().points_cam(own, tuple(_on_axis(marker.point) for marker in _MARKERS))
        for marker, place, middle in zip(_MARKERS, places, axis, strict=True):
            if (place - middle) @ place <= 0:
                u, v = CAMERA.project(place)
                radius = CAMERA.fx * marker.radius_m / place[2]
                at, levels = (round(16 * u), round(16 * v)), [255 * value ** (1 / 2.2) for value in marker.colour]
                cv2.circle(image, at, round(16 * radius), levels, cv2.FILLED, cv2.LINE_AA, shift=4)
    return replace(frame, views=(replace(frame.views[0], image=partial(np.copy, image)),))


def _on_axis(point: LinkPoint) -> LinkPoint:
    """The point of the link's axis that is next to it; of a jaw itself."""
    return LinkPoint(link=point.link, point_m=(0.0, 0.0, point.point_m[2])) if point.link == "shaft" else point


def _tool_poses(states: FloatArray) -> FloatArray:
    """``(arms, 4, 4)`` T_cam_tool of ``(arms, 9)`` states."""
    poses = np.tile(np.eye(4), (len(states), 1, 1))
    poses[:, :3, :3] = look_at_rotation(states[:, ANGLES])
    poses[:, :3, 3] = states[:, POSITION]
    return poses


def _bases(arms: int) -> FloatArray:
    """``(arms, 4, 4)`` T_cam_base: a hand's breadth to the sides of the camera, turned towards the picture."""
    bases = np.tile(np.eye(4), (arms, 1, 1))
    for base, side in zip(bases, (-1.0, 1.0), strict=False):
        base[:3, :3] = look_at_rotation(np.array([-0.3, 0.2, 0.4 * side]))
        base[:3, 3] = 0.12 * side, -0.05, 0.05
    return bases
