"""What makes a trial harder than it was: measurements that are late, noisy or missing, and things told wrongly.

Each disturbance has a level, and none is there at its zero. They are drawn from named seeds in which no controller
takes part, so that all of them are disturbed alike, and a higher level of the same trial is more of the same draw.
What is disturbed is what a controller is shown and told. Errors stay those against the undisturbed measurement.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from surgbench.geometry import FloatArray, rigid_transform, rotation_from_vector
from surgbench.randomness import generator
from surgbench.viewpoint.contract import ViewpointScene
from surgbench.viewpoint.trial import Trial

Axes = Mapping[str, str | int]


@dataclass(frozen=True)
class Disturbance:
    """Levels.

    Attributes:
        told_lag: Controllers are told the joints' lag times this.
        jitter_s: A measurement is older than its time stamp says by up to so much, evenly drawn for each step.
        dropouts: Share of the steps at which the feature is not measured, in gaps.
        dropout_s: How long such a gap is in the mean; at least one step.
        noise_m: Standard deviation of the measured position, of each of its coordinates, white.
        noise_rad: The same of its rotation vector, about the feature's own axes.
        registration_error_m: The camera arm's base is registered so far beside where it would be, in any direction:
            an error that the registration does not know of.
    """

    told_lag: float = 1.0
    jitter_s: float = 0.0
    dropouts: float = 0.0
    dropout_s: float = 0.1
    noise_m: float = 0.0
    noise_rad: float = 0.0
    registration_error_m: float = 0.0

    def levels(self) -> dict[str, float]:
        """What there is of it: names and levels, without those that disturb nothing."""
        found = {one.name: float(getattr(self, one.name)) for one in fields(self) if one.name != "dropout_s"}
        found = {name: level for name, level in found.items() if level != (1.0 if name == "told_lag" else 0.0)}
        return {**found, "dropout_s": self.dropout_s} if "dropouts" in found else found

    def words(self) -> list[str]:
        """The levels as a table says them."""
        levels = self.levels()
        said = {
            "told_lag": "told {:g} x the lag",
            "jitter_s": "measured up to {:g} s late",
            "dropouts": "{:g} of the measurements missing",
            "dropout_s": "gaps of {:g} s",
            "noise_m": "noise {:g} m",
            "noise_rad": "noise {:g} rad",
            "registration_error_m": "base {:g} m off",
        }
        return [text.format(levels[name]) for name, text in said.items() if name in levels]


def disturb_trial(trial: Trial, disturbance: Disturbance, axes: Axes) -> Trial:
    """A trial as it is shown to a controller: late, noisy, with gaps.

    Args:
        trial: As it was measured.
        disturbance: How much.
        axes: Name the draw; those of a controller do not belong here.

    Returns:
        The same trial with other measurements; those of the original that are missing stay so.
    """
    poses = trial.T_world_feature
    if disturbance.jitter_s > 0:
        rng = generator(**axes, purpose="jitter")
        poses = earlier(poses, trial.dt_s, disturbance.jitter_s * rng.random(len(poses)))
    if disturbance.noise_m > 0 or disturbance.noise_rad > 0:
        rng = generator(**axes, purpose="noise")
        shift, turn = rng.standard_normal((2, len(poses), 3))
        rotation = poses[:, :3, :3] @ rotation_from_vector(disturbance.noise_rad * turn)
        poses = rigid_transform(rotation, poses[:, :3, 3] + disturbance.noise_m * shift)
        poses[~trial.measured] = np.nan
    if disturbance.dropouts > 0:
        rng = generator(**axes, purpose="dropouts")
        gone = gaps(len(poses), disturbance.dropouts, disturbance.dropout_s / trial.dt_s, rng)
        poses = np.where(gone[:, None, None], np.nan, poses)
    return trial if poses is trial.T_world_feature else replace(trial, T_world_feature=poses)


def displace_base(scene: ViewpointScene, disturbance: Disturbance, axes: Axes) -> ViewpointScene:
    """A scene whose registration is worse than it says.

    Args:
        scene: As it was registered.
        disturbance: How much.
        axes: Name the draw.

    Returns:
        The base moved, in a direction drawn evenly from the sphere. It is what the robot reports from then on.
    """
    if disturbance.registration_error_m <= 0:
        return scene
    direction = generator(**axes, purpose="registration").standard_normal(3)
    base = scene.T_world_base.copy()
    base[:3, 3] += disturbance.registration_error_m * direction / np.linalg.norm(direction)
    return replace(scene, T_world_base=base)


def mislead(scene: ViewpointScene, disturbance: Disturbance) -> ViewpointScene:
    """What a controller is told of a scene: another lag than the joints have."""
    if disturbance.told_lag == 1.0:
        return scene
    return replace(scene, servo_lag_s=disturbance.told_lag * scene.servo_lag_s)


def earlier(poses: FloatArray, dt_s: float, age_s: FloatArray) -> FloatArray:
    """Poses as they were some time before, evenly between the samples.

    Args:
        poses: ``(T, 4, 4)``, one every ``dt_s``; NaN where there is none, which stays.
        dt_s: Seconds between samples.
        age_s: ``(T,)`` how long before; never before the first.
    """
    there = np.flatnonzero(np.isfinite(poses).all(axis=(1, 2)))
    if len(there) < 2:
        return poses
    at = np.maximum(there - age_s[there] / dt_s, there[0])
    rotation = Slerp(there, Rotation.from_matrix(poses[there, :3, :3]))(at).as_matrix()
    position = np.stack([np.interp(at, there, poses[there, k, 3]) for k in range(3)], axis=1)
    late = poses.copy()
    late[there] = rigid_transform(rotation, position)
    return late


def gaps(count: int, share: float, length: float, rng: np.random.Generator) -> NDArray[np.bool_]:
    """Which of ``count`` steps fall into gaps: Gilbert's channel, two states that each last geometrically long.

    Args:
        count: Steps.
        share: Of them in gaps, in the long run; at most a half.
        length: Of a gap in the mean, steps; at least 1.
        rng: Draws two numbers a step at most.

    Returns:
        ``(count,)``.
    """
    ends = 1.0 / max(length, 1.0)
    begins = ends * share / (1.0 - share)
    gone = np.zeros(count, dtype=bool)
    draws = rng.random(count + 1)
    now = bool(draws[0] < share)
    for step in range(count):
        gone[step] = now
        now = bool(draws[step + 1] >= ends) if now else bool(draws[step + 1] < begins)
    return gone
