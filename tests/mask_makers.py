"""Mask sources of people who never saw the package."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np


class Bright:
    """All that is bright; the tests paint instruments white."""

    name = "bright"
    reads_images = True

    def reset(self, scene: Any, view: Any, prompts: Any) -> None:
        self.prompts = prompts

    def segment(self, observation: Any, view: Any) -> Any:
        return view.image().max(axis=2) > 100


class Pointed(Bright):
    """Wants points, and leaves them where the tests find them."""

    name = "pointed"
    needs_prompts = True

    def reset(self, scene: Any, view: Any, prompts: Any) -> None:
        points, inside = ([one.tolist() for one in values] for values in (prompts.points_px, prompts.inside))
        with Path(os.environ["SURGBENCH_TEST_NOTES"]).open("a") as notes:
            print(json.dumps([points, inside, view.image() is not None]), file=notes)


class Halved(Bright):
    """Masks of half the camera's size."""

    name = "halved"

    def segment(self, observation: Any, view: Any) -> Any:
        return super().segment(observation, view)[::2, ::2]


class Levels(Bright):
    """Levels instead of a mask."""

    name = "levels"

    def segment(self, observation: Any, view: Any) -> Any:
        return view.image().max(axis=2)


class Breaks(Bright):
    """Breaks down in the third frame."""

    name = "breaks"

    def segment(self, observation: Any, view: Any) -> Any:
        if observation.index == 2:
            raise RuntimeError("no more\nmasks")
        return super().segment(observation, view)


class Counts(Bright):
    """Knows whether it was asked about every frame in turn, and gives an empty mask where not."""

    name = "counts"

    def reset(self, scene: Any, view: Any, prompts: Any) -> None:
        self.next = 0

    def segment(self, observation: Any, view: Any) -> Any:
        in_turn = observation.index == self.next
        self.next += 1
        mask = super().segment(observation, view)
        return mask if in_turn else np.zeros_like(mask)
