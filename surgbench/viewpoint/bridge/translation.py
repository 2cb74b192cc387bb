"""Messages of the bridge to and from what controllers are told and answer."""

from __future__ import annotations

import numpy as np

from surgbench.geometry import FloatArray, is_rigid
from surgbench.instrument.arm import Manipulator
from surgbench.viewpoint.bridge.messages import (
    ArmEntry,
    Command,
    Id,
    MessageError,
    ObservationMessage,
    SceneMessage,
    WorkspaceEntry,
    rows,
)
from surgbench.viewpoint.camera_arm import PSM_CLASSIC, CameraArm
from surgbench.viewpoint.contract import ViewCommand, ViewpointObservation, ViewpointScene
from surgbench.viewpoint.receiver import Received
from surgbench.viewpoint.workspace import NoGoZone, Workspace, WorkspaceError


def tell_scene(scene: ViewpointScene, joints: FloatArray, id: Id, seed: int) -> SceneMessage:
    """What a controller is told of a trial, with the arm at rest at ``joints`` (``(6,)``)."""
    workspace = scene.workspace
    return SceneMessage(
        id=id,
        dt_s=scene.dt_s,
        servo_lag_s=scene.servo_lag_s,
        distance_m=scene.distance_m,
        registration_error_m=scene.registration_error_m,
        T_world_base=rows(scene.T_world_base),
        joints=tuple(joints.tolist()),
        seed=seed,
        arm=tell_arm(scene.arm),
        workspace=WorkspaceEntry(
            zone_m=rows(workspace.zone.points),
            missing_face=workspace.zone.missing_face,
            floor_m=workspace.floor_m,
            proximity_m=workspace.proximity_m,
            preferred_side=workspace.preferred_side,
        ),
    )


def tell_arm(arm: CameraArm) -> ArmEntry:
    """An arm as messages have it."""
    insertion_offset_m, roll_offset_m, wrist_length_m = arm.packed.tolist()
    return ArmEntry(
        insertion_offset_m=insertion_offset_m,
        roll_offset_m=roll_offset_m,
        wrist_length_m=wrist_length_m,
        camera_m=arm.camera_m,
        lower=tuple(arm.lower.tolist()),
        upper=tuple(arm.upper.tolist()),
        velocity=tuple(np.asarray(arm.velocity, dtype=np.float64).tolist()),
        acceleration=tuple(np.asarray(arm.acceleration, dtype=np.float64).tolist()),
    )


def understand_arm(entry: ArmEntry | None) -> CameraArm:
    """The arm of a message; ours where it tells of none.

    Raises:
        MessageError: A lower limit is above the upper one.
    """
    if entry is None:
        return PSM_CLASSIC
    if any(lower > upper for lower, upper in zip(entry.lower, entry.upper, strict=True)):
        raise MessageError("a lower joint limit of the arm is above the upper one")
    return CameraArm(
        manipulator=Manipulator(entry.roll_offset_m, entry.insertion_offset_m, entry.lower[:4], entry.upper[:4]),
        wrist_length_m=entry.wrist_length_m,
        wrist_lower_rad=entry.lower[4:],
        wrist_upper_rad=entry.upper[4:],
        velocity=entry.velocity,
        acceleration=entry.acceleration,
        camera_m=entry.camera_m,
        name="the client's",
    )


def understand_scene(message: SceneMessage) -> tuple[ViewpointScene, FloatArray]:
    """The scene of a message, and the joints ``(6,)`` at which the arm rests, within the limits.

    Raises:
        MessageError: The zone is none, the base's pose is not rigid, or the arm rests outside its limits.
    """
    arm, told = understand_arm(message.arm), message.workspace
    base, joints = np.array(message.T_world_base), np.array(message.joints)
    if not is_rigid(base):
        raise MessageError("T_world_base is not a rotation and a translation")
    if not arm.within_limits(joints, 1e-6):
        raise MessageError("the arm rests outside its joint limits")
    try:
        zone = NoGoZone(np.array(told.zone_m), told.missing_face)
    except WorkspaceError as error:
        raise MessageError(str(error)) from None
    if abs(float(np.linalg.norm(told.preferred_side)) - 1.0) > 1e-6:
        raise MessageError("preferred_side must be of unit length")
    scene = ViewpointScene(
        arm,
        base,
        Workspace(zone, told.floor_m, told.proximity_m, told.preferred_side),
        message.distance_m,
        message.dt_s,
        message.servo_lag_s,
        message.registration_error_m,
    )
    return scene, arm.clip(joints)


def tell_observation(observation: ViewpointObservation, id: Id) -> ObservationMessage:
    """A step."""
    return ObservationMessage(
        id=id,
        index=observation.index,
        timestamp_s=observation.timestamp_s,
        T_world_feature=rows(observation.T_world_feature),
        joints=tuple(observation.joints.tolist()),
        setpoint=tuple(observation.setpoint.tolist()),
        setpoint_velocity=tuple(observation.setpoint_velocity.tolist()),
    )


def understand_observation(message: ObservationMessage) -> ViewpointObservation:
    """The step of a message; the feature is NaN where it tells of none."""
    feature = np.full((4, 4), np.nan) if message.T_world_feature is None else np.array(message.T_world_feature)
    return ViewpointObservation(
        message.index,
        message.timestamp_s,
        feature,
        np.array(message.joints),
        np.array(message.setpoint),
        np.array(message.setpoint_velocity),
    )


def tell_command(received: Received, id: Id, held: str | None = None) -> Command:
    """A command as the arm takes it."""
    return Command(
        id=id,
        joints=tuple(received.goal.tolist()),
        mode="move" if received.velocity is None else "servo",
        velocity=None if received.velocity is None else tuple(received.velocity.tolist()),
        active=received.active,
        solver=received.solver,
        held=held,
    )


def understand_command(message: Command) -> ViewCommand:
    """The command of a message."""
    target = np.array(message.joints if message.pose is None else message.pose)
    velocity = None if message.velocity is None else np.array(message.velocity)
    return ViewCommand(target, message.mode, velocity, message.active, message.solver)
