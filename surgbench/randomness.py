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

    Example:
        >>> from surgbench.randomness import seed_from
        >>> seed_from(sequence="000", dataset=0) == seed_from(dataset=0, sequence="000")
        True
        >>> hex(seed_from(dataset=0, sequence="000"))
        '0x6d5b3a21a918c50b19e51126fe91ae64'
    """
    text = json.dumps(axes, sort_keys=True, separators=(",", ":"))
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:16], "big")


def generator(**axes: str | int) -> np.random.Generator:
    """A NumPy generator of its own for the named axes.

    Example:
        Frame 12 has the same noise whether or not frame 11 was drawn before it.

        >>> import numpy as np
        >>> from surgbench.randomness import generator
        >>> noise = {frame: generator(seed=0, frame=frame).normal(size=3) for frame in (11, 12)}
        >>> np.array_equal(generator(seed=0, frame=12).normal(size=3), noise[12])
        True
        >>> np.array_equal(noise[11], noise[12])
        False
    """
    # By name, for what default_rng() makes may change with NumPy.
    return np.random.Generator(np.random.PCG64(seed_from(**axes)))
