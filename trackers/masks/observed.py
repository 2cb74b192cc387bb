"""The masks that are in the dataset: corrupted truth in generated data, segmented ones in recordings."""

from __future__ import annotations

from typing import ClassVar

from surgbench.contract import Observation, Plugin, Scene, View
from surgbench.mask_sources import FoundMasks, Prompts


class ObservedMasks(Plugin):
    """Passes on what the dataset holds."""

    name: ClassVar[str] = "observed"
    summary: ClassVar[str] = "the masks that the dataset holds, corrupted or segmented as they are"

    def reset(self, scene: Scene, view: View, prompts: Prompts | None) -> None:
        """Nothing to prepare."""

    def segment(self, observation: Observation, view: View) -> FoundMasks:
        """The view's own masks."""
        return FoundMasks(view.mask, view.instance_masks)
