"""Which part of a picture's instruments belongs to the scene's own arms."""

from __future__ import annotations

from surgbench.contract import Mask, Observation, Scene, View
from surgbench.mask_sources import Prompts


class OwnArms:
    """Picks the scene's arms out of a mask of all instruments; for now it takes all of them.

    Args:
        scene: The sequence's constants.
        view: The camera's view.
        prompts: Points in the first picture that say which instrument is meant.
    """

    def __init__(self, scene: Scene, view: View, prompts: Prompts | None = None) -> None:
        self._arms = scene.arms

    def pick(self, mask: Mask, observation: Observation, view: View) -> Mask:
        """What of a mask is the scene's, ``(height, width)`` bool."""
        return mask
