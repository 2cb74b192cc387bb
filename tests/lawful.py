"""Worlds in which the rules can be kept: a legal start, and a feature that moves no faster than a hand does."""

from __future__ import annotations

import numpy as np

from surgbench.geometry import FloatArray, rigid_transform, rotation_from_vector
from surgbench.tasks.viewpoint.conformance.worlds import DT_S, REMOTE_CENTRE_M, ZONE_M, feature_poses, make_trial
from surgbench.viewpoint.avoidable import PLACE_RULES, TOLERANCE_M, broken_m
from surgbench.viewpoint.camera_arm import CameraArm
from surgbench.viewpoint.contract import ViewpointScene
from surgbench.viewpoint.setting_up import rest
from surgbench.viewpoint.simulator import Course
from surgbench.viewpoint.trial import Trial
from surgbench.viewpoint.workspace import NoGoZone, Workspace

ARM = CameraArm()


def wander(rng: np.random.Generator, steps: int, extent: FloatArray, hertz: float) -> FloatArray:
    """Smooth paths ``(steps, n)``, sums of three sines within ``extent``, none faster than ``hertz``."""
    rate = hertz * rng.uniform(0.1, 1.0, (3, 1, len(extent)))
    phase = rng.uniform(0, 2 * np.pi, (3, 1, len(extent)))
    return np.asarray(
        extent / 3 * np.sin(2 * np.pi * rate * DT_S * np.arange(steps)[:, None] + phase).sum(axis=0), dtype=np.float64
    )


def lawful_trial(rng: np.random.Generator, steps: int) -> Trial | None:
    """A ring that wanders in and above the zone, a camera that rests where it may; ``None`` if there is no place."""
    base = rigid_transform(rotation_from_vector(rng.normal(0, 0.15, 3)), REMOTE_CENTRE_M + rng.uniform(-0.03, 0.03, 3))
    middle = rng.uniform([-0.03, -0.03, 0.01], [0.03, 0.03, 0.06])
    # Up to some 0.1 m/s, and 90 degrees in a second.
    position = middle + wander(rng, steps, np.array([0.02, 0.02, 0.015]), rng.choice([0.2, 0.6]))
    azimuth, elevation = (
        rng.uniform([-np.pi, -0.3], [np.pi, 1.2]) + wander(rng, steps, np.array([1.5, 0.7]), rng.choice([0.1, 0.4]))
    ).T
    normal = np.stack(
        [np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)], axis=-1
    )
    poses = feature_poses(position, normal)
    noisy = poses.copy()
    noisy[:, :3, 3] += rng.normal(0, 3e-5, (steps, 3))
    start = rest(noisy[0], 0.11, Workspace(NoGoZone(ZONE_M)), ARM, base)
    return None if start is None else make_trial(noisy, base, start)


def broken_rules(course: Course, trial: Trial, scene: ViewpointScene) -> list[str]:
    """Every rule that a course breaks; nothing is excused as unavoidable."""
    count = len(course.goals)
    feature = trial.T_world_feature[:count, :3, 3]
    found = []
    for of, joints in (("joints", course.joints), ("setpoints", course.setpoints)):
        pose = scene.T_world_base @ scene.arm.forward(joints)
        for rule, depth in broken_m(pose[:count, :3, 3], feature, scene).items():
            broken = np.nan_to_num(depth, nan=-1.0) > TOLERANCE_M
            found += [f"{rule} of {of} at {k}: {1e3 * depth[k]:.2f} mm" for k in np.flatnonzero(broken)]
        sine = pose[:, :3, 1] @ np.array(scene.workspace.preferred_side)
        found += [f"orientation of {of} at {k}: {sine[k]:.4f}" for k in np.flatnonzero(sine > 0.0)]
        found += [f"limit of {of} at {k}" for k in np.flatnonzero(~scene.arm.within_limits(joints, 1e-12))]
    velocity = np.diff(course.setpoints, axis=0) / scene.dt_s
    change = np.diff(velocity, axis=0, prepend=np.zeros((1, 6))) / scene.dt_s
    for name, values, most in (
        ("velocity", velocity, scene.arm.velocity),
        ("acceleration", change, scene.arm.acceleration),
    ):
        found += [f"{name} at {k}" for k in np.flatnonzero((np.abs(values) > np.array(most) * (1 + 1e-6)).any(axis=1))]
    return found


assert set(PLACE_RULES) == {"no_go", "floor", "proximity"}
