"""Columns that tables of the instrument task are read by."""

from __future__ import annotations

from surgbench.report.column import ROW, VARIANT, Column

COLUMNS = (
    ROW,
    VARIANT,
    Column("sequences", "seq.", "sequences"),
    Column("coverage", "done\n%", "done [%]", 0, 100.0),
    Column("mask_error", "mask\nerror", "mask error", 3, best=True),
    Column("mask_error_true", "true\nmask", "true mask error", 3, best=True, from_width=100),
    Column("rotation_error_rad", "rot.\nrad", "rotation [rad]", 3, best=True),
    Column("translation_error_m", "trans.\nmm", "translation [mm]", 2, 1000.0, best=True),
    Column("tip_error_m", "tips\nmm", "tips [mm]", 2, 1000.0, best=True, from_width=100),
    Column("q1_error_rad", "q1\nrad", "q1 [rad]", 3, best=True),
    Column("q2_error_rad", "q2\nrad", "q2 [rad]", 3, best=True),
    Column("q3_error_rad", "q3\nrad", "q3 [rad]", 3, best=True),
    Column("keypoint_error_px", "tips\npx", "keypoints [px]", 1, best=True),
    Column("start_lag_ms", "start\nlag ms", "start lag [ms]", 1, from_width=130),
    Column("latency_ms", "time\nms", "latency [ms]", 1, best=True),
    Column("latency_ms_p95", "p95\nms", "p95 [ms]", 1, from_width=100),
)
