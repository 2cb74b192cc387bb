"""How good a view was: the errors of the article's Tables I and III, on reported poses and on true ones.

As the authors' evaluation has it, what was wanted at step i is held against where the camera was at step i + 1. With
the camera's position p and axes x, y, z, the feature's position f and normal n, c = f - p, and the world's up w:

- ``vva_deg``, viewing vector angle: between c and z;
- ``fd_mm``, feature distance: ``| |c| - d_t |`` (Table III very likely has the signed difference, :data:`SIGNED`);
- ``pf_deg``, parallel to the floor: ``|90 deg - angle(x, w)|``;
- ``an_deg``, angle to the naive pose: between -z and n (of optical axes only; roll does not count);
- ``pn_mm``, distance to the naive pose: ``|p - p_naive|``, where p_naive is, as in the published code, only half way
  from where the arm is if that is farther than 15 mm; ``pn_full_mm`` has no such step.

``view_cost`` is one number of the errors that a controller can do something about, for regret: each over what is as bad
as one degree of the view, squared and added (:data:`COST_TOLERANCES`).

The twins ``*_true`` take the feature's and the base's true poses at one moment, i + 1. The camera's point is the one
that is controlled, on the tool's axis; how the optical centres are mounted is not part of these errors.
"""

from __future__ import annotations

import numpy as np

from surgbench.geometry import FloatArray
from surgbench.viewpoint.contract import ViewpointScene
from surgbench.viewpoint.placement import UP, Violations, naive_pose, violations
from surgbench.viewpoint.simulator import Course
from surgbench.viewpoint.trial import Trial

POSE_ERRORS = ("vva_deg", "fd_mm", "pf_deg", "an_deg", "pn_mm", "pn_full_mm", "view_cost")
# Our choice: as bad as each other are a degree out of view or level, 5 mm of distance, and 50 mm off the naive place.
COST_TOLERANCES = {"vva_deg": 1.0, "fd_mm": 5.0, "pf_deg": 1.0, "pn_full_mm": 50.0}
TRUE_ERRORS = ("vva_true_deg", "fd_true_mm", "pf_true_deg", "an_true_deg")
SIGNED = "fd_signed_mm"
# The article's step towards a far goal.
INTERPOLATE_BEYOND_M, INTERPOLATE_SHARE = 0.015, 0.5


def _angle_deg(a: FloatArray, b: FloatArray) -> FloatArray:
    """Angles between vectors ``(..., 3)``, exact near 0."""
    return np.asarray(np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), (a * b).sum(axis=-1))))


def view_errors(T_world_camera: FloatArray, T_world_feature: FloatArray, distance_m: float) -> dict[str, FloatArray]:
    """VVA, FD (absolute and signed), PF and AN of cameras and the features they should see.

    Args:
        T_world_camera: ``(..., 4, 4)``.
        T_world_feature: ``(..., 4, 4)``; the normal is its y axis.
        distance_m: d_t.

    Returns:
        Name to ``(...)`` values.
    """
    towards = T_world_feature[..., :3, 3] - T_world_camera[..., :3, 3]
    signed = 1e3 * (np.linalg.norm(towards, axis=-1) - distance_m)
    level = np.arcsin(np.clip(T_world_camera[..., :3, 0] @ UP, -1.0, 1.0))
    return {
        "vva_deg": _angle_deg(towards, T_world_camera[..., :3, 2]),
        "fd_mm": np.abs(signed),
        SIGNED: signed,
        "pf_deg": np.abs(np.degrees(level)),
        "an_deg": _angle_deg(-T_world_camera[..., :3, 2], T_world_feature[..., :3, 1]),
    }


def course_errors(course: Course, trial: Trial, scene: ViewpointScene) -> dict[str, FloatArray]:
    """All errors of a trial's steps.

    Returns:
        Name to ``(T,)`` values; NaN where the feature was not measured, and for the true twins where there is no truth.
    """
    count = len(course.goals)
    wanted = trial.T_world_feature[:count]
    poses = scene.T_world_base @ scene.arm.forward(course.joints)
    errors = view_errors(poses[1:], wanted, scene.distance_m)
    naive = naive_pose(wanted, scene.distance_m)
    errors["pn_full_mm"] = 1e3 * np.linalg.norm(poses[1:, :3, 3] - naive[:, :3, 3], axis=1)
    reach = scene.arm.camera_m
    ahead = naive[:, :3, 3] - poses[:-1, :3, 3]
    # Near or far is decided, and the half way taken, at the tool's origin; the camera is carried along.
    tool_ahead = ahead - reach * (naive[:, :3, 2] - poses[:-1, :3, 2])
    far = np.linalg.norm(tool_ahead, axis=1) > INTERPOLATE_BEYOND_M
    half = naive[:, :3, 3] - (1 - INTERPOLATE_SHARE) * tool_ahead
    target = np.where(far[:, None], half, naive[:, :3, 3])
    errors["pn_mm"] = 1e3 * np.linalg.norm(poses[1:, :3, 3] - target, axis=1)
    terms = [(errors[name] / tolerance) ** 2 for name, tolerance in COST_TOLERANCES.items()]
    errors["view_cost"] = np.sum(terms, axis=0)
    if trial.truth is None:
        return {**errors, **{name: np.full(count, np.nan) for name in TRUE_ERRORS}}
    # The feature after the last step is not known: it stays where it was.
    later = trial.truth.T_world_feature[np.minimum(np.arange(1, count + 1), len(trial.timestamps_s) - 1)]
    true = view_errors(trial.truth.T_world_base @ scene.arm.forward(course.joints[1:]), later, scene.distance_m)
    names = zip(TRUE_ERRORS, ("vva_deg", "fd_mm", "pf_deg", "an_deg"), strict=True)
    return {**errors, **{twin: true[name] for twin, name in names}}


def naive_violations(trial: Trial, scene: ViewpointScene, steps: int | None = None) -> Violations:
    """What the rules say against the naive pose at each step: the same samples are constrained for all controllers."""
    feature = np.nan_to_num(trial.T_world_feature[:steps])
    pose = naive_pose(feature, scene.distance_m)
    return violations(pose, feature[:, :3, 3], scene.workspace, scene.arm, scene.T_world_base)
