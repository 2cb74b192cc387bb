"""Many camera arms at once, each on a trial of its own, told joint velocities: what an environment for learning is.

The arm's motion is that of :class:`surgbench.viewpoint.servo.JointServo`, to the last bit, for set points that it can
be at after a step: a velocity is first clipped to what its joint can reach in that time, and from where it can still be
stopped before its limit.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from surgbench.errors import DatasetError
from surgbench.geometry import FloatArray
from surgbench.viewpoint.contract import ViewpointScene
from surgbench.viewpoint.placement import UP
from surgbench.viewpoint.registration import Method
from surgbench.viewpoint.scores import COST_TOLERANCES
from surgbench.viewpoint.servo import servo_limits, servo_timing
from surgbench.viewpoint.simulator import make_scene
from surgbench.viewpoint.trial import Trial
from surgbench.viewpoint.world_steps import (
    COUNTED,
    ENDED,
    SEEN,
    SEEN_NOW,
    VIEWS,
    Tables,
    begin_worlds,
    observe_worlds,
    step_worlds,
)

# As many as a box has.
FACES = 6
# By their place in a row of `views`.
ERRORS = ("vva_deg", "fd_mm", "pf_deg", "an_deg", "pn_full_mm")
DEPTHS = ("no_go_mm", "floor_mm", "orientation_deg", "proximity_mm")


class Worlds:
    """N arms on trials.

    Args:
        trials: That there are.
        count: N.
        registration: How touched points correct the arm's base, ``translation``, ``rigid``, … as of a run.
        steps: Only the first so many of each trial.

    Attributes:
        tables: What the trials are.
        trial: ``(N,)`` which one each world is on.
        index: ``(N,)`` which step it is at.
        state: ``(N, 3, 6)`` set points, their velocities, joints.
        seen: ``(N, 15)`` feature and normal in the camera's frame, the world's up in it, feature and normal in the
            frame of the arm's base; metres.
        views: ``(N, 9)`` errors and depths after the last step, by the names of :data:`ERRORS` and :data:`DEPTHS`.
        costs: ``(N, 2)`` of the last step: ``view_cost`` (``surgbench.viewpoint.scores.COST_TOLERANCES``), 0 where the
            feature was not measured; and how far the camera is beyond all rules together, mm and degrees.
    """

    def __init__(
        self, trials: Sequence[Trial], count: int, *, registration: Method = "translation", steps: int | None = None
    ) -> None:
        if not trials:
            raise DatasetError("an environment needs at least one trial")
        self.tables = _tables(trials, [make_scene(trial, registration=registration) for trial in trials], steps)
        self.trial, self.index = np.zeros(count, dtype=np.int64), np.zeros(count, dtype=np.int64)
        self.state = np.zeros((count, 3, 6))
        self.seen, self.views, self.costs = np.zeros((count, SEEN)), np.zeros((count, VIEWS)), np.zeros((count, 2))
        self._flags = np.ones((count, 3), dtype=bool)
        self._tolerances = np.array([COST_TOLERANCES.get(name, np.inf) for name in ERRORS])

    def begin(self, begun: NDArray[np.bool_], trial: NDArray[np.int64]) -> None:
        """Put worlds at the beginning of trials.

        Args:
            begun: ``(N,)`` which worlds.
            trial: ``(N,)`` on which trials.
        """
        self.trial[begun] = trial[begun]
        begin_worlds(self.tables, self.trial, begun, self.index, self.state, self.seen, self.views, self._flags)

    def step(self, shares: FloatArray) -> None:
        """One step; worlds whose trials have ended stay as they are.

        Args:
            shares: ``(N, 6)`` wanted joint velocities, as shares of the largest, clipped to -1 and 1; NaN counts as 0.
        """
        step_worlds(
            self.tables, self._tolerances, self.trial, shares, self.index, self.state, self.seen, self.views,
            self.costs, self._flags,
        )  # fmt: skip

    def observe(self, low: FloatArray, high: FloatArray) -> NDArray[np.float32]:
        """``(N, 38)`` all that is known at this step, within limits ``(38,)``.

        Joints, set points and their velocities, :attr:`seen`, the depths, and whether the feature is measured.
        """
        out = np.empty((len(self.index), len(low)), dtype=np.float32)
        observe_worlds(self.state, self.seen, self.views, self._flags, low, high, out)
        return out

    @property
    def ended(self) -> NDArray[np.bool_]:
        """``(N,)`` which worlds are at their trials' ends, or on none yet."""
        return self._flags[:, ENDED].copy()

    @property
    def measured(self) -> NDArray[np.bool_]:
        """``(N,)`` where the feature is measured at this step."""
        return self._flags[:, SEEN_NOW].copy()

    @property
    def counted(self) -> NDArray[np.bool_]:
        """``(N,)`` where it was measured at the last one, so that the errors count."""
        return self._flags[:, COUNTED].copy()


