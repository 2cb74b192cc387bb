"""How far the camera was beyond each rule, at one moment, and the events of that: on reported poses and on true ones.

After step i the arm is where its joints say, and the feature is where it is measured at that moment, with sample
i + 1. What is *reported* is the camera by the registered base and the joints' measurement or set point, the worse of
the two, against the feature as measured. What is *true* is the camera by the base's true place and the joints, against
the true feature; the zone is as it was touched in both, for its points are in the world that the feature is in.

Depths are millimetres, and degrees for directions and joints; positive beyond a rule, negative within it:

- ``no_go``: how deep in the no-go zone, all of its faces closed;
- ``floor``: how far below the floor;
- ``orientation``: how far the camera's y axis is beyond the plane square to the side that it must not point along;
- ``proximity``: how much nearer to the feature than allowed; NaN where it was not measured;
- ``joint_limit``: how far the worst joint is beyond its limits; a millimetre of insertion counts as a degree.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from surgbench.geometry import FloatArray
from surgbench.viewpoint.camera_arm import INSERTION, CameraArm
from surgbench.viewpoint.contract import ViewpointScene
from surgbench.viewpoint.placement import CONSTRAINTS
from surgbench.viewpoint.simulator import Course
from surgbench.viewpoint.trial import Trial
from surgbench.viewpoint.workspace import Workspace

RULE_UNITS = {"no_go": "mm", "floor": "mm", "orientation": "deg", "proximity": "mm", "joint_limit": "deg"}
# A rule is broken beyond this: half a millimetre, and for directions half a degree, which at 110 mm is twice that.
TOLERANCES = {"mm": 0.5, "deg": 0.5}
# What names of a rule's columns end with: on reported poses, and on true ones.
TWINS = ("", "_true")


@dataclass(frozen=True)
class Events:
    """When a rule was broken: maximal runs of samples beyond its tolerance.

    Attributes:
        count: How many.
        samples: In all of them.
        longest: Samples of the longest.
        deepest: The largest depth of all samples, beyond the tolerance or not; 0 where none is beyond the rule.
    """

    count: int
    samples: int
    longest: int
    deepest: float


def depth_name(rule: str, twin: str = "") -> str:
    """What a rule's depths are called in records, by its name and one of :data:`TWINS`."""
    return f"{rule}_{RULE_UNITS[rule]}{twin}"


def reported_depths(course: Course, trial: Trial, scene: ViewpointScene) -> dict[str, FloatArray]:
    """Depths beyond each rule on reported poses, name to ``(T,)``.

    Args:
        course: What happened.
        trial: The feature as it was measured.
        scene: The base as registered, and the rules.
    """
    feature = after_steps(trial.T_world_feature, len(course.goals))[:, :3, 3]
    by_joints, by_setpoints = (
        _depths(joints, scene.T_world_base, feature, scene.workspace, scene.arm)
        for joints in (course.joints[1:], course.setpoints[1:])
    )
    return {name: np.maximum(by_joints[name], by_setpoints[name]) for name in CONSTRAINTS}


def true_depths(course: Course, trial: Trial, scene: ViewpointScene) -> dict[str, FloatArray]:
    """The same on true poses; nothing for trials without truth."""
    if trial.truth is None:
        return {}
    feature = after_steps(trial.truth.T_world_feature, len(course.goals))[:, :3, 3]
    return _depths(course.joints[1:], trial.truth.T_world_base, feature, scene.workspace, scene.arm)


def after_steps(samples: FloatArray, steps: int) -> FloatArray:
    """What ``(n, ...)`` samples were after each of the first steps; after the last sample's, that one again."""
    return np.asarray(samples[np.minimum(np.arange(1, steps + 1), len(samples) - 1)])


def broken(depth: FloatArray, rule: str) -> NDArray[np.bool_]:
    """In which samples a rule is broken, ``(T,)``.

    Args:
        depth: ``(T,)``; NaN is not known, and counts as kept.
        rule: Its name.
    """
    return np.asarray(depth > TOLERANCES[RULE_UNITS[rule]])


def find_events(depth: FloatArray, rule: str) -> Events:
    """The events of one rule.

    Args:
        depth: ``(T,)``, as above.
        rule: Its name.

    Example:
        Twice below the floor, for one sample and for two:

        >>> import numpy as np
        >>> from surgbench.viewpoint.rules import find_events
        >>> find_events(np.array([-3.0, 0.7, 0.1, 0.6, 2.0, -1.0]), "floor")
        Events(count=2, samples=3, longest=2, deepest=2.0)
    """
    beyond = broken(depth, rule)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], beyond, [False]]).astype(np.int8)))
    lengths = edges[1::2] - edges[::2]
    known = depth[np.isfinite(depth)]
    return Events(
        count=len(lengths),
        samples=int(lengths.sum()),
        longest=int(lengths.max(initial=0)),
        deepest=max(float(known.max(initial=0.0)), 0.0),
    )


def _depths(
    joints: FloatArray, T_world_base: FloatArray, feature: FloatArray, workspace: Workspace, arm: CameraArm
) -> dict[str, FloatArray]:
    """Depths of ``(T, 6)`` joints, where the feature is at ``(T, 3)``."""
    pose = T_world_base @ arm.forward(joints)
    place = pose[:, :3, 3]
    scale = np.full(joints.shape[1], np.degrees(1.0))
    scale[INSERTION] = 1e3
    across = np.clip(pose[:, :3, 1] @ np.array(workspace.preferred_side), -1.0, 1.0)
    return {
        "no_go": 1e3 * workspace.zone.depth(place),
        "floor": 1e3 * workspace.below_floor(place),
        "orientation": np.degrees(np.arcsin(across)),
        "proximity": 1e3 * (workspace.proximity_m - np.linalg.norm(place - feature, axis=1)),
        "joint_limit": (scale * np.maximum(arm.lower - joints, joints - arm.upper)).max(axis=1),
    }
