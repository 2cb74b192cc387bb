"""The list of checks of instrument trackers."""

from __future__ import annotations

from surgbench.conformance.subject import Check
from surgbench.tasks.instrument.conformance import answers, inputs, isolation

# In this order; each says in its docstring what it is about.
CHECKS: dict[str, Check] = {
    "plain sequence": answers.plain,
    "joint limits": answers.limits,
    "same seed": answers.same_seed,
    "other seed": answers.other_seed,
    "time": answers.budget,
    "no global randomness": isolation.no_global_randomness,
    "input untouched": inputs.untouched,
    "reset starts anew": isolation.resets,
    "another process": isolation.moves_to_another_process,
    "empty masks": inputs.empty_masks,
    "full masks": inputs.full_masks,
    "lost and found": inputs.lost_and_found,
    "no keypoints": inputs.no_keypoints,
    "strange starts": answers.strange_starts,
    "readings": inputs.readings,
    "kinematics": inputs.kinematics,
    "two arms": inputs.two_arms,
    "masks of arms": inputs.masks_of_arms,
    "crossing arms": inputs.crossing_arms,
    "candidates": answers.candidates,
}
