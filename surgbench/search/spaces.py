"""The search spaces of a scene: without joint readings, and with them."""

from __future__ import annotations

import numpy as np

from surgbench.contract import Observation, Scene
from surgbench.state import STATE_SCALE, STATE_SIZE, ClampedSpace, StateSpace


class SearchSpaces:
    """A state's natural steps; where the joints are read, theirs are smaller.

    Args:
        scene: Joint limits and number of arms.
        readings_scale: Factor on the joints' steps where readings are given.
        jaw_step_rad: Step of q3, half of the jaws' opening, without readings.
        clamped: Joints are clipped to their limits, not put through the cosine of eq. 11.

    Example:
        >>> from surgbench.tasks.instrument.conformance.scenes import make_play
        >>> from surgbench.search.spaces import SearchSpaces
        >>> play = make_play(readings=True)  # a needle driver in slow motion
        >>> space = SearchSpaces(play.scene, readings_scale=0.1, jaw_step_rad=0.1).of(play.observations[0])
        >>> space.scale  # rad, m, rad; joints a tenth of what they are without readings
        array([0.01 , 0.1  , 0.01 , 0.001, 0.001, 0.001, 0.01 , 0.01 , 0.01 ])
    """

    def __init__(self, scene: Scene, readings_scale: float, jaw_step_rad: float, clamped: bool = False) -> None:
        scale = np.append(STATE_SCALE[:-1], jaw_step_rad)
        with_readings = scale * np.where(np.arange(STATE_SIZE) < 6, 1.0, readings_scale)
        space = ClampedSpace if clamped else StateSpace
        self._without = space(scene.joint_limits, scale, scene.arms)
        self._with = space(scene.joint_limits, with_readings, scene.arms)

    def of(self, observation: Observation) -> StateSpace:
        """The space in which a frame is searched."""
        return self._without if observation.joints is None else self._with
