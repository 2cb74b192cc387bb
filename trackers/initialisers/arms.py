"""Initialise every arm by itself, in its own part of the mask."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from surgbench.contract import Observation, Scene
from surgbench.errors import SurgbenchError
from surgbench.geometry import FloatArray
from surgbench.trackers.arm_masks import mask_per_arm

Search = Callable[[Scene, Observation, Callable[[float], None]], FloatArray]


def initialise_each_arm(
    scene: Scene, observation: Observation, progress: Callable[[float], None], search: Search
) -> FloatArray:
    """States ``(9 * arms,)`` from a search that knows one arm.

    Args:
        scene: Of all arms.
        observation: The first frame.
        progress: Called with the fraction done of all arms.
        search: From a scene and a frame with one arm, and its own progress, to a state ``(9,)``.

    Raises:
        SurgbenchError: The first mask is empty, or two arms cannot be told apart in it.
    """
    if not observation.mask.any():
        raise SurgbenchError(f"the mask of frame {observation.index} is empty: nothing to start from")
    masks = mask_per_arm(observation.views[0], scene.arms)
    if masks is None:
        raise SurgbenchError("the arms overlap in the first mask: start from a frame where they are apart")
    for name, mask in zip(("left", "right"), masks, strict=False):
        if not mask.any():
            empty = f"the {name} arm's own mask is empty in frame {observation.index}"
            raise SurgbenchError(f"{empty}: start from a frame that shows both arms")
    states = []
    for arm, mask in enumerate(masks):
        view = replace(observation.views[0], mask=mask, keypoints=(observation.views[0].tips[arm],))
        joints = None if observation.joints is None else observation.joints.reshape(scene.arms, 3)[arm]
        alone = replace(
            scene, instruments=(scene.instruments[arm],), limits=(scene.limits[arm],), views=(view,), arms=1
        )

        def advance(fraction: float, before: int = arm) -> None:
            progress((before + fraction) / scene.arms)

        states.append(search(alone, replace(observation, views=(view,), joints=joints), advance))
    found: FloatArray = np.concatenate(states)
    return found
