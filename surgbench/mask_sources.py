"""The contract of what makes masks from a camera's images while a tracker waits for them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from surgbench.contract import Mask, Observation, Scene, View
from surgbench.geometry import FloatArray


@dataclass(frozen=True)
class Prompts:
    """Points in a sequence's first picture that say which instrument is meant.

    Attributes:
        points_px: Per arm ``(n, 2)`` pixels (u, v); at least one in all.
        inside: Per arm ``(n,)`` bool: the point is on the arm; else on what is not to be taken for it.

    Raises:
        ValueError: The two do not match.

    Example:
        Two points on the one arm, and one beside it:

        >>> import numpy as np
        >>> from surgbench.mask_sources import Prompts
        >>> prompts = Prompts([np.array([[80.0, 60], [90, 60], [20, 10]])], [np.array([True, True, False])])
        >>> prompts.arms
        1
    """

    points_px: Sequence[FloatArray]
    inside: Sequence[NDArray[np.bool_]]

    def __post_init__(self) -> None:
        shapes = [(np.shape(points), np.shape(inside)) for points, inside in zip(self.points_px, self.inside)]  # noqa: B905
        if len(self.points_px) != len(self.inside) or any(one != (*other, 2) for one, other in shapes):
            raise ValueError(f"points and what they say do not match: {shapes}")

    @property
    def arms(self) -> int:
        """Of how many arms."""
        return len(self.points_px)


@dataclass(frozen=True)
class FoundMasks:
    """What a source found in a frame.

    Attributes:
        mask: ``(height, width)`` bool: what shows of the scene's instruments.
        instance_masks: What shows of each arm, left before right, where the source tells the arms apart.
        confidence: How sure it is, 0 to 1.
    """

    mask: Mask
    instance_masks: tuple[Mask, ...] | None = None
    confidence: float = 1.0


@runtime_checkable
class MaskSource(Protocol):
    """Makes the masks of one camera's frames, one after the other.

    There is an instance for each view. It is timed with the tracker, but for ``reset``, for reading images from a disk,
    and for the first call after ``reset`` on a throw-away instance. Its class may say besides

    - ``reads_images = True``: it looks at ``view.image()``, so that it is refused on data without images, and images
      are there before the clock starts;
    - ``needs_prompts = True``: without points on the first picture it can do nothing;
    - ``needs_truth = True``: the masks of its views are the true ones; never for ranking.

    What a frame's mask is may depend on the frames before; every frame is asked about, once and in turn.

    Example:
        All that is dark:

        >>> from surgbench.mask_sources import MaskSource
        >>> class Dark:
        ...     name = "dark"
        ...     reads_images = True
        ...
        ...     def reset(self, scene, view, prompts):
        ...         pass
        ...
        ...     def segment(self, observation, view):
        ...         return view.image().max(axis=2) < 60
        >>> isinstance(Dark(), MaskSource)
        True
    """

    name: ClassVar[str]

    def reset(self, scene: Scene, view: View, prompts: Prompts | None) -> None:
        """Start a sequence.

        Args:
            scene: The sequence's constants.
            view: One camera's view of the frame that the sequence begins with, image included.
            prompts: Points in it, given by hand or from the first frame's estimate; ``None`` where there are none.
        """
        ...

    def segment(self, observation: Observation, view: View) -> Mask | FoundMasks:
        """The mask of the scene's arms, and of nothing else that may be in the picture.

        Args:
            observation: The frame; its ``start`` is where the tracker's search will begin, in the frame that tracking
                begins with the initial estimate, if there is one by then, else zeros.
            view: Which of its views; its masks are the dataset's own, empty where it has none.
        """
        ...