def _tables(trials: Sequence[Trial], scenes: Sequence[ViewpointScene], steps: int | None) -> Tables:
    lengths = np.array([len(trial.T_world_feature[:steps]) for trial in trials], dtype=np.int64)
    samples = [_samples(trial, scene, steps) for trial, scene in zip(trials, scenes, strict=True)]
    place, normal, measured = (np.concatenate(parts) for parts in zip(*samples, strict=True))
    rotations = [scene.T_world_base[:3, :3] for scene in scenes]
    faces = [_in_base(scene.workspace.zone.faces, scene) for scene in scenes]
    return Tables(
        arm=np.array([[*scene.arm.packed, scene.arm.camera_m] for scene in scenes]),
        limits=np.array([servo_limits(scene.arm) for scene in scenes]),
        timing=np.array([servo_timing(scene.dt_s, scene.servo_lag_s) for scene in scenes]),
        start=np.array([scene.arm.clip(trial.start) for trial, scene in zip(trials, scenes, strict=True)]),
        up=np.array([UP @ rotation for rotation in rotations]),
        faces=np.array([one[np.minimum(np.arange(FACES), len(one) - 1)] for one in faces]),
        floor=np.array([_in_base(scene.workspace.floor[None], scene)[0] for scene in scenes]),
        side=np.array(
            [
                np.array(scene.workspace.preferred_side) @ rotation
                for scene, rotation in zip(scenes, rotations, strict=True)
            ]
        ),
        distances=np.array([[scene.distance_m, scene.workspace.proximity_m] for scene in scenes]),
        first=np.cumsum(lengths) - lengths,
        length=lengths,
        place=np.ascontiguousarray(place),
        normal=np.ascontiguousarray(normal),
        measured=measured,
    )


def _samples(
    trial: Trial, scene: ViewpointScene, steps: int | None
) -> tuple[FloatArray, FloatArray, NDArray[np.int64]]:
    """A trial's part of ``place``, ``normal`` and ``measured``."""
    rotation, base = scene.T_world_base[:3, :3], scene.T_world_base[:3, 3]
    poses, measured = trial.T_world_feature[:steps], trial.measured[:steps]
    # The last sample that was measured, of each; the first of all where none was yet, which nobody looks at.
    last = np.maximum.accumulate(np.where(measured, np.arange(len(poses)), -1))
    held = np.nan_to_num(poses[np.maximum(last, 0)])
    kinds = np.where(measured, 2, np.where(last >= 0, 1, 0)).astype(np.int64)
    return (held[:, :3, 3] - base) @ rotation, held[:, :3, 1] @ rotation, kinds


def _in_base(planes: FloatArray, scene: ViewpointScene) -> FloatArray:
    """Planes ``(n, 4)`` of the world in the base's frame: ``n . p = o`` is ``(R' n) . q = o - n . t`` there."""
    rotation, base = scene.T_world_base[:3, :3], scene.T_world_base[:3, 3]
    return np.column_stack([planes[:, :3] @ rotation, planes[:, 3] - planes[:, :3] @ base])
