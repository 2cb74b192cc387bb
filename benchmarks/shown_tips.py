r"""What trackers would have of a detector that misses nothing: true tips with noise, only where a mask shows both.

The keypoint source `observed` knows the tips also where one jaw hides the other, which no detector can. A row with a
detector loses something beside it for that alone; this source, which knows the truth, tells how much:

    surgbench run --dataset data/paper --tracker cmaes --frames 250 --keypoints observed --out runs/shown
    surgbench run --dataset data/paper --tracker cmaes --frames 250 --out runs/shown \
        --keypoints benchmarks/shown_tips.py:ShownTips --set shown-tips.dataset=data/paper
    surgbench run --dataset data/paper --tracker cmaes --frames 250 --keypoints resnet18 --out runs/shown
    surgbench report runs/shown
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, ClassVar

from pydantic import Field

from surgbench.config import Section
from surgbench.contract import Observation, Plugin, Scene, View
from surgbench.dataset.open import open_as
from surgbench.errors import SurgbenchError
from surgbench.generators.tip_masks import Painter
from surgbench.geometry import FloatArray
from surgbench.tasks.instrument.dataset import InstrumentDataset


class ShownTips(Plugin):
    """Passes on a dataset's pair of tips where the mask shows both; of one arm."""

    name: ClassVar[str] = "shown-tips"
    summary: ClassVar[str] = "the true tips with noise, only where the mask shows both (knows the truth)"

    class Config(Section):
        """Options."""

        dataset: Annotated[Path, Field(description="the dataset that is run on")]

    def __init__(self, config: Config) -> None:
        # A source is not told the sequence: the noise of the tips, which no two frames have in common, tells the frame.
        self._states: dict[bytes, FloatArray] = {}
        dataset = open_as(InstrumentDataset, config.dataset)
        for unit in dataset.units():
            for arm in unit.arms:
                sequence = dataset.sequence(unit.sequence)
                states = sequence.states(arm)
                if states is None:
                    raise SurgbenchError(f"{config.dataset}: sequence {unit.sequence} has no true states")
                self._states |= {
                    tips.tobytes(): state for state, tips in zip(states, sequence.keypoints(arm), strict=True)
                }

    def reset(self, scene: Scene) -> None:
        """Prepare the painter, in the reference camera."""
        self._painter = Painter(scene.instruments[0], scene.views[0].camera)

    def detect(self, observation: Observation, view: View) -> tuple[FloatArray | None, ...]:
        """The view's own tips, or nothing where one does not show."""
        (tips,) = view.keypoints
        if tips is None or not self._painter.shows(self._states[tips.tobytes()], view.mask).all():
            return (None,)
        return (tips,)
