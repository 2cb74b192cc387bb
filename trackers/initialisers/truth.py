"""Start from the truth, as the paper's evaluation on synthetic data does."""

from __future__ import annotations

from collections.abc import Callable
from typing import ClassVar

import numpy as np

from surgbench.contract import Observation, Plugin, Scene
from surgbench.errors import SurgbenchError
from surgbench.geometry import FloatArray


class TruthInitialiser(Plugin):
    """Hands out the true state of the first frame."""

    name: ClassVar[str] = "truth"
    summary: ClassVar[str] = "the true state of the first frame (generated data only)"
    needs_truth: ClassVar[bool] = True

    def initialise(
        self,
        scene: Scene,
        observation: Observation,
        rng: np.random.Generator,
        truth: FloatArray | None,
        progress: Callable[[float], None],
    ) -> FloatArray:
        """The truth it is given.

        Raises:
            SurgbenchError: The dataset has none.
        """
        if truth is None:
            raise SurgbenchError("initialiser 'truth' needs a dataset with ground truth; use --initialiser random")
        return truth
