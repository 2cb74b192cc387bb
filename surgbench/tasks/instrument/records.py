"""Records of instrument trackers."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
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
# Of two arms: how often the tracks exchanged their arms, and how often an arm was hidden and both were seen again ...
SWAPS, OVERLAPS = "swaps", "overlaps"
# ... and shares: of those times, out of which tracks came right; of hidden frames, those said to be lost or right; of
# frames far off, those said to be lost or doubtful. What is seen of each arm against its own mask is an error.
RIGHT_WAY_ROUND, HIDDEN_KNOWN, FAR_OFF_DOUBTED = "right_way_round", "hidden_known", "far_off_doubted"
MASK_ARMS = "mask_error_arms"
PAIR_COUNTS = (SWAPS, OVERLAPS)
PAIR_ERRORS = (RIGHT_WAY_ROUND, HIDDEN_KNOWN, FAR_OFF_DOUBTED, MASK_ARMS)
# What is kept of each answer of the child process, which has an attribute of each name.
ANSWER_COLUMNS = (
    "start", "state", "confidence", "lost", "standard_deviations", "latency_ms", "latency_optimise_ms",
    "latency_keypoints_ms", "latency_filter_ms",
)  # fmt: skip
# The same, of two arms: each arm's own.
ARM_COLUMNS = ("confidence_arms", "lost_arms")
# The same, where masks are made: what that took, and how sure the source was.
SOURCE_COLUMNS = ("latency_masks_ms", "confidence_masks")
# One minus the intersection over union of the made masks with what truly shows.
SOURCE_ERROR = "mask_source_error"


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
    masks: str = "union"
    scored: str = "raw"
    mask_source: Plug | None = None


class InstrumentFrames(Frames):
    """Per-frame results of an instrument tracker.

    Of two arms ``lost`` says whether either is, ``confidence`` is that of the less certain one; each arm's own are in
    ``lost_arms`` and ``confidence_arms``, which records of one arm have not, and old ones of two.
    """

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
    confidence_arms: list[list[Number]] = []
    lost_arms: list[list[bool]] = []
    confidence_masks: list[Number] = []

    @model_validator(mode="after")
    def _state_size(self) -> InstrumentFrames:
        if self.state and {len(state) for state in self.state} not in ({9}, {18}):
            raise ValueError("'state' must hold 9 or 18 numbers per frame")
        return self

    def lost_of(self, arm: int) -> NDArray[np.bool_]:
        """``(T,)`` of which frames the tracker says that it has lost an arm."""
        if self.lost_arms:
            return np.array(self.lost_arms, dtype=bool)[:, arm]
        return np.array(self.lost or [False] * len(self.index), dtype=bool)

    def confidence_of(self, arm: int) -> FloatArray:
        """``(T,)`` how sure the tracker is of an arm, NaN where it has not said."""
        if self.confidence_arms:
            return np.array(self.confidence_arms, dtype=np.float64)[:, arm]
        return np.array(self.confidence or [None] * len(self.index), dtype=np.float64)

    @property
    def states(self) -> FloatArray:
        """``(T, 9 * arms)`` estimated states."""
        return np.array(self.state, dtype=np.float64)


class InstrumentRecord(Record):
    """One run of an instrument tracker.

    Attributes:
        references: By what each plug-in was asked for, by kind.
    """

    whole: ClassVar[tuple[str, ...]] = (*PER_ARM, *JUDGED, *PAIR_COUNTS, RIGHT_WAY_ROUND)
    error_names: ClassVar[tuple[str, ...]] = (
        *(*POSE_ERRORS, "mask_error", "mask_error_true", *PER_ARM, *JUDGED, *SHARES),
        *(*REFERENCE_ERRORS, ABSENT, *PAIR_COUNTS, *PAIR_ERRORS, SOURCE_ERROR),
    )

    spec: InstrumentRecordSpec
    frames: InstrumentFrames
    references: dict[str, str] = {}
