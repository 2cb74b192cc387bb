"""What is seen of two arms in one picture: Mitsuba renders both, and each alone; its distances tell who is nearer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from surgbench.camera import Camera
from surgbench.dataset.masks import Mask
from surgbench.generators.lens import Lens
from surgbench.generators.render import MaskRenderer
from surgbench.geometry import FloatArray
from surgbench.instrument import Instrument

# Distances of one surface differ so little: the film's crop moves rays by a rounding error.
ROUNDING = 1.0 + 1e-5


@dataclass(frozen=True)
class Seen:
    """Two arms in a picture, left before right.

    Attributes:
        alone: ``(2, height, width)`` each arm as if the other were not there.
        visible: ``(2, height, width)`` each arm where the other does not hide it; no pixel belongs to both.
        tools: ``(2, height, width)`` where what is seen of an arm, alone, is not its shaft.
        third: ``(height, width)`` where a third instrument is nearer than both; ``None`` where there is none.
    """

    alone: NDArray[np.bool_]
    visible: NDArray[np.bool_]
    tools: NDArray[np.bool_]
    third: Mask | None = None

    @property
    def union(self) -> Mask:
        """What one camera sees of the arms."""
        union: Mask = self.alone[0] | self.alone[1]
        return union

    def shares(self, hidden: Mask | None = None) -> list[dict[str, float | None]]:
        """How much of each arm is seen; ``None`` for shares of nothing.

        Args:
            hidden: ``(height, width)`` what something else hides.
        """
        overlap = self.alone[0] & self.alone[1]
        seen = self.visible if hidden is None else self.visible & ~hidden
        return [
            {
                "visible": _share(seen[arm], self.alone[arm]),
                "tool_visible": _share(seen[arm], self.tools[arm]),
                "front": _share(self.visible[arm], overlap),
            }
            for arm in range(len(self.alone))
        ]


class ArmsRenderer:
    """Renders two arms of one instrument.

    Args:
        instrument: Of both arms.
        camera: That sees them, distortion included.
        threads: Of Mitsuba; ``None`` leaves them as they are.
        told_apart: Whether more is wanted than each arm alone.
    """

    def __init__(self, instrument: Instrument, camera: Camera, threads: int | None, *, told_apart: bool) -> None:
        self.camera = camera
        self._lens = Lens(camera)

        def renderer(parts: Sequence[Instrument]) -> MaskRenderer:
            return MaskRenderer(parts, self._lens.pinhole, threads)

        self._alone = [renderer([instrument]) for _ in range(2)]
        if told_apart:
            self._pair, self._third = renderer([instrument] * 2), renderer([instrument])
            self._tool = renderer([instrument.without_shaft])

    def alone(self, states: FloatArray) -> NDArray[np.bool_]:
        """Each arm as if the other were not there, ``(2, height, width)`` of states ``(2, 9)``."""
        pairs = zip(self._alone, states, strict=True)
        return np.stack([self._lens.see(renderer.mask(state)) for renderer, state in pairs])

    def seen(self, states: FloatArray, third: FloatArray | None = None) -> Seen:
        """Render one frame.

        Where the arms overlap, the ray through a pixel's centre meets of both what is nearest, which is what it meets
        of one of them alone: of that which agrees better, for the distance may be rounded either way.

        Args:
            states: ``(2, 9)``.
            third: ``(9,)`` of another instrument of the same kind, which is no arm's.
        """
        arms = np.stack([renderer.distance(state) for renderer, state in zip(self._alone, states, strict=True)])
        alone = arms > 0
        overlap = alone[0] & alone[1]
        visible = alone & ~overlap
        if overlap.any():
            rows, columns = (np.flatnonzero(overlap.any(axis=axis)) for axis in (1, 0))
            window = (int(rows[0]), int(rows[-1]) + 1, int(columns[0]), int(columns[-1]) + 1)
            pair = self._pair.distance(states, window)
            nearest = np.abs(arms[:, overlap] - pair[overlap]).argmin(axis=0)
            visible[:, overlap] = nearest == np.arange(len(arms))[:, None]
        tools = np.zeros_like(alone)
        for tool, arm, state in zip(tools, arms, states, strict=True):
            own = self._tool.distance(state)
            tool[:] = (own > 0) & (own <= arm * ROUNDING)
        see = self._lens.see
        before = None
        if third is not None:
            other = self._third.distance(third)
            before = see((other > 0) & ~((alone & (arms <= other)).any(axis=0)))
        alone, visible, tools = (np.stack([see(mask) for mask in masks]) for masks in (alone, visible, tools))
        return Seen(alone, visible, tools, before)


def _share(part: Mask, whole: Mask) -> float | None:
    count = np.count_nonzero(whole)
    return float(np.count_nonzero(part & whole) / count) if count else None
