"""One controller's run on one trial, as a film needs it: poses, pictures, errors and rules, step by step."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from surgbench.geometry import FloatArray, rigid_transform, rotation_from_vector
from surgbench.report.drawing import Colour
from surgbench.tasks.viewpoint.records import ViewpointRecord
from surgbench.tasks.viewpoint.rule_flags import RuleFlags, rule_flags
from surgbench.viewpoint.contract import ViewpointScene
from surgbench.viewpoint.optics.visibility import SEEN_SHARE
from surgbench.viewpoint.trial import Trial

# What is shown over time, and how.
ERRORS = (("vva_deg", "VVA", "deg"), ("fd_mm", "FD", "mm"), ("pf_deg", "PF", "deg"))


@dataclass(frozen=True, eq=False)
class Shot:
    """A run; T steps. Poses are true ones where they are known.

    Attributes:
        title: What it is called.
        colour: Of its curves.
        scene: As its controller was told it.
        T_world_feature: ``(T, 4, 4)`` the ring after each step.
        T_world_base: ``(4, 4)`` of the camera arm.
        T_world_camera: ``(T, 4, 4)`` after each step.
        joints: ``(T, 6)``.
        errors: Name to ``(T,)``, NaN where there is none.
        rules: Active, broken, and against the naive pose.
        contact: ``(T,)`` whether ring and wire touch, as far as is known.
        seen: ``(T, 2)`` whether the left and the right picture show half of the ring or more, covered by nothing.
    """

    title: str
    colour: Colour
    scene: ViewpointScene
    T_world_feature: FloatArray
    T_world_base: FloatArray
    T_world_camera: FloatArray
    joints: FloatArray
    errors: dict[str, FloatArray]
    rules: RuleFlags
    contact: NDArray[np.bool_]
    seen: NDArray[np.bool_]

    @property
    def steps(self) -> int:
        """How many."""
        return len(self.joints)

    @classmethod
    def of(cls, record: ViewpointRecord, trial: Trial, scene: ViewpointScene, title: str, colour: Colour) -> Shot:
        """Of a record, which has at least one step."""
        frames = record.frames
        joints = np.array(frames.joints, dtype=np.float64)
        count, later = len(joints), np.minimum(np.arange(1, len(joints) + 1), len(trial.timestamps_s) - 1)
        feature = trial.T_world_feature[later]
        contact: NDArray[np.bool_] = np.zeros(count, dtype=bool)
        if trial.truth is not None:
            feature, contact = trial.truth.T_world_feature[later], np.asarray(trial.truth.contact[later])
        if frames.ring:  # led by a simulated hand
            numbers = np.array(frames.ring, dtype=np.float64)[np.minimum(np.arange(1, count + 1), count - 1)]
            feature = rigid_transform(rotation_from_vector(numbers[:, :3]), numbers[:, 3:])
            contact = np.array(frames.contact, dtype=bool)
        base = scene.T_world_base if trial.truth is None else trial.truth.T_world_base
        seen: NDArray[np.bool_] = np.zeros((count, 2), dtype=bool)
        if frames.ring_seen:
            seen = np.array(frames.ring_seen, dtype=np.float64).reshape(count, 2) >= SEEN_SHARE
        return cls(
            title,
            colour,
            scene,
            feature,
            base,
            base @ scene.arm.forward(joints),
            joints,
            {name: record.errors.get(name, np.full(count, np.nan)) for name, _, _ in ERRORS},
            rule_flags(frames),
            contact,
            seen,
        )
