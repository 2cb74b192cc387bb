"""The unit of `calibration_ratio`: how long the work of :mod:`surgbench.processes.reference_work` took where."""

from __future__ import annotations

# The processor's time for one turn, the least of 400 (other work went on beside it), with the pinned versions. It is
# the unit of `calibration_ratio`: never changed, or all ratios would be of another unit.
REFERENCE_MS = 10.9
REFERENCE_MACHINE = "AMD EPYC (family 25, model 1), one of two virtual cores"
