"""Columns that tables of the viewpoint task are read by."""

from __future__ import annotations

from surgbench.report.column import ROW, VARIANT, Column

# Of viewpoint controllers; the page has every subset of the samples, the terminal all of them together.
COLUMNS = (
    ROW,
    VARIANT,
    Column("subset", "samples\nof", "samples"),
    Column("samples", "n", "n", from_width=110),
    Column("coverage", "done\n%", "done [%]", 0, 100.0),
    Column("vva_deg", "VVA\ndeg", "VVA [deg]", 2, best=True),
    Column("fd_mm", "FD\nmm", "FD [mm]", 2, best=True),
    Column("pf_deg", "PF\ndeg", "PF [deg]", 2, best=True),
    Column("an_deg", "AN\ndeg", "AN [deg]", 1, best=True),
    Column("pn_mm", "PN\nmm", "PN [mm]", 1, best=True),
    Column("vva_true_deg", "true\nVVA", "true VVA [deg]", 2, best=True, from_width=90),
    Column("constrained_percent", "bound\n%", "constrained [%]", 1),
    Column("visibility_any_percent", "seen\n%", "visible to a camera [%]", 2, from_width=90),
    Column("no_go_violations", "no-\ngo", "no-go violations"),
    Column("limit_violations", "limit", "limit violations", from_width=100),
    Column("latency_ms", "time\nms", "latency [ms]", 3, best=True),
    Column("latency_ms_p999", "p99.9\nms", "p99.9 [ms]", 3, from_width=90),
)
