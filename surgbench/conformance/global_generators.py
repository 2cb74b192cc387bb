"""The random generators that are everybody's, and that a tracker is to leave alone."""

from __future__ import annotations

import random
import sys
from collections.abc import Callable
from typing import Any

import numpy as np

_Generator = tuple[Callable[[], Any], Callable[[], Any], Callable[[Any], Any]]


def global_generators() -> dict[str, _Generator]:
    """Of every library that is loaded: how to get its state, draw from it, and put a state back."""
    generators: dict[str, _Generator] = {
        "random": (random.getstate, random.random, random.setstate),
        "numpy": (np.random.get_state, np.random.random, np.random.set_state),
    }
    torch = sys.modules.get("torch")
    if torch is not None:
        generators["torch"] = (
            lambda: torch.get_rng_state().numpy(),
            lambda: torch.rand(1),
            lambda state: torch.set_rng_state(torch.from_numpy(state)),
        )
    return generators
