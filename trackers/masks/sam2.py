"""Masks by SAM 2 and its kin, from points on the first frame (Ravi et al. 2024, arXiv:2408.00714)."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import Field, model_validator

from surgbench.config import Finite, Section
from surgbench.contract import Mask, Observation, Plugin, Scene, View
from surgbench.errors import ConfigError
from surgbench.extras import missing
from surgbench.mask_sources import FoundMasks, Prompts
from surgbench.trackers.masks.images import image_of
from surgbench.trackers.masks.sam2_video.checkpoint import (
    EXAMPLE,
    check_folder,
    fetched_folder,
    load_network,
    local_folder,
    weights_sha256,
)

HASH_DIGITS = 16


class Sam2Masks(Plugin):
    """An object for each arm, prompted with its own points and with those of the other as what it is not.

    Memory, prompts and network are those of ``Sam2VideoModel`` or ``EdgeTamVideoModel``, whichever the checkpoint says
    it is of; frames come one at a time. Where two arms are claimed by both objects, the surer one has the pixel. An arm
    without points on the first frame is not looked for.

    The confidence is that of the least sure arm: the likelihood that it shows at all times the overlap that the network
    expects of its mask, or where it is said not to show, the likelihood of that.
    """

    name: ClassVar[str] = "sam2"
    summary: ClassVar[str] = "SAM 2 or EdgeTAM from points on the first frame, with a checkpoint of your own"
    reads_images: ClassVar[bool] = True
    needs_prompts: ClassVar[bool] = True

    class Config(Section):
        """Options."""

        model: Annotated[
            str, Field(description=f"needed: a folder with a checkpoint, or a name on the hub such as {EXAMPLE}")
        ] = ""
        revision: Annotated[str, Field(description="of a name on the hub: branch, tag or commit")] = "main"
        model_sha256: Annotated[
            str, Field(description="start of the hash of the weights; a folder's is found unless told, and checked")
        ] = ""
        threshold: Annotated[Finite, Field(description="logit above which a pixel is the instrument's")] = 0.0
        memory_frames: Annotated[
            int | None,
            Field(ge=1, description="frames remembered, the first included; as many as the checkpoint's unless told"),
        ] = None
        memory_on: Annotated[
            Literal["device", "cpu"], Field(description="where the memory is kept: with the network, or off the GPU")
        ] = "device"

        @model_validator(mode="after")
        def _look_at_model(self) -> Sam2Masks.Config:
            if self.model:
                try:
                    folder = local_folder(self.model)
                    if folder is not None:
                        # The hash is an option, so that a record says which weights it was made with.
                        self.__dict__["model_sha256"] = _checked(folder, self.model_sha256)
                except ConfigError as error:
                    raise ValueError(str(error)) from None
            return self

    def __init__(self, config: Config | None = None) -> None:
        self.config = config or self.Config()

    @classmethod
    def unavailable(cls) -> str | None:
        """What this machine lacks, or ``None``."""
        return missing(("torch", "transformers"))

    def reset(self, scene: Scene, view: View, prompts: Prompts | None) -> None:
        """Load the network, unless it is already, and take the prompts.

        Raises:
            ConfigError: There is no model, or it is not one of these; no prompt, or one outside the picture; one line.
        """
        points, inside, self._prompted = _checked_prompts(scene, view, prompts)
        network = load_network(*self._checkpoint(), scene.device, self.config.memory_frames)
        # Here, for it imports PyTorch, which nobody who only looks up the plug-in need wait for.
        from surgbench.trackers.masks.sam2_video.objects import VideoObjects

        camera, memory = view.camera, "cpu" if self.config.memory_on == "cpu" else None
        self._arms, self._video = scene.arms, VideoObjects(network, camera.height, camera.width, memory)
        for arm in self._prompted:
            other = [points[one][inside[one]] for one in range(scene.arms) if one != arm]
            beside = np.concatenate([points[arm][~inside[arm]], *other])
            self._video.prompt(
                np.concatenate([points[arm][inside[arm]], beside]),
                np.arange(inside[arm].sum() + len(beside)) < inside[arm].sum(),
            )

    def segment(self, observation: Observation, view: View) -> FoundMasks:
        """The arms in the next frame.

        Raises:
            DatasetError: There is no image, or it is not of the camera's size; one line with the frame.
        """
        image, camera = image_of(observation, view), view.camera
        found = self._video.step(image)
        masks = np.zeros((self._arms, camera.height, camera.width), dtype=bool)
        surest = found.logits.argmax(axis=0)
        for place, arm in enumerate(self._prompted):
            masks[arm] = (surest == place) & (found.logits[place] > self.config.threshold)
        sure = np.where(found.presence > 0.5, found.presence * found.overlap, 1 - found.presence)
        every: Mask = np.logical_or.reduce(masks)
        return FoundMasks(every, tuple(masks), float(sure.min()))

    def _checkpoint(self) -> tuple[Path, str]:
        """The checkpoint's folder, and the hash of its weights."""
        config = self.config
        if not config.model:
            raise ConfigError(f"sam2 has no model: --set sam2.model=FOLDER, or a name on the hub such as {EXAMPLE}")
        folder = local_folder(config.model) or fetched_folder(config.model, config.revision)
        return folder, _checked(folder, config.model_sha256, HASH_DIGITS)


def _checked(folder: Path, start: str, digits: int = HASH_DIGITS) -> str:
    """The start of the hash of a checkpoint's weights.

    Raises:
        ConfigError: It is no checkpoint, or the hash starts otherwise; one line.
    """
    check_folder(folder)
    found: str = weights_sha256(folder)
    if not found.startswith(start):
        raise ConfigError(f"{folder}: its weights have changed: their hash is {found}, not {start}…")
    return found[:digits]


def _checked_prompts(
    scene: Scene, view: View, prompts: Prompts | None
) -> tuple[list[np.ndarray], list[np.ndarray], list[int]]:
    """Points of each arm, whether they are inside, and which arms have any that are.

    Raises:
        ConfigError: They are of another number of arms, outside the picture, or none is inside; one line.
    """
    if prompts is None or prompts.arms != scene.arms:
        said = "none" if prompts is None else f"those of {prompts.arms}"
        raise ConfigError(f"sam2 needs points on the first frame for {scene.arms} arms, and there are {said}")
    points = [np.asarray(one, dtype=np.float64).reshape(-1, 2) for one in prompts.points_px]
    inside = [np.asarray(one, dtype=bool) for one in prompts.inside]
    for u, v in np.concatenate(points):
        if not view.camera.contains(np.array([u, v])):
            size = f"{view.camera.width}x{view.camera.height}"
            raise ConfigError(f"sam2: the point ({u:g}, {v:g}) lies outside the picture of {size} pixels")
    prompted = [arm for arm in range(scene.arms) if inside[arm].any()]
    if not prompted:
        raise ConfigError("sam2 needs a point on an arm in the first frame, and there is none")
    return points, inside, prompted
