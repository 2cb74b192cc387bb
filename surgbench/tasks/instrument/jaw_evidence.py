"""Which of two readings of the jaws the masks of a recording fit: half their opening, or all of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import cv2
import numpy as np

from surgbench.camera import Camera
from surgbench.contract import Initialiser, Mask, Observation, Scene, View
from surgbench.geometry import FloatArray
from surgbench.instrument import Instrument
from surgbench.metrics import mask_error
from surgbench.randomness import generator
from surgbench.registry import create, find
from surgbench.silhouette import Reference, SilhouetteEvaluator
from surgbench.state import STATE_SIZE, JointLimits

# Half an opening and the whole one are told apart at this width; more pixels only take longer.
WIDTH = 350
# A short search will do, as the joints are known but for the one question.
INITIALISER = "random"
SEARCH: dict[str, Any] = {
    "hypotheses": 4096, "refined": 8, "shafts": 2, "redrawn": 2048, "finalists": 2, "generations": (10, 40),
    "population": 40,
}  # fmt: skip
# How far a jaw may be from its reading.
JAW_SLACK_RAD = 0.03
# A mask that neither fits tells nothing: the instrument is half hidden, or another one.
POOR_MASK_ERROR = 0.25
# Jaws seen from their side leave mask errors of 1.5 to 4 times as much where they are taken for the other; those
# seen edge-on, and searches that end a little off, 0.8 to 1.3.
CLEAR, VERY_CLEAR = 1.5, 2.5
FEW = 3


@dataclass(frozen=True)
class JawFrame:
    """A frame that is to tell.

    Attributes:
        mask: ``(height, width)`` without the lens.
        joints: ``(3,)`` as the readings are taken.
        otherwise: ``(3,)`` as they are if the jaw means the other.
    """

    mask: Mask
    joints: FloatArray
    otherwise: FloatArray


@dataclass(frozen=True)
class JawEvidence:
    """What the frames say.

    Attributes:
        error: Mean mask error of the instrument with its joints as they are taken.
        other: With the other reading of the jaw.
        frames: How many could tell.
    """

    error: float
    other: float
    frames: int

    @property
    def verdict(self) -> Literal["taken", "other", "open"]:
        """Which one fits clearly better; ``open`` where that cannot be told."""
        if self.frames and self.other >= CLEAR * self.error:
            return "taken"
        return "other" if self.frames and self.error >= CLEAR * self.other else "open"


def weigh_jaw(instrument: Instrument, camera: Camera, frames: Sequence[JawFrame]) -> JawEvidence:
    """Fit the instrument to masks with either reading of its jaw.

    Args:
        instrument: Whose masks they are.
        camera: Without a lens.
        frames: Are looked at in order, until they are very clear.
    """
    judge = _Judge(instrument, camera)
    errors: list[tuple[float, float]] = []
    for index, frame in enumerate(frames):
        found = judge.error(frame.mask, frame.joints, index), judge.error(frame.mask, frame.otherwise, index)
        if min(found) > POOR_MASK_ERROR:
            continue
        errors.append(found)
        low, high = sorted(np.sum(errors, axis=0))
        if len(errors) >= FEW and high >= VERY_CLEAR * low:
            break
    mean = np.mean(errors, axis=0) if errors else (1.0, 1.0)
    return JawEvidence(float(mean[0]), float(mean[1]), len(errors))


class _Judge:
    """Fits one instrument to masks, small ones of them."""

    def __init__(self, instrument: Instrument, camera: Camera) -> None:
        self._instrument = instrument
        shrink = max(1, round(camera.width / WIDTH))
        width, height = camera.width // shrink, camera.height // shrink
        self._whole = (height * shrink, width * shrink)  # a rest of columns and rows is cut off
        cut = camera.model_copy(update={"width": width * shrink, "height": height * shrink})
        self._camera = cut.resized(width, height)
        self._initialiser: Initialiser = create(find("initialiser", INITIALISER), SEARCH)
        self._evaluator = SilhouetteEvaluator((instrument,), self._camera)

    def error(self, mask: Mask, joints: FloatArray, index: int) -> float:
        """Mask error of the best pose that is found with the jaw as it is read."""
        box = self._instrument.search_limits
        read = box.clip(joints)
        near = np.array([np.inf, np.inf, JAW_SLACK_RAD])
        limits = JointLimits(np.maximum(box.lower_rad, read - near), np.minimum(box.upper_rad, read + near))
        cut = mask[: self._whole[0], : self._whole[1]].astype(np.float32)
        size = (self._camera.width, self._camera.height)
        small = cv2.resize(cut, size, interpolation=cv2.INTER_AREA) >= 0.5
        if not small.any():
            return 1.0
        view = View(self._camera, np.eye(4), small, keypoints=(None,))
        scene = Scene((self._instrument,), (view,), (limits,), dt_s=1.0, arms=1)
        frame = Observation(index, float(index), (view,), np.zeros(STATE_SIZE), joints=read)
        rng = generator(purpose="jaw", frame=index)  # the same for either, so that luck counts for less
        state = self._initialiser.initialise(scene, frame, rng, None, lambda _: None)
        reference = Reference(small)
        score = self._evaluator.score(state[None], reference)
        return float(mask_error(score.area[0], reference.area, score.overlap[0]))
