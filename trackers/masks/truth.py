"""True masks: what trackers would do if segmentation were perfect."""

from __future__ import annotations

from typing import ClassVar

from surgbench.contract import Observation, Plugin, Scene, View
from surgbench.mask_sources import FoundMasks, Prompts


class TrueMasks(Plugin):
    """Passes on the true masks that the engine gives to sources with ``needs_truth``."""

    name: ClassVar[str] = "truth"
    summary: ClassVar[str] = "what truly shows of the instruments, before any corruption; never for ranking"
    needs_truth: ClassVar[bool] = True

    def reset(self, scene: Scene, view: View, prompts: Prompts | None) -> None:
        """Nothing to prepare."""

    def segment(self, observation: Observation, view: View) -> FoundMasks:
        """The view's masks, which are true."""
        return FoundMasks(view.mask, view.instance_masks)
