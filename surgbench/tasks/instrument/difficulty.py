"""How hard a dataset is, in figures: how fast its instruments move, and how wrong its masks are."""

from __future__ import annotations

from typing import Any

import numpy as np

from surgbench.geometry import FloatArray
from surgbench.metrics import mask_error, rotation_error
from surgbench.state import ANGLES, JOINTS, POSITION
from surgbench.tasks.instrument.dataset import InstrumentDataset, Sequence

EVERY = 20  # frames; of which the masks are compared


def difficulty(dataset: InstrumentDataset) -> dict[str, dict[str, float]]:
    """By speed (``nominal``, ``fast``): means over frames and arms, to four digits.

    Args:
        dataset: With ground truth.

    Returns:
        ``translation_m`` and ``rotation_rad`` from frame to frame, ``joints_rad`` (the mean of three), and
        ``mask_error`` of the mask that trackers see against the uncorrupted one, of each arm alone.
    """
    values: dict[str, dict[str, list[FloatArray]]] = {}
    for sequence in dataset.sequences:
        if sequence.entry.truth:
            for key, found in _of_sequence(sequence).items():
                values.setdefault(sequence.speed, {}).setdefault(key, []).append(found)
    return {
        speed: {key: float(f"{np.concatenate(found).mean():.4g}") for key, found in by_key.items()}
        for speed, by_key in values.items()
    }


def _of_sequence(sequence: Sequence) -> dict[str, FloatArray]:
    steps: dict[str, list[FloatArray]] = {}
    for arm in sequence.arms:
        states = sequence.states(arm)
        assert states is not None
        step = np.diff(states, axis=0)
        found: dict[str, Any] = {
            "translation_m": np.linalg.norm(step[:, POSITION], axis=1),
            "rotation_rad": rotation_error(states[1:, ANGLES], states[:-1, ANGLES]),
            "joints_rad": np.abs(step[:, JOINTS]).mean(axis=1),
        }
        if arm in sequence.entry.kinds:
            found["mask_error"] = np.array([_mask_error(sequence, arm, k) for k in range(0, sequence.frames, EVERY)])
        for key, value in found.items():
            steps.setdefault(key, []).append(value)
    return {key: np.concatenate(value) for key, value in steps.items()}


def _mask_error(sequence: Sequence, arm: str, frame: int) -> float:
    seen, clean = sequence.mask(arm, frame), sequence.clean_mask(arm, frame)
    return float(mask_error(seen.sum(), clean.sum(), (seen & clean).sum()))
