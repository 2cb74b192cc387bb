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
from surgbench.viewpoint.scores import COST_TOLERANCES
from surgbench.viewpoint.servo import servo_limits, servo_timing
from surgbench.viewpoint.simulator import make_scene
from surgbench.viewpoint.trial import Trial
from surgbench.viewpoint.world_steps import NO_GO_M, SEEN, VIEWS, Tables, begin_worlds, step_worlds

# As many as a box has.
FACES = 6
# By their place in a row of `views`.
ERRORS = ("vva_deg", "fd_mm", "pf_deg", "an_deg", "pn_full_mm")
DEPTHS = ("no_go_depth_m", "floor_depth_m", "proximity_m")


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
        index: ``(N,)`` which step it is at; its trial's length where it has ended, or not begun.
        state: ``(N, 3, 6)`` set points, their velocities, joints.
        seen: ``(N, 15)`` feature and normal in the camera's frame, the world's up in it, feature and normal in the
            frame of the arm's base; metres.
        views: ``(N, 8)`` errors and depths after the last step, by the names of :data:`ERRORS` and :data:`DEPTHS`.
    """

    def __init__(
        self, trials: Sequence[Trial], count: int, *, registration: str = "translation", steps: int | None = None
    ) -> None:
        if not trials:
            raise DatasetError("an environment needs at least one trial")
        scenes = [make_scene(trial, registration=registration) for trial in trials]  # type: ignore[arg-type]
        self.tables = _tables(trials, scenes, steps)
        self.trial = np.zeros(count, dtype=np.int64)
        self.index = np.full(count, self.tables.length[0])
        self.state = np.zeros((count, 3, 6))
        self.seen, self.views = np.zeros((count, SEEN)), np.zeros((count, VIEWS))
        self._fastest = self.tables.limits[:, 2]
        self._nobody = np.zeros(count, dtype=bool)

    def begin(self, begun: NDArray[np.bool_], trial: NDArray[np.int64]) -> None:
        """Put worlds at the beginning of trials.

        Args:
            begun: ``(N,)`` which worlds.
            trial: ``(N,)`` on which trials.
        """
        self.trial[begun] = trial[begun]
        begin_worlds(self.tables, self.trial, begun, self.index, self.state, self.seen, self.views)

    def step(self, shares: FloatArray, frozen: NDArray[np.bool_] | None = None) -> None:
        """One step.

        Args:
            shares: ``(N, 6)`` wanted joint velocities, as shares of the largest, -1 to 1.
            frozen: ``(N,)`` worlds that stay as they are; those that have ended must be among them.
        """
        wanted = np.clip(shares, -1.0, 1.0) * self._fastest[self.trial]
        step_worlds(
            self.tables, self.trial, self.index, self._nobody if frozen is None else frozen, wanted, self.state,
            self.seen, self.views,
        )  # fmt: skip

    @property
    def ended(self) -> NDArray[np.bool_]:
        """``(N,)`` which worlds are at their trials' ends."""
        return np.asarray(self.index >= self.tables.length[self.trial])

    def measured(self, ahead: int = 0) -> NDArray[np.bool_]:
        """``(N,)`` whether the feature is measured now, or was ``-ahead`` steps before."""
        last = self.tables.length[self.trial] - 1
        sample = self.tables.first[self.trial] + np.clip(self.index + ahead, 0, last)
        return np.asarray(self.tables.measured[sample] == 2)

    def view_cost(self) -> FloatArray:
        """``(N,)`` the errors after the last step as one number (``surgbench.viewpoint.scores.COST_TOLERANCES``)."""
        terms = [(self.views[:, ERRORS.index(name)] / tolerance) ** 2 for name, tolerance in COST_TOLERANCES.items()]
        return np.asarray(np.sum(terms, axis=0))

    def broken_mm(self) -> FloatArray:
        """``(N,)`` how far the commanded camera is beyond all rules of place together, millimetres."""
        return np.asarray(1e3 * np.maximum(self.views[:, NO_GO_M:], 0.0).sum(axis=1))


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
