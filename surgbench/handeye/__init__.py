"""A judge where there is no truth: tracked wrist poses held against the robot's own readings of them.

The two differ by one constant transform, the hand-eye calibration, and one lag, whatever else is the tracker's error or
the arm's. ``docs/handeye.md`` says what comes out of it and how far it can be trusted.
"""

from surgbench.handeye.estimate import HandEye, estimate_hand_eye
from surgbench.handeye.motion import Motion, TooLittleMotionError
from surgbench.handeye.track import ReadingTrack

__all__ = ["HandEye", "Motion", "ReadingTrack", "TooLittleMotionError", "estimate_hand_eye"]
