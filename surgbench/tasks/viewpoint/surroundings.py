"""What stands around a recorded motion: as a scene's file says, and for the rest as AutoCam had it around its own.

The no-go zone is a box around the motion, of AutoCam's size at least. The camera arm's remote centre is on the side
that the feature's normals point to, as far and as high from the middle of the box as on AutoCam's robot (0.203 and 0.19
m), and its base is turned about the vertical so that the arm works amid its limits. Both arms touched the same points
without error. World frame: metres, z up.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from surgbench.errors import ConfigError
from surgbench.geometry import FloatArray, inverse_transform, rigid_transform, rotation_from_vector
from surgbench.tasks.viewpoint.scene_file import SceneFile
from surgbench.viewpoint.camera_arm import CameraArm
from surgbench.viewpoint.placement import UP
from surgbench.viewpoint.registration import RegistrationError, Touches, register, residual_m
from surgbench.viewpoint.setting_up import aim, rest, turned_base
from surgbench.viewpoint.workspace import PREFERRED_SIDE, NoGoZone, Workspace

# AutoCam's box, and what is left around a motion, at its sides and top, and below.
BOX_M, MARGIN_M, BELOW_M = np.array([0.082, 0.076, 0.049]), 0.002, 0.006
# Of the remote centre from the middle of the box: towards the normals' side, and up.
REMOTE_M, REMOTE_UP_M = 0.203, 0.190
# Touched points are off by millimetres; those that are farther apart are not the same ones.
TOUCHED_M = 0.01
# Where both arms touched, as shares of the box.
TOUCHED = np.array([[-0.3, -0.35, 0.9], [0.3, -0.35, 0.2], [0.3, 0.35, 0.9], [-0.3, 0.35, 0.2], [0.0, 0.0, 0.5]])
CORNERS = np.array([[-0.5, 0.5, 0.0], [0.5, 0.5, 0.0], [0.5, -0.5, 0.0], [-0.5, -0.5, 0.0], [0.0, 0.0, 1.0]])
# Normals that together are shorter than this point to no side, and ones that point farther down than this are doubted.
LEAST_SIDE, DOWN = 0.1, -0.1
# A box longer than this is told.
LARGE_M = 0.2


@dataclass(frozen=True, eq=False)
class Surroundings:
    """What stands around a motion.

    Attributes:
        T_world_base: ``(4, 4)`` the camera arm's base, before registration.
        touches: The points that both arms touched.
        workspace: The rules.
        lines: What was assumed, one line, and warnings.
    """

    T_world_base: FloatArray
    touches: Touches
    workspace: Workspace
    lines: tuple[str, ...]


def surround(scene: SceneFile, arm: CameraArm, T_world_feature: FloatArray) -> Surroundings:
    """Put around a motion what its scene leaves out.

    Args:
        scene: From the user's file, or an empty one.
        arm: Holds the camera.
        T_world_feature: ``(n, 4, 4)`` all features that were measured.

    Raises:
        WorkspaceError: The zone's points span no box.
        ConfigError: The touched points say too little on where the base is.
    """
    assumed, warnings = [], []
    normal = T_world_feature[:, :3, 1].mean(axis=0)
    side = float(np.hypot(*normal[:2]))
    towards = np.append(normal[:2] / side, 0.0) if side > LEAST_SIDE else np.array(PREFERRED_SIDE)
    if normal[2] < DOWN * np.linalg.norm(normal):
        warnings.append(
            "warning: the feature's normal points down on average, and no camera may be below it; is it another axis "
            "of the tool? --normal"
        )
    box = _box(T_world_feature[:, :3, 3], towards)
    if scene.zone_m is None:
        zone = box.place(CORNERS)
        assumed.append("a no-go zone of {:.0f} x {:.0f} x {:.0f} mm around the motion".format(*(1e3 * box.size_m)))
        if box.size_m.max() > LARGE_M:
            warnings.append("warning: the no-go zone around the motion is large; zone_m of --scene says where it is")
    else:
        zone = np.array(scene.zone_m)
    preferred = towards if scene.preferred_side is None else np.array(scene.preferred_side)
    preferred = preferred / np.linalg.norm(preferred)
    if scene.preferred_side is None:
        assumed.append("the camera on the side that the normals point to")
    base = _told_base(scene)
    if base is None:
        remote = box.place(np.array([0.0, 0.0, 0.5])) + REMOTE_M * towards + REMOTE_UP_M * UP
        base = turned_base(arm, rigid_transform(np.eye(3), remote), T_world_feature, scene.distance_m)
        assumed.append(f"the remote centre of '{arm.name}' {np.hypot(REMOTE_M, REMOTE_UP_M):.2f} m beyond it")
    touches = _touches(scene, base, box)
    if scene.touches is None:
        assumed.append("a registration without error")
    elif len(touches.world_m) > 2:
        warnings += _misfit(base, touches)
    x, y, z = (float(value) for value in preferred)
    workspace = Workspace(NoGoZone(zone), scene.floor_m, scene.proximity_m, (x, y, z))
    said = [f"assumed: {', '.join(assumed)}; --scene FILE.yaml says otherwise"] if assumed else []
    return Surroundings(base, touches, workspace, (*said, *warnings))


def _misfit(T_world_base: FloatArray, touches: Touches) -> list[str]:
    """A warning where touched points fit no base well; those that are on a line say nothing."""
    try:
        residual = residual_m(register(T_world_base, touches, "rigid"), touches)
    except RegistrationError:
        return []
    if residual <= TOUCHED_M:
        return []
    return [
        f"warning: the touched points are {1e3 * residual:.0f} mm apart in the mean, however the base is turned; are "
        "world_m and base_m in the same order?"
    ]


def first_joints(
    scene: SceneFile, arm: CameraArm, around: Surroundings, T_world_feature: FloatArray
) -> tuple[FloatArray, str | None]:
    """Joints ``(6,)`` where the arm rests before a trial, and a warning where the rules allow none.

    Args:
        scene: May say them.
        arm: Holds the camera.
        around: What stands around.
        T_world_feature: ``(4, 4)`` the first that was measured.
    """
    if scene.start is not None:
        return np.array(scene.start), None
    base = register(around.T_world_base, around.touches, "translation")
    found = rest(T_world_feature, scene.distance_m, around.workspace, arm, base)
    if found is not None:
        return found, None
    view = aim(arm, base, T_world_feature, scene.distance_m)
    return view.joints, "warning: the rules allow no place for the camera at first; the arm begins where it sees best"


@dataclass(frozen=True, eq=False)
class _Box:
    """A box with upright sides.

    Attributes:
        T_world_box: ``(4, 4)`` the middle of its base, x towards the camera's side.
        size_m: ``(3,)``.
    """

    T_world_box: FloatArray
    size_m: FloatArray

    def place(self, shares: FloatArray) -> FloatArray:
        """Points ``(..., 3)`` in the world, of shares of the box's size."""
        return np.asarray((shares * self.size_m) @ self.T_world_box[:3, :3].T + self.T_world_box[:3, 3])


