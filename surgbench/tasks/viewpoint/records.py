"""Records of viewpoint controllers."""

from __future__ import annotations

from typing import ClassVar

from surgbench.records.format import Frames, Number, Record, RecordSpec
from surgbench.viewpoint.hand.measures import PERFORMANCE
from surgbench.viewpoint.scores import POSE_ERRORS, SIGNED, TRUE_ERRORS


class ViewpointRecordSpec(RecordSpec):
    """Everything that a camera's course depends on."""

    registration: str
    missing_face: bool = False
    hand: str | None = None
    steady: bool = False


class ViewpointFrames(Frames):
    """Per-step results of a viewpoint controller (:func:`surgbench.tasks.viewpoint.execute.measure`).

    Attributes:
        joints: Of the camera arm, after each step.
        setpoint: What they were told.
        asked: Whether the controller was asked.
        clipped: Whether its command lay outside the joint limits.
        solver: Whether it optimised.
        active: The rules active in the controller's own view, one bit each.
        rules: Those that speak against the naive pose, the same for all controllers.
        limit_violation: Whether the set point lay outside the joint limits.
        no_go_depth_m: How deep in the no-go zone the commanded camera was; negative outside.
        floor_depth_m: How far below the floor; negative above.
        proximity_m: How much too near the feature; negative where it was not.
        latency_ms: What the step took.
        projected_px: u and v of the feature in the left and the right picture, ``None`` where it is outside.
        tags_px: The same as found by the tags in rendered pictures; ``None`` where no picture was taken.
        ring: Where a simulated hand led the feature: rotation vector and place of T_world_feature. With a hand alone.
        contact: Whether ring and wire touched then.
        sight: In which view the hand saw it (:mod:`surgbench.viewpoint.hand.operation`).
    """

    joints: list[list[float]] = []
    setpoint: list[list[float]] = []
    asked: list[bool] = []
    clipped: list[bool] = []
    solver: list[bool] = []
    active: list[int] = []
    rules: list[int] = []
    limit_violation: list[bool] = []
    no_go_depth_m: list[float] = []
    floor_depth_m: list[float] = []
    proximity_m: list[float] = []
    projected_px: list[list[Number]] = []
    tags_px: list[list[Number] | None] = []
    latency_ms: list[Number] = []
    ring: list[list[float]] = []
    contact: list[bool] = []
    sight: list[int] = []


class ViewpointRecord(Record):
    """One run of a viewpoint controller."""

    whole: ClassVar[tuple[str, ...]] = PERFORMANCE
    error_names: ClassVar[tuple[str, ...]] = (*POSE_ERRORS, SIGNED, *TRUE_ERRORS, *PERFORMANCE)

    spec: ViewpointRecordSpec
    frames: ViewpointFrames
