"""A frame's images, depth and numbered links, as files."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from surgbench.camera import Camera
from surgbench.dataset.masks import Mask, encode_image, encode_levels
from surgbench.generators.lens import Lens
from surgbench.generators.looks.optics import Optics
from surgbench.generators.looks.scene import PictureRenderer
from surgbench.generators.looks.sections import Images
from surgbench.generators.looks.sequence import EYE, SequenceLook
from surgbench.generators.render import MaskRenderer
from surgbench.geometry import FloatArray
from surgbench.instrument import Instrument
from surgbench.randomness import generator
from surgbench.tasks.instrument.format import (
    ARMS,
    DEPTH_KIND,
    DEPTH_UNIT_M,
    IMAGE_KIND,
    LINKS_KIND,
    observed_path,
    truth_picture_path,
    view_folder,
)

# What is numbered of the right arm has so much more.
RIGHT_LINKS = 64


class PictureWriter:
    """Makes images of one sequence after the other.

    Args:
        images: The preset's section.
        variant: Of Mitsuba.
        instrument: The real one, of all arms.
        camera: The real one, distortion included; of both eyes.
        dt_s: Seconds between frames.
        seed: Of the dataset.
        third: Whether a third instrument may come in.
    """

    def __init__(
        self,
        images: Images,
        variant: str,
        instrument: Instrument,
        camera: Camera,
        dt_s: float,
        seed: int,
        *,
        third: bool,
    ) -> None:
        import drjit

        # With several, now and then a pixel is another by one level: whoever wants more cores has more jobs.
        drjit.set_thread_count(1)
        self._images, self._variant, self._instrument = images, variant, instrument
        self._dt_s, self._seed, self._third = dt_s, seed, third
        self._lens = Lens(camera)
        self._arms = [ARMS.index(arm) for arm in ARMS if arm in images.arms]
        self._links = _links(instrument, self._lens.pinhole) if images.links else []
        self._sequence: str | None = None

    def files(
        self,
        sequence: str,
        frame: int,
        states: FloatArray,
        look: SequenceLook,
        third: FloatArray | None = None,
        hidden: Mask | None = None,
    ) -> dict[str, bytes]:
        """A frame's files by their place in the dataset.

        Args:
            sequence: Its id.
            frame: Its number.
            states: ``(2, 9)``.
            look: Of the sequence.
            third: ``(9,)`` of a third instrument.
            hidden: ``(height, width)`` what something in front of the instruments hides.
        """
        self._open(sequence, look)
        time_s = frame * self._dt_s
        shown = self._shown(states, third)
        moves = np.zeros_like(shown)
        moves[: len(self._arms)] = look.steps[frame][self._arms] * look.look["shutter"]
        files: dict[str, bytes] = {}
        for eye in range(self._eyes):
            axes: dict[str, str | int] = {"dataset": self._seed, "sequence": sequence, "frame": frame, "eye": eye}
            seed = int(generator(**axes, purpose="rays").integers(1 << 31))
            linear = self._lens.show(self._renderer.linear(shown, moves, time_s, seed, eye)[..., :3])
            depth = self._lens.show(self._renderer.depth_m(shown, time_s, eye).astype(np.float32))
            noise = generator(**axes, purpose="sensor")
            image = self._optics[eye].image(linear, depth, time_s, noise, hidden if eye == 0 else None)
            folder = sequence if eye == 0 else view_folder(sequence, EYE)
            files[observed_path(folder, IMAGE_KIND, frame)] = encode_image(image)
            if eye == 0 and self._images.depth:
                files[truth_picture_path(sequence, DEPTH_KIND, frame)] = encode_levels(depth_levels(depth))
        if self._images.links:
            files[truth_picture_path(sequence, LINKS_KIND, frame)] = encode_levels(self.links(states))
        return files

    def links(self, states: FloatArray) -> NDArray[np.uint8]:
        """``(height, width)`` which link of which arm is seen at each pixel's centre: see ``docs/images.md``."""
        shape = self._lens.pinhole.height, self._lens.pinhole.width
        nearest = np.full(shape, np.inf, np.float32)
        numbers = np.zeros(shape, np.uint8)
        for arm in self._arms:
            for number, renderer in self._links:
                distance = renderer.distance(states[arm])
                here = (distance > 0) & (distance < nearest)
                nearest[here] = distance[here]
                numbers[here] = number + (RIGHT_LINKS if ARMS[arm] == "right" else 0)
        seen: NDArray[np.uint8] = self._lens.see(numbers)
        return seen

    def _open(self, sequence: str, look: SequenceLook) -> None:
        """Build the scene of a sequence, and set its exposure, unless that is the one at work."""
        if self._sequence == sequence:
            return
        eyes = [np.eye(4)] if look.T_eye_cam is None else [np.eye(4), look.T_eye_cam]
        self._eyes = len(eyes)
        camera, images = self._lens.pinhole, self._images
        count = len(self._arms) + self._third
        self._renderer = PictureRenderer(
            self._instrument,
            count,
            camera,
            look.look,
            self._variant,
            images.samples,
            look.nearest_m,
            eyes,
        )
        jpeg = images.compression == "jpeg"
        self._optics = [Optics(self._lens.camera, look.look, jpeg=jpeg) for _ in eyes]
        first = self._shown(look.first, None)
        linear = self._lens.show(self._renderer.linear(first, np.zeros_like(first), 0.0, 0, samples=1)[..., :3])
        depth = self._lens.show(self._renderer.depth_m(first, 0.0).astype(np.float32))
        self._optics[0].expose(linear, depth)
        for other in self._optics[1:]:
            other.gain = self._optics[0].gain
        self._sequence = sequence

    def _shown(self, states: FloatArray, third: FloatArray | None) -> FloatArray:
        """``(arms, 9)`` all that is in the picture; a third instrument that is not there is behind the camera."""
        shown = states[self._arms]
        if not self._third:
            return shown
        if third is None:
            third = np.zeros(9)
            third[5] = -1.0
        return np.concatenate([shown, third[None]])


def depth_levels(depth_m: NDArray[np.float32]) -> NDArray[np.uint16]:
    """Depth as it is stored: levels of 0.01 mm, the last for what is further, 0 for nothing."""
    return np.asarray(np.clip(np.rint(depth_m / DEPTH_UNIT_M), 0, 65535), np.uint16)


def _links(instrument: Instrument, camera: Camera) -> Sequence[tuple[int, MaskRenderer]]:
    """A renderer of each link that has a body, with its number."""
    return [
        (1 + instrument.link_index[name], MaskRenderer([Instrument(instrument.spec, {name: mesh})], camera))
        for name, mesh in instrument.meshes.items()
    ]
