"""What a controller of this kind keeps of a trial: the rules in the arm's frame, and how the feature moves."""

from __future__ import annotations

import numpy as np

from surgbench.geometry import FloatArray, inverse_transform
from surgbench.trackers.hierarchical.poses import is_usable
from surgbench.viewpoint.contract import ViewpointObservation, ViewpointScene
from surgbench.viewpoint.placement import UP


class ViewTask:
    """A scene in the frame of the arm's base, and a feature whose motion is filtered.

    Args:
        scene: The trial's constants.
        position_gain: alpha of the filter of the feature's position (alpha-beta, constant velocity; beta follows as
            Benedict and Bordner's, ``alpha^2 / (2 - alpha)``).
        normal_gain: The same for its normal.

    Attributes:
        arm: ``(3,)`` of the kinematics.
        reach_m: From tool to camera.
        distance_m: d_t.
        dt_s: Between steps.
        lag_s: Of the joints behind their set points, as told.
        lower: ``(6,)`` least joints.
        upper: ``(6,)`` largest.
        velocity: ``(6,)`` largest.
        acceleration: ``(6,)`` largest.
        rules: ``(3, 4)`` as :func:`surgbench.trackers.linearised.view.linearise` takes them.
        faces: ``(n, 4)`` of the zone, likewise.
    """

    def __init__(self, scene: ViewpointScene, position_gain: float, normal_gain: float) -> None:
        arm, workspace = scene.arm, scene.workspace
        self.arm, self.reach_m, self.distance_m = arm.packed, arm.camera_m, scene.distance_m
        self.dt_s, self.lag_s = scene.dt_s, scene.servo_lag_s
        self.lower, self.upper = arm.lower, arm.upper
        self.velocity, self.acceleration = np.array(arm.velocity), np.array(arm.acceleration)
        rotation, base = scene.T_world_base[:3, :3], scene.T_world_base[:3, 3]
        # A plane n . p = o of the world is (R' n) . q = o - n . t in the arm's frame.
        planes = np.vstack([workspace.floor, workspace.zone.faces])
        planes = np.column_stack([planes[:, :3] @ rotation, planes[:, 3] - planes[:, :3] @ base])
        self.rules = np.array([
            [*(UP @ rotation), workspace.proximity_m],
            planes[0],
            [*(np.array(workspace.preferred_side) @ rotation), 0.0],
        ])  # fmt: skip
        self.faces = np.ascontiguousarray(planes[1:])
        self._T_base_world = inverse_transform(scene.T_world_base)
        # Of position and normal, a row each.
        alpha = np.array([[position_gain], [normal_gain]])
        self._alpha, self._beta = alpha, alpha**2 / (2 - alpha)
        self._index: int | None = None

    def look(self, observation: ViewpointObservation) -> bool:
        """Take in where the feature is.

        Returns:
            Whether it is anywhere; nothing changes where it is not.
        """
        if not is_usable(observation.T_world_feature):
            return False
        measured = observation.T_world_feature[:3, [3, 1]].T @ self._T_base_world[:3, :3].T
        measured[0] += self._T_base_world[:3, 3]
        self.begins = self._index is None or observation.index != self._index + 1  # the first, or after a gap
        if self.begins:
            self._state, self._change = measured, np.zeros((2, 3))
        else:
            expected = self._state + self.dt_s * self._change
            self._state = expected + self._alpha * (measured - expected)
            self._change = self._change + self._beta / self.dt_s * (measured - expected)
        self._index = observation.index
        return True

    def ahead(self, seconds: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The feature and the naive place at some moments ahead (``(n,)``), each ``(n, 3)``."""
        at = self._state[:, None] + np.asarray(seconds)[:, None] * self._change[:, None]
        feature, normal = at
        length = np.linalg.norm(normal, axis=1, keepdims=True)
        normal = np.where(length > 1e-6, normal / np.maximum(length, 1e-6), self._state[1])
        return feature, feature + self.distance_m * normal

    def reachable(self, setpoint: FloatArray, velocity: FloatArray) -> FloatArray:
        """Least and largest set points ``(2, 6)`` after one step from which the joints can stop within their limits.

        Where they cannot any more, both are the place after the hardest braking.
        """
        change = self.acceleration * self.dt_s
        least, most = np.maximum(velocity - change, -self.velocity), np.minimum(velocity + change, self.velocity)
        # v dt + v^2 / 2a within the room that is left.
        up = np.sqrt(change**2 + 2 * self.acceleration * np.maximum(self.upper - setpoint, 0.0)) - change
        down = np.sqrt(change**2 + 2 * self.acceleration * np.maximum(setpoint - self.lower, 0.0)) - change
        most, least = np.clip(up, least, most), np.clip(-down, least, most)
        return np.clip(setpoint + self.dt_s * np.array([least, most]), self.lower, self.upper)
