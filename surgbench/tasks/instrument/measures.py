"""Ours beside what was published."""

from __future__ import annotations

from surgbench.reproduce.compare import Measure

ROTATION = Measure("rotation_error_rad", "rotation", "rad", 4)
TRANSLATION = Measure("translation_error_m", "translation", "mm", 2, 1000.0)
TIPS = Measure("tip_error_m", "tips", "mm", 2, 1000.0)
JOINTS = tuple(Measure(f"q{n}_error_rad", f"q{n}", "rad", 4) for n in (1, 2, 3))
MASK = Measure("mask_error", "mask error", "", 4)
TRUE_MASK = Measure("mask_error_true", "true mask error", "", 4)
KEYPOINTS = Measure("keypoint_error_px", "keypoints", "px", 2)
TIME = Measure("latency_optimise_ms", "time", "ms", 2)

ALL = (ROTATION, TRANSLATION, TIPS, *JOINTS, MASK, TRUE_MASK, KEYPOINTS)
PUBLISHED = (ROTATION, TRANSLATION, *JOINTS, MASK, KEYPOINTS, TIME)
ABOVE_FLOOR = (ROTATION, TRANSLATION, TIPS, *JOINTS)
