"""Random generators seeded by the names of what they are for.

The stream of, say, the mask corruption of frame 12 of sequence ``000`` depends on those names and the
dataset's seed alone: not on the order of work, the number of workers, or what else was drawn.
"""

from __future__ import annotations

import hashlib
import json

import numpy as np


def seed_from(**axes: str | int) -> int:
    """A 128-bit seed from named axes, for example ``seed_from(dataset=0, sequence="000")``.

    The order of the axes does not matter; 0 is a seed like any other.
    """
    text = json.dumps(axes, sort_keys=True, separators=(",", ":"))
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:16], "big")


def generator(**axes: str | int) -> np.random.Generator:
    """A NumPy generator of its own for the named axes."""
    return np.random.Generator(np.random.PCG64(seed_from(**axes)))
