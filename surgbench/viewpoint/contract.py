"""The contract between the suite and a controller of the camera's viewpoint.

A controller is any class with a ``name``, ``task = "viewpoint"``, ``reset`` and ``step``; a plain array is a valid
answer. All poses are *reported* ones: what the robot says of itself, registration error and all. World frame: metres,
z up.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np

from surgbench.contract import Plugin
from surgbench.geometry import FloatArray
from surgbench.viewpoint.camera_arm import CameraArm
from surgbench.viewpoint.workspace import Workspace


@dataclass(frozen=True, eq=False)
class ViewpointScene:
    """What stays the same over a trial.

    Attributes:
        arm: The arm that holds the camera: kinematics and limits.
        T_world_base: ``(4, 4)`` where its base is, as the registration of the arms has it.
        workspace: Where the camera must not be.
        distance_m: d_t, from camera to feature.
        dt_s: Seconds between steps.
        servo_lag_s: Time constant with which the joints follow their set points, as far as is known beforehand.
        registration_error_m: What the registration leaves between the arms' touched points, on average: the error that
            it states of itself.
        future: ``(T, 4, 4)`` the whole trial's features as they will be measured, NaN where they will not be; for
            controllers that say :attr:`ViewpointTracker.foresees` alone, ``None`` for all others.
    """

    arm: CameraArm
    T_world_base: FloatArray
    workspace: Workspace
    distance_m: float
    dt_s: float
    servo_lag_s: float
    registration_error_m: float = 0.0
    future: FloatArray | None = None


@dataclass(frozen=True, eq=False)
class ViewpointObservation:
    """What a controller may know at one step.

    Attributes:
        index: Step, from 0.
        timestamp_s: Seconds since the first.
        T_world_feature: ``(4, 4)`` the feature as measured: origin in the ring's centre, y axis along the ring's
            normal, the side the camera should see.
        joints: ``(6,)`` measured joints of the camera arm.
        setpoint: ``(6,)`` joints that the arm is being told at this moment, limits obeyed.
        setpoint_velocity: ``(6,)`` how fast these move.
    """

    index: int
    timestamp_s: float
    T_world_feature: FloatArray
    joints: FloatArray
    setpoint: FloatArray
    setpoint_velocity: FloatArray


@dataclass(frozen=True, eq=False)
class ViewCommand:
    """A controller's answer.

    Attributes:
        target: ``(6,)`` joints, or ``(4, 4)`` T_world_camera, which the arm turns into joints in closed form. Joints
            outside the limits are clipped to them.
        mode: ``"move"``: go there and stop, all joints arriving together, on a trajectory within the limits of velocity
            and acceleration that starts from where the arm is (dVRK ``move_jp``, ``move_cp``); the next command takes
            over. ``"servo"``: be there at the next step (``servo_jp``); joints that cannot, do so as soon as they can.
        velocity: ``(6,)`` velocity at the target, ``"servo"`` only; zero unless told.
        active: Names of the rules that were active in the controller's own view, for the timeline; of
            :data:`surgbench.viewpoint.placement.CONSTRAINTS`.
        solver: Whether it had to optimise.

    Example:
        Be at these joints of the arm at the next step, at rest: yaw, pitch (rad), insertion (m), roll, wrist pitch,
        wrist yaw (rad).

        >>> import numpy as np
        >>> from surgbench.viewpoint.contract import ViewCommand
        >>> command = ViewCommand(np.array([0.0, 0.1, 0.12, 0.0, 0.0, 0.0]), mode="servo")
    """

    target: FloatArray
    mode: Literal["move", "servo"] = "move"
    velocity: FloatArray | None = None
    active: tuple[str, ...] = ()
    solver: bool = False


class ViewpointTracker(Plugin):
    """Commands a camera-holding arm so that a moving feature stays in view, at the wanted distance and angle.

    Example:
        Straight before the feature, 11 cm along its normal (its y axis), whatever the rules say:

        >>> import numpy as np
        >>> from surgbench.viewpoint.contract import ViewpointObservation, ViewpointTracker
        >>> from surgbench.viewpoint.placement import naive_pose
        >>> class Straight(ViewpointTracker):
        ...     name = "straight"
        ...
        ...     def reset(self, scene, joints, rng): ...
        ...
        ...     def step(self, observation):
        ...         return naive_pose(observation.T_world_feature, distance_m=0.11)
        >>> still, T_world_feature = np.zeros(6), np.eye(4)
        >>> T_world_camera = Straight().step(ViewpointObservation(0, 0.0, T_world_feature, still, still, still))
        >>> T_world_camera[:3, 3]  # metres
        array([0.  , 0.11, 0.  ])
    """

    task: ClassVar[str] = "viewpoint"
    # An optimum in hindsight, to hold the others against: it is told the future, which no controller can know.
    foresees: ClassVar[bool] = False
    # The answers come from elsewhere, over a line: there is nothing to warm up, and the line may break. Then it answers
    # with the place where the arm comes to rest, and says in ``held`` the status of the run and one line on why.
    elsewhere: ClassVar[bool] = False
    held: tuple[str, str] | None = None

    def reset(self, scene: ViewpointScene, joints: FloatArray, rng: np.random.Generator) -> None:
        """Start a trial with the arm at rest at ``joints`` (``(6,)``). Untimed; everything slow belongs here."""
        raise NotImplementedError

    def step(self, observation: ViewpointObservation) -> FloatArray | ViewCommand:
        """Say where the camera arm should go. Timed."""
        raise NotImplementedError
