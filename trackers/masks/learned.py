"""Masks by a small network of our own, which comes with the package: a U-Net, trained on rendered images."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, ClassVar

import numpy as np
from pydantic import Field, model_validator

from surgbench.config import Section
from surgbench.contract import Observation, Plugin, Scene, View
from surgbench.extras import missing
from surgbench.files import HASH_DIGITS, sha256_file
from surgbench.mask_sources import FoundMasks, Prompts
from surgbench.trackers.masks.images import image_of

MODEL = Path(__file__).parent / "models" / "unet" / "weights.safetensors"


class LearnedMasks(Plugin):
    """Each frame on its own: the network sees all instruments in it, of which the scene's arms are picked.

    The confidence is how sure the network is, in the mean, of the pixels that it takes for the scene's arms: 0 where
    they are as likely none, 1 where there is no doubt. It is 0 where it finds nothing.
    """

    name: ClassVar[str] = "learned"
    summary: ClassVar[str] = "a small network, trained on rendered images, finds the instruments in each image"
    reads_images: ClassVar[bool] = True

    class Config(Section):
        """Options."""

        model: Annotated[
            Path | None, Field(description="a FILE.safetensors of surgbench train masks; the package's own unless told")
        ] = None
        model_sha256: Annotated[str, Field(description="start of the file's hash; found unless told, and checked")] = ""
        threshold: Annotated[
            float, Field(gt=0, lt=1, description="how likely a pixel has to be an instrument's to be in the mask")
        ] = 0.5

        @model_validator(mode="after")
        def _find_model(self) -> LearnedMasks.Config:
            # The hash is an option, so that a record says which weights it was made with.
            if not self.path.is_file():
                raise ValueError(f"no model '{self.path}'; expected a FILE.safetensors of surgbench train masks")
            found = sha256_file(self.path)
            if not found.startswith(self.model_sha256):
                raise ValueError(f"{self.path} has changed: its hash is {found}, not {self.model_sha256}…")
            self.__dict__["model_sha256"] = found[:HASH_DIGITS]
            return self

        @property
        def path(self) -> Path:
            """The model's file."""
            return self.model or MODEL

    def __init__(self, config: Config | None = None) -> None:
        self.config = config or self.Config()

    @classmethod
    def unavailable(cls) -> str | None:
        """What this machine lacks, or ``None``."""
        return missing(("torch", "safetensors"))

    def reset(self, scene: Scene, view: View, prompts: Prompts | None) -> None:
        """Load the network, and ask it once, so that no frame pays for that.

        Raises:
            SurgbenchError: The model is damaged, or one of something else; one line.
        """
        # Here, for it imports PyTorch, which nobody who only looks up the plug-in need wait for.
        from surgbench.trackers.masks.own_arms import OwnArms
        from surgbench.trackers.masks.unet.model import Segmenter, load_network

        camera = view.camera
        network, settings = load_network(self.config.path)
        self._segmenter = Segmenter(network, settings, camera.width, camera.height, scene.device)
        self._segmenter.logits(np.zeros((camera.height, camera.width, 3), np.uint8))
        self._own = OwnArms(scene, view, prompts)

    def segment(self, observation: Observation, view: View) -> FoundMasks:
        """What shows of the scene's arms in the view's image.

        Raises:
            DatasetError: There is no image, or it is of another size than the camera's; one line.
        """
        image = image_of(observation, view)
        logits = self._segmenter.logits(image)
        least = np.log(self.config.threshold / (1.0 - self.config.threshold))
        mask = self._own.pick(logits > least, observation, view)
        # Of odds o, the share o / (1 + o); twice what that is above a half is how sure it is.
        sure = np.abs(np.tanh(0.5 * logits[mask]))
        return FoundMasks(mask, None, float(sure.mean()) if len(sure) else 0.0)