def _box(points_m: FloatArray, towards: FloatArray) -> _Box:
    turn = rotation_from_vector(np.arctan2(towards[1], towards[0]) * UP)
    low, high = ((points_m @ turn).min(axis=0), (points_m @ turn).max(axis=0))
    size = np.maximum(high - low + [2 * MARGIN_M, 2 * MARGIN_M, BELOW_M + MARGIN_M], BOX_M)
    middle = np.append(((low + high) / 2)[:2], low[2] - BELOW_M)
    return _Box(rigid_transform(turn, turn @ middle), size)


def _told_base(scene: SceneFile) -> FloatArray | None:
    if scene.base is not None:
        return scene.base.matrix()
    if scene.touches is None:
        return None
    try:
        return register(np.eye(4), _told_touches(scene), "rigid")
    except RegistrationError as error:
        raise ConfigError(f"touches say where the base is, unless 'base' does: {error}") from None


def _told_touches(scene: SceneFile) -> Touches:
    assert scene.touches is not None
    return Touches(np.reshape(scene.touches.world_m, (-1, 3)), np.reshape(scene.touches.base_m, (-1, 3)))


def _touches(scene: SceneFile, base: FloatArray, box: _Box) -> Touches:
    if scene.touches is not None and scene.touches.world_m:
        return _told_touches(scene)
    into_base, touched = inverse_transform(base), box.place(TOUCHED)
    return Touches(touched, touched @ into_base[:3, :3].T + into_base[:3, 3])
