"""Columns that tables of the viewpoint task are read by."""

from __future__ import annotations

from dataclasses import replace

from surgbench.report.column import LATENCY, ROW, VARIANT, Column
from surgbench.report.losses import SHOWN_LOSSES

VVA = Column("vva_deg", "VVA", "deg", 2, short="VVA\ndeg", best=True)
FD = Column("fd_mm", "FD", "mm", 2, short="FD\nmm", best=True)
PF = Column("pf_deg", "PF", "deg", 2, short="PF\ndeg", best=True)
AN = Column("an_deg", "AN", "deg", 1, short="AN\ndeg", best=True)
PN = Column("pn_mm", "PN", "mm", 1, short="PN\nmm", best=True)
TRUE_VVA = Column("vva_true_deg", "true VVA", "deg", 2, short="true\nVVA", best=True)
PAGE_LATENCY = replace(LATENCY, decimals=3)
P999 = Column("latency_ms_p999", "p99.9", "ms", 3, short="p99.9\nms")

# Of viewpoint controllers; the page has every subset of the samples, the terminal all of them together.
COLUMNS = (
    ROW,
    VARIANT,
    Column("subset", "samples", short="samples\nof"),
    Column("samples", "n", short="n"),
    Column("coverage", "done", "%", 0, 100.0, short="done\n%"),
    VVA,
    FD,
    PF,
    AN,
    PN,
    TRUE_VVA,
    Column("constrained_percent", "constrained", "%", 1, short="bound\n%"),
    Column("visibility_any_percent", "visible to a camera", "%", 2, short="seen\n%"),
    *SHOWN_LOSSES,
    Column("no_go_samples", "samples in the zone", short="no-\ngo"),
    Column("floor_samples", "below the floor", short="low"),
    Column("proximity_samples", "too near", short="near"),
    Column("orientation_samples", "on the wrong side", short="side"),
    PAGE_LATENCY,
    P999,
)

# Reproduced tables: the article's errors, with its digits,
PAGE_ERRORS = (VVA, FD, PF, replace(AN, decimals=2), replace(PN, decimals=2))
PAGE_SIGNED = Column("fd_signed_mm", "FD, signed", "mm", 2)
# the mean latency, of which the article has fewer digits,
PAGE_MEAN_LATENCY = Column("latency_ms_mean", "mean latency", "ms", 3)
PUBLISHED_MEAN_LATENCY = replace(PAGE_MEAN_LATENCY, key="latency_ms", decimals=2)
# what was true,
PAGE_TRUTH = (
    TRUE_VVA,
    Column("fd_true_mm", "true FD", "mm", 2),
    Column("pf_true_deg", "true PF", "deg", 2),
    Column("an_true_deg", "true AN", "deg", 2),
    Column("pn_full_mm", "PN, whole way", "mm", 2),
    Column("constrained_percent", "constrained", "%", 2),
    Column("clipped_commands", "clipped commands"),
    P999,
)
# which rules were broken, how often and how much,
PAGE_RULES = {
    "no_go": "in the zone",
    "floor": "below the floor",
    "proximity": "too near",
    "orientation": "on the wrong side",
    "joint_limit": "beyond joint limits",
}
PAGE_UNAVOIDABLE = Column("unavoidable_samples", "unavoidable samples")
# by how much a row differs from the one that it is held against, trial by trial,
PAGE_PAIRED = (
    VVA,
    FD,
    PF,
    Column("view_cost", "cost", decimals=3),
    Column("visibility_any_percent", "seen any", "points", 2),
)
PAGE_REGRET = Column("regret", "regret", decimals=3)
# and where the feature was in the pictures: of the left and of the right one, of both together, and whether at all.
_PICTURE_ERRORS = {"l2": "L2", "u": "u", "v": "v"}
PAGE_EYES = {
    eye: tuple(Column(f"{key}_error_px", f"{name} {eye}", "px", 1) for key, name in _PICTURE_ERRORS.items())
    for eye in ("left", "right")
}
PAGE_BOTH = tuple(Column(f"{key}_error_percent", f"{name} both", "%", 2) for key, name in _PICTURE_ERRORS.items())
PAGE_SEEN = {
    which: Column(f"visibility_{which}_percent", f"seen {which}", "%", 2) for which in ("left", "right", "any", "both")
}
PAGE_FRAMED = Column("framed_any_percent", "in a picture", "%", 2)
