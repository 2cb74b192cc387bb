"""What a silhouette renderer must be able to do to be measured, and what those that draw share."""

from __future__ import annotations

from abc import ABC, abstractmethod
from importlib import import_module, metadata
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from surgbench.camera import Camera
from surgbench.contract import Mask
from surgbench.extras import install, not_installed
from surgbench.geometry import FloatArray
from surgbench.instrument import Instrument


class Contestant(ABC):
    """Computes the areas of an instrument's silhouettes and their overlaps with a mask.

    Attributes:
        name: As in the results.
        module: Python module it needs.
        system: How to get the system libraries that the module needs, for the line that says it can't be loaded.
    """

    name: ClassVar[str]
    module: ClassVar[str]
    system: ClassVar[str] = ""

    instrument: Instrument
    camera: Camera

    @classmethod
    def problem(cls) -> str | None:
        """Why it can't be used here, in one line with what would help; ``None`` where it can."""
        try:
            import_module(cls.module)
        except ModuleNotFoundError as error:
            if error.name == cls.module:
                return not_installed([cls.module])
            return f"{cls.module} cannot be loaded ({one_line(error)}); {install(error.name or cls.module)}"
        except Exception as error:  # extension modules raise all kinds where a shared library is missing
            return f"{cls.module} cannot be loaded ({one_line(error)})" + (f"; {cls.system}" if cls.system else "")
        return None

    @classmethod
    def version(cls) -> str:
        """The module's version."""
        return str(getattr(import_module(cls.module), "__version__", None) or metadata.version(cls.module))

    def prepare(self, instrument: Instrument, camera: Camera) -> None:
        """Set up for an instrument and a view. Untimed."""
        self.instrument, self.camera = instrument, camera

    @abstractmethod
    def aim(self, mask: Mask) -> None:
        """Take the ``(H, W)`` mask that the next silhouettes are compared with. Timed by itself."""

    @abstractmethod
    def silhouette(self, state: FloatArray) -> Mask:
        """The silhouette of one state ``(9,)``, ``(H, W)`` bool; the next call may overwrite it."""

    @abstractmethod
    def score(self, states: FloatArray) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Area of each silhouette and its overlap with the mask. This is what is timed.

        Args:
            states: ``(N, 9)``.

        Returns:
            ``(N,)`` and ``(N,)`` pixels.
        """

    def remark(self) -> str:
        """What a reader of its figures should know, beside its being on one core; may be empty."""
        return ""


class Peer(Contestant):
    """Renders each silhouette as an image, whose pixels are then counted.

    Attributes:
        exact: It covers a pixel if and only if its centre is covered, up to rounding.
        third_party: It is somebody else's renderer.
    """

    exact: ClassVar[bool] = True
    third_party: ClassVar[bool] = True

    @abstractmethod
    def draw(self, transforms: FloatArray) -> Mask:
        """Render one silhouette.

        Args:
            transforms: ``(L, 4, 4)`` T_cam_link.

        Returns:
            ``(H, W)`` bool; the next call may overwrite it.
        """

    def aim(self, mask: Mask) -> None:
        """Nothing to prepare."""
        self._mask = mask
        self._both = np.empty_like(mask)

    def silhouette(self, state: FloatArray) -> Mask:
        """Draw one state."""
        return self.draw(self.instrument.link_transforms(state))

    def score(self, states: FloatArray) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Place the links of all states at once; then draw and count one after the other."""
        counts = np.empty((2, len(states)), np.int64)
        for k, transforms in enumerate(self.instrument.link_transforms(states)):
            image = self.draw(transforms)
            counts[0, k] = np.count_nonzero(image)
            counts[1, k] = np.count_nonzero(np.logical_and(image, self._mask, out=self._both))
        return counts[0], counts[1]


def one_line(error: BaseException) -> str:
    """An error's text without its line breaks."""
    return " ".join(str(error).split()) or type(error).__name__
