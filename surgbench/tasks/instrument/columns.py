"""Columns that tables of the instrument task are read by."""

from __future__ import annotations

from dataclasses import replace

from surgbench.metrics import INTERVAL_COVERAGES
from surgbench.report.column import LATENCY, ROW, VARIANT, Column
from surgbench.report.losses import SHOWN_LOSSES
from surgbench.reproduce.over_sequences import FRAMES_PER_SECOND
from surgbench.tasks.instrument.records import REFERENCE_JOINTS, REFERENCE_KEYPOINTS, REFERENCE_TIPS, SOURCE_ERROR

MASK = Column("mask_error", "mask error", "", 3, short="mask\nerror", best=True)
TRUE_MASK = Column("mask_error_true", "true mask error", "", 3, short="true\nmask", best=True)
MADE_MASKS = Column(SOURCE_ERROR, "made masks off", "", 3, short="made\nmasks", best=True)
ROTATION = Column("rotation_error_rad", "rotation", "rad", 3, short="rot.\nrad", best=True)
TRANSLATION = Column("translation_error_m", "translation", "mm", 2, 1000.0, short="trans.\nmm", best=True)
TIPS = Column("tip_error_m", "tips", "mm", 2, 1000.0, short="tips\nmm", best=True)
JOINTS = tuple(Column(f"q{n}_error_rad", f"q{n}", "rad", 3, short=f"q{n}\nrad", best=True) for n in (1, 2, 3))
KEYPOINTS = Column("keypoint_error_px", "keypoints", "px", 1, short="tips\npx", best=True)
# What papers say of recordings is of the marked tips.
IN_RECORDINGS = {KEYPOINTS.key: REFERENCE_KEYPOINTS}
# What recordings have in place of truth: nobody's best, for they err themselves.
MARKED_TIPS = Column(REFERENCE_TIPS, "marked tips", "px", 1, short="marked\ntips px")
READ_JOINTS = tuple(
    Column(key, f"q{n} from reading", "rad", 3, short=f"q{n} off\nreading")
    for n, key in enumerate(REFERENCE_JOINTS, start=1)
)
ABSENT_FRAMES = Column("absent_frames", "without instrument", short="without\ninstr.")

# Against the robot's readings, of recordings without truth.
HAND_EYE = (
    Column("handeye_rotation_rad", "hand-eye rotation", "rad", 3, short="arm\nrad", best=True),
    Column("handeye_translation_m", "hand-eye translation", "mm", 2, 1000.0, short="arm\nmm", best=True),
    Column("lag_frames", "lag of readings", "frames", 1, short="lag\nframes"),
)

COLUMNS = (
    ROW,
    VARIANT,
    Column("sequences", "sequences", short="seq."),
    Column("coverage", "done", "%", 0, 100.0, short="done\n%"),
    MASK,
    TRUE_MASK,
    MADE_MASKS,
    *HAND_EYE,
    ROTATION,
    TRANSLATION,
    TIPS,
    *JOINTS,
    KEYPOINTS,
    MARKED_TIPS,
    *READ_JOINTS,
    ABSENT_FRAMES,
    *SHOWN_LOSSES,
    Column("start_lag_ms", "start lag", "ms", 1, short="start\nlag ms"),
    LATENCY,
    Column("latency_ms_p95", "p95", "ms", 1, short="p95\nms"),
)

# Shares of what was said of itself that was right, in blocks of their own where a row has them.
SURE = tuple(
    Column(key, name, "%", 1, 100.0)
    for key, name in zip(INTERVAL_COVERAGES, ("all", "rotation", "translation", "q1", "q2", "q3"), strict=True)
)
RECOVERY = Column("frames_to_recover", "frames to recover", "", 1)
SWAPS = Column("swaps", "swaps")
OUT_OF_VIEW = (
    Column("lost_precision", "precision of lost", "%", 1, 100.0),
    Column("lost_recall", "recall of lost", "%", 1, 100.0),
    RECOVERY,
)

# Reproduced tables, beside published figures of as many digits.
PAGE_LATENCY = replace(LATENCY, decimals=2)
# The tracker's own part of it, without tips, masks and filter: what the paper's times are of.
PAGE_OPTIMISATION = Column("latency_optimise_ms", "optimisation", "ms", 2)
PAGE_P95 = Column("latency_ms_p95", "p95", "ms", 2)
_PAGE_ROTATION, _PAGE_MASK, PAGE_TRUE_MASK, *_PAGE_JOINTS = (
    replace(column, decimals=4) for column in (ROTATION, MASK, TRUE_MASK, *JOINTS)
)
_PAGE_KEYPOINTS = replace(KEYPOINTS, decimals=2)
# Where masks are made of images: how far they are off, and what that took.
PAGE_MADE_MASKS = replace(MADE_MASKS, decimals=4)
PAGE_MASK_SOURCE = Column("latency_masks_ms", "mask source", "ms", 2)
PAGE_RATE = Column(FRAMES_PER_SECOND, "frames per second", "1/s", 2)
# After the one factor in distance that a silhouette cannot show.
PAGE_SCALED = Column("translation_error_scaled_m", "translation, scaled", "mm", 2, 1000.0)
PAGE_POSE = (_PAGE_ROTATION, TRANSLATION, TIPS, *_PAGE_JOINTS)
PAGE_ERRORS = (*PAGE_POSE, _PAGE_MASK, PAGE_TRUE_MASK, _PAGE_KEYPOINTS)
PUBLISHED = (_PAGE_ROTATION, TRANSLATION, *_PAGE_JOINTS, _PAGE_MASK, PAGE_TRUE_MASK, _PAGE_KEYPOINTS, PAGE_OPTIMISATION)
