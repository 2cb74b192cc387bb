"""The fixed work that silhouette renderers are measured on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from surgbench.camera import Camera
from surgbench.contract import Mask
from surgbench.geometry import FloatArray
from surgbench.instrument import Instrument, load_instrument
from surgbench.randomness import generator
from surgbench.silhouette import SilhouetteEvaluator
from surgbench.state import STATE_SIZE, StateSpace

INSTRUMENT = "large_needle_driver"
# The camera of the paper's code (Hu et al. 2026).
CAMERA = Camera(width=700, height=493, fx=905.955, fy=904.820, cx=294.280, cy=238.699)
# The population of a generation in the paper.
CANDIDATES = 70
# Covers about as many pixels, rows and columns as the median of random poses before this camera; the shaft passes
# the camera plane, as it does in most views.
TRUE_STATE = np.array([0.65, 1.7, -0.5, 0.006, 0.002, 0.12, 0.32, 0.1, 0.5])


@dataclass(frozen=True)
class Workload:
    """What every renderer is given.

    Attributes:
        instrument: One instrument.
        camera: The view.
        states: ``(N, 9)`` candidates.
        mask: ``(H, W)`` what their silhouettes are compared with.
    """

    instrument: Instrument
    camera: Camera
    states: FloatArray
    mask: Mask


def silhouette_workload(candidates: int = CANDIDATES) -> Workload:
    """The mask of one true state, and candidates drawn around it as in a first generation of CMA-ES.

    Args:
        candidates: How many; fewer are the first of more.
    """
    instrument = load_instrument(INSTRUMENT)
    space = StateSpace(instrument.search_limits)
    samples = generator(bench="silhouettes", seed=0).standard_normal((candidates, STATE_SIZE))
    states = space.decode(space.encode(TRUE_STATE) + samples)
    return Workload(instrument, CAMERA, states, SilhouetteEvaluator([instrument], CAMERA).mask(TRUE_STATE))
