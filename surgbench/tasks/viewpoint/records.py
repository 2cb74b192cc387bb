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
    disturbance: dict[str, float] = {}
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
        no_go_mm: How far the camera was beyond each rule after the step, on reported poses, as the following four;
            negative within it (:mod:`surgbench.viewpoint.rules`).
        floor_mm: Of the floor.
        orientation_deg: Of the side.
        proximity_mm: Of the smallest distance; ``None`` where the feature was not measured.
        joint_limit_deg: Of the joints' limits.
        no_go_mm_true: The same on true poses, as the following four; empty without truth.
        floor_mm_true: Of the floor.
        orientation_deg_true: Of the side.
        proximity_mm_true: Of the smallest distance.
        joint_limit_deg_true: Of the joints' limits.
        unavoidable: The rules that no motion within the arm's limits could have kept, one bit each; empty where nobody
            looked.
        latency_ms: What the step took.
        projected_px: u and v of the feature in the left and the right picture, ``None`` where it is outside.
        ring_seen: Which share of the ring is in the left and the right picture and covered by neither the tool nor what
            it holds.
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
    no_go_mm: list[Number] = []
    floor_mm: list[Number] = []
    orientation_deg: list[Number] = []
    proximity_mm: list[Number] = []
    joint_limit_deg: list[Number] = []
    no_go_mm_true: list[Number] = []
    floor_mm_true: list[Number] = []
    orientation_deg_true: list[Number] = []
    proximity_mm_true: list[Number] = []
    joint_limit_deg_true: list[Number] = []
    unavoidable: list[int] = []
    projected_px: list[list[Number]] = []
    ring_seen: list[list[Number]] = []
    tags_px: list[list[Number] | None] = []
    latency_ms: list[Number] = []
    ring: list[list[float]] = []
    contact: list[bool] = []
    sight: list[int] = []


class ViewpointRecord(Record):
    """One run of a viewpoint controller.

    Attributes:
        dt_s: Seconds between steps; ``None`` in records of old versions.
    """

    whole: ClassVar[tuple[str, ...]] = PERFORMANCE
    error_names: ClassVar[tuple[str, ...]] = (*POSE_ERRORS, SIGNED, *TRUE_ERRORS, *PERFORMANCE)

    spec: ViewpointRecordSpec
    dt_s: Number = None
    frames: ViewpointFrames
