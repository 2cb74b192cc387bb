"""The generator of the instrument task's datasets."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar

from surgbench.contract import Plugin
from surgbench.generation import GenerationPlan, GenerationRequest
from surgbench.generators.generate import Part, plan_dataset
from surgbench.generators.presets import load_preset


class MaskSequences(Plugin):
    """Instruments on trajectories, their masks rendered with Mitsuba and corrupted, with tips and readings."""

    name: ClassVar[str] = "mask-sequences"
    summary: ClassVar[str] = "masks of instruments on trajectories, with tips, joint readings and the truth"
    task: ClassVar[str] = "instrument"

    def plan(self, preset: Path, request: GenerationRequest) -> GenerationPlan:
        """What a preset makes.

        Raises:
            SurgbenchError: As :func:`~surgbench.generators.presets.load_preset` and
                :func:`~surgbench.generators.generate.plan_dataset`; one line.
        """
        loaded = load_preset(
            preset,
            pairs=request.sequences,
            frames=request.frames,
            seed=request.seed,
            corruption=request.corruption,
            settings=request.set,
        )
        plan: GenerationPlan = plan_dataset(loaded, None if request.part is None else Part(*request.part))
        return plan
