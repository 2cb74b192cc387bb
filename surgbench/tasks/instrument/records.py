"""Records of instrument trackers."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from pydantic import model_validator

from surgbench.geometry import FloatArray
from surgbench.metrics import INTERVAL_COVERAGES, POSE_ERRORS
from surgbench.records.format import Frames, Number, Plug, Record, RecordSpec

# Errors that have one value for all frames together.
PER_ARM = ("translation_error_scaled_m", "jitter", "lag_ms", "start_lag_ms", "frames_to_recover")
# The same of recordings without truth, held against the robot's readings of its arms (docs/handeye.md).
JUDGED = ("handeye_rotation_rad", "handeye_translation_m", "lag_frames")
# Values between 0 and 1 of which a mean is a share, and has no spread: of frames, or of components of the state.
LOST_SHARES = ("lost_precision", "lost_recall")
SHARES = (*LOST_SHARES, *INTERVAL_COVERAGES)
# What recordings have in place of truth: marked tips, joint readings, and masks without an instrument (1, else 0).
REFERENCE_TIPS = "reference_tip_error_px"
# The sum of both tips' distances, as ``keypoint_error_px`` and the paper's figures on SurgPose are.
REFERENCE_KEYPOINTS = "reference_keypoint_error_px"
REFERENCE_JOINTS = ("reference_q1_error_rad", "reference_q2_error_rad", "reference_q3_error_rad")
REFERENCE_ERRORS = (REFERENCE_TIPS, REFERENCE_KEYPOINTS, *REFERENCE_JOINTS)
ABSENT = "absent"
# What is kept of each answer of the child process, which has an attribute of each name.
ANSWER_COLUMNS = (
    "start", "state", "confidence", "lost", "standard_deviations", "latency_ms", "latency_optimise_ms",
    "latency_keypoints_ms", "latency_filter_ms",
)  # fmt: skip


class InstrumentRecordSpec(RecordSpec):
    """Everything that the estimates of an instrument depend on."""

    arms: tuple[str, ...]
    mask_kind: str
    initialiser: Plug
    filter: Plug
    keypoints: Plug
    readings: str
    views: int = 1
    view: str | None = None
    scored: str = "raw"


class InstrumentFrames(Frames):
    """Per-frame results of an instrument tracker."""

    start: list[list[float]] = []
    state: list[list[float]] = []
    confidence: list[Number] = []
    lost: list[bool] = []
    standard_deviations: list[list[float] | None] = []
    latency_ms: list[Number] = []
    latency_optimise_ms: list[Number] = []
    latency_keypoints_ms: list[Number] = []
    latency_masks_ms: list[Number] = []
    latency_filter_ms: list[Number] = []

    @model_validator(mode="after")
    def _state_size(self) -> InstrumentFrames:
        if self.state and {len(state) for state in self.state} not in ({9}, {18}):
            raise ValueError("'state' must hold 9 or 18 numbers per frame")
        return self

    @property
    def states(self) -> FloatArray:
        """``(T, 9 * arms)`` estimated states."""
        return np.array(self.state, dtype=np.float64)


class InstrumentRecord(Record):
    """One run of an instrument tracker.

    Attributes:
        references: By what each plug-in was asked for, by kind.
    """

    whole: ClassVar[tuple[str, ...]] = (*PER_ARM, *JUDGED)
    error_names: ClassVar[tuple[str, ...]] = (
        *(*POSE_ERRORS, "mask_error", "mask_error_true", *PER_ARM, *JUDGED, *SHARES),
        *(*REFERENCE_ERRORS, ABSENT),
    )

    spec: InstrumentRecordSpec
    frames: InstrumentFrames
    references: dict[str, str] = {}
