"""Whether both jaws are where the mask has them, judged by the jaws' own contour.

A jaw is a twentieth of an instrument's contour. Held against all of it, a jaw that lies on the other one is hardly
missed; held against the contour of a jaw, it is all that is missing.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from surgbench.camera import Camera
from surgbench.geometry import FloatArray
from surgbench.instrument import Instrument
from surgbench.state import POSITION, split_arms
from surgbench.trackers.registration.edges import MissedEdge

AROUND = 1.2  # how far from their axis the jaws' surroundings reach, in jaws
BEHIND = 0.15  # and how far back towards the shaft
LEAST = 0.4  # of a jaw's contour at full length: what is seen of a jaw counts as no less


class JawJudge:
    """Says how much of the jaws is unexplained.

    Args:
        instruments: One per arm.
        camera: Of the view.
    """

    def __init__(self, instruments: Sequence[Instrument], camera: Camera) -> None:
        self._instruments = tuple(instruments)
        self._camera = camera
        self._links = [[one.link_index[tip.link] for tip in one.tips] for one in instruments]
        self._tips_m = [np.array([tip.point_m for tip in one.tips]) for one in instruments]

    def __call__(self, state: FloatArray, missed_px: FloatArray, length_px: FloatArray, missed: MissedEdge) -> float:
        """Share of the jaws' contour that is unexplained, of the arm of which it is most.

        Args:
            state: ``(9 * arms,)``.
            missed_px: ``(arms, links)`` length of each link's visible contour that has no edge in the mask.
            length_px: ``(arms, links)`` all of it.
            missed: The mask's edge that has no contour near it.

        Returns:
            0 to 1: of a predicted jaw, or of a jaw's length of the mask's edge around them, whichever is more.
        """
        return max(
            self._arm(arm, one, missed_px[arm], length_px[arm], missed) for arm, one in enumerate(split_arms(state))
        )

    def _arm(
        self, arm: int, state: FloatArray, missed_px: FloatArray, length_px: FloatArray, missed: MissedEdge
    ) -> float:
        instrument, links, camera = self._instruments[arm], self._links[arm], self._camera
        jaws = instrument.link_transforms(state)[links, :3, 3]
        axis = jaws.mean(axis=0)
        reach_m = float(np.linalg.norm(self._tips_m[arm], axis=1).mean())
        if min(axis[2], state[POSITION][2]) <= 0:
            return 1.0
        reach_px = reach_m * camera.fx / float(axis[2])
        full_px = 2.0 * reach_px
        wrong = max(missed_px[link] / max(length_px[link], LEAST * full_px) for link in links)
        focal, centre = np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy])
        here, wrist = (place[:2] / place[2] * focal + centre for place in (axis, state[POSITION]))
        off = missed.places_px - here
        around = np.hypot(off[:, 0], off[:, 1]) < AROUND * reach_px
        forward = here - wrist
        long = float(np.linalg.norm(forward))
        if long > LEAST * reach_px:  # else the wrist points at the camera, and jaws may stand anywhere around
            around &= off @ forward / long > -BEHIND * reach_px
        return float(min(max(wrong, np.count_nonzero(around) / full_px), 1.0))
