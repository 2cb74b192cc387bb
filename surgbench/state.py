"""The instrument state, its 180-degree twin, and the unconstrained space the trackers search.

A state is ``[alpha, beta, gamma, x, y, z, q1, q2, q3]`` (radians, metres, radians): the pose of the
wrist-pitch frame in the camera and the wrist pitch, wrist yaw and half jaw angle. Two arms are two
states, left first, shape ``(18,)``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from surgbench.geometry import FloatArray

STATE_SIZE = 9
STATE_NAMES = ("alpha", "beta", "gamma", "x", "y", "z", "q1", "q2", "q3")
ALPHA, BETA, GAMMA = 0, 1, 2
ANGLES = slice(0, 3)
POSITION = slice(3, 6)
JOINTS = slice(6, 9)

# What turns an instrument into one that looks (nearly) the same: half a turn about the shaft with the wrist's joints
# reversed (see twin); nothing; any turn about the shaft.
Symmetry = Literal["twin", "none", "axis"]

# Natural step of each component: 0.01 rad for alpha and gamma, 0.1 rad for beta, 1 mm, 0.1 rad for the wrist joints
# and for the opening between the jaws, half of which is q3. Those of the released code of Hu et al. 2026, but for q3,
# which has 0.1 rad there (docs/conventions.md).
STATE_SCALE = np.array([0.01, 0.1, 0.01, 1e-3, 1e-3, 1e-3, 0.1, 0.1, 0.05])


@dataclass(frozen=True)
class JointLimits:
    """Box of the three joints.

    Attributes:
        lower_rad: ``(3,)``, or ``(arms, 3)`` for the boxes of several arms.
        upper_rad: Same shape.

    Example:
        Wrist pitch, wrist yaw and half jaw angle; an instrument has its own as ``search_limits``.

        >>> import numpy as np
        >>> from surgbench.state import JointLimits
        >>> limits = JointLimits(np.array([-1.5, -1.4, 0.0]), np.array([1.5, 1.4, 1.5]))
    """

    lower_rad: FloatArray
    upper_rad: FloatArray

    def clip(self, joints_rad: FloatArray) -> FloatArray:
        """Clip ``(..., 3)`` or ``(..., arms, 3)`` joints into the box.

        Example:
            >>> import numpy as np
            >>> from surgbench.state import JointLimits
            >>> limits = JointLimits(np.array([-1.5, -1.4, 0.0]), np.array([1.5, 1.4, 1.5]))
            >>> limits.clip(np.array([0.2, -2.0, -0.1]))
            array([ 0.2, -1.4,  0. ])
        """
        return np.clip(joints_rad, self.lower_rad, self.upper_rad)


def split_arms(state: FloatArray) -> FloatArray:
    """View a state of one or two arms as ``(..., arms, 9)``.

    Example:
        Written to, the view writes into the state.

        >>> import numpy as np
        >>> from surgbench.state import JOINTS, POSITION, split_arms
        >>> state = np.zeros(18)  # two arms, the left one first
        >>> split_arms(state)[1, JOINTS] = [0.1, 0.2, 0.3]
        >>> state[9:]
        array([0. , 0. , 0. , 0. , 0. , 0. , 0.1, 0.2, 0.3])
        >>> split_arms(state)[:, POSITION].shape
        (2, 3)
    """
    array = np.asarray(state, dtype=np.float64)
    return array.reshape(*array.shape[:-1], -1, STATE_SIZE)


def clip_joints(state: FloatArray, limits: JointLimits) -> FloatArray:
    """Copy of ``(..., 9 * arms)`` states with the joints clipped to ``limits``.

    Example:
        >>> import numpy as np
        >>> from surgbench.state import JointLimits, clip_joints
        >>> limits = JointLimits(np.array([-1.5, -1.4, 0.0]), np.array([1.5, 1.4, 1.5]))
        >>> clip_joints(np.array([0.3, 0.4, 0.8, 0.0, 0.0, 0.13, 0.2, -2.0, -0.1]), limits)
        array([ 0.3 ,  0.4 ,  0.8 ,  0.  ,  0.  ,  0.13,  0.2 , -1.4 ,  0.  ])
    """
    # In C order, or what split_arms returns might be a copy of the copy.
    clipped = np.array(state, dtype=np.float64, order="C")
    arms = split_arms(clipped)
    arms[..., JOINTS] = limits.clip(arms[..., JOINTS])
    return clipped


def twin(state: FloatArray) -> FloatArray:
    """The state turned by 180 degrees about the shaft with both wrist joints reversed.

    Its silhouette is nearly the same: ``(beta + pi, -q1, -q2)``.

    Args:
        state: ``(..., 9)``.

    Returns:
        ``(..., 9)``; applied twice it returns the state up to a full turn of beta.

    Example:
        >>> import numpy as np
        >>> from surgbench.state import twin
        >>> twin(np.array([0.3, -0.4, 0.8, 0.0, 0.0, 0.13, 0.2, -0.1, 0.5])).round(3)
        array([ 0.3  ,  2.742,  0.8  ,  0.   ,  0.   ,  0.13 , -0.2  ,  0.1  ,  0.5  ])
    """
    turned = np.array(state, dtype=np.float64)
    turned[..., BETA] += np.pi
    turned[..., 6:8] *= -1.0
    return turned


class StateSpace:
    """Maps states to the scaled, unconstrained vectors that optimisers search, and back.

    Joints go through the cosine reparameterisation (Hu et al. 2026, eq. 11 and 12), so that every vector
    is a feasible state; then each component is divided by its natural step.

    Args:
        limits: Joint box of the instruments.
        scale: ``(9,)`` step of each component (``STATE_SCALE`` unless told).
        arms: 1 or 2; vectors have ``9 * arms`` components.

    Example:
        130 mm are 130 steps of 1 mm, and whatever is sampled around a vector is a state within the limits. Here all
        joints are on theirs, where a step moves them little, and back inwards.

        >>> import numpy as np
        >>> from surgbench.state import JOINTS, JointLimits, StateSpace
        >>> space = StateSpace(JointLimits(np.array([-1.5, -1.4, 0.0]), np.array([1.5, 1.4, 1.5])))
        >>> vector = space.encode(np.array([0.3, 0.4, 0.8, 0.0, 0.0, 0.13, 1.5, -1.4, 0.0]))
        >>> vector.round(9)
        array([ 30.,   4.,  80.,   0.,   0., 130.,  15., -14.,   0.])
        >>> space.decode(vector + 1.0)[JOINTS].round(3)
        array([ 1.492, -1.391,  0.004])
    """

    def __init__(self, limits: JointLimits, scale: FloatArray = STATE_SCALE, arms: int = 1) -> None:
        self.limits = limits
        self.arms = arms
        self.scale: FloatArray = np.tile(np.asarray(scale, dtype=np.float64), arms)

    def encode(self, state: FloatArray) -> FloatArray:
        """States ``(..., 9 * arms)`` to search vectors; joints outside the limits are clipped first."""
        free = clip_joints(state, self.limits)
        joints = split_arms(free)[..., JOINTS]
        span = self.limits.upper_rad - self.limits.lower_rad
        fraction = (joints - self.limits.lower_rad) / span
        # The phase of the cosine, stretched to the joint's range: an angle again, which agrees with the joint on both
        # limits and in the middle, so that natural steps keep their meaning.
        split_arms(free)[..., JOINTS] = self.limits.lower_rad + span / np.pi * np.arccos(1.0 - 2.0 * fraction)
        return free / self.scale

    def decode(self, vector: FloatArray) -> FloatArray:
        """Search vectors ``(..., 9 * arms)`` to states whose joints lie within the limits."""
        state: FloatArray = np.ascontiguousarray(vector, dtype=np.float64) * self.scale
        joints = split_arms(state)[..., JOINTS]
        span = self.limits.upper_rad - self.limits.lower_rad
        phase = np.pi * (joints - self.limits.lower_rad) / span
        joints[...] = self.limits.lower_rad + span / 2.0 * (1.0 - np.cos(phase))
        return state

    def nearest(self, vector: FloatArray) -> FloatArray:
        """The vector nearest to ``(9 * arms,)`` that optimisers should go on from: here, the same."""
        return vector

    def pull_back(self, vector: FloatArray, gradient: FloatArray) -> FloatArray:
        """Derivative with respect to search vectors of a function of the states (the chain rule).

        Args:
            vector: ``(..., 9 * arms)``.
            gradient: ``(..., 9 * arms)`` derivative with respect to the states :meth:`decode` makes of them.

        Returns:
            ``(..., 9 * arms)``; zero for joints on their limits.
        """
        place = np.ascontiguousarray(vector, dtype=np.float64) * self.scale
        slope = np.ones_like(place)
        span = self.limits.upper_rad - self.limits.lower_rad
        phase = np.pi * (split_arms(place)[..., JOINTS] - self.limits.lower_rad) / span
        split_arms(slope)[..., JOINTS] = np.pi / 2.0 * np.sin(phase)
        pulled: FloatArray = gradient * slope * self.scale
        return pulled


class ClampedSpace(StateSpace):
    """The same without the cosine: joints are clipped to their limits.

    Example:
        >>> import numpy as np
        >>> from surgbench.state import JOINTS, ClampedSpace, JointLimits
        >>> space = ClampedSpace(JointLimits(np.array([-1.5, -1.4, 0.0]), np.array([1.5, 1.4, 1.5])))
        >>> vector = space.encode(np.array([0.3, 0.4, 0.8, 0.0, 0.0, 0.13, 1.5, -1.4, 0.0]))
        >>> space.decode(vector + 1.0)[JOINTS].round(9)
        array([ 1.5 , -1.3 ,  0.05])
    """

    def encode(self, state: FloatArray) -> FloatArray:
        """See :class:`StateSpace`."""
        return clip_joints(state, self.limits) / self.scale

    def decode(self, vector: FloatArray) -> FloatArray:
        """See :class:`StateSpace`."""
        return clip_joints(np.asarray(vector, dtype=np.float64) * self.scale, self.limits)

    def nearest(self, vector: FloatArray) -> FloatArray:
        """The vector with its joints at their limits where they are beyond."""
        return self.decode(vector) / self.scale

    def pull_back(self, vector: FloatArray, gradient: FloatArray) -> FloatArray:
        """See :class:`StateSpace`; on a limit it is that of the joints within."""
        pulled: FloatArray = gradient * self.scale
        return pulled
