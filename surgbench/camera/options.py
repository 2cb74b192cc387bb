"""What a command may be told of the camera of somebody's recording."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

from pydantic import Field

from surgbench.camera.files import find_camera, read_camera
from surgbench.camera.formats import model_named
from surgbench.camera.pinhole import Camera
from surgbench.config import Section
from surgbench.errors import ConfigError


class CameraOptions(Section):
    """Which file, and what it does not say."""

    camera: Annotated[
        Path | None,
        Field(
            description="FILE: The camera: camera.json, YAML or XML of OpenCV, CameraInfo of ROS, or a matrix K; "
            "default: the one in the recording's folder."
        ),
    ] = None
    camera_size: Annotated[
        str | None,
        Field(description="WIDTHxHEIGHT the camera was calibrated at, where its file does not say, as 1400x986."),
    ] = None
    distortion_model: Annotated[
        str | None,
        Field(description="NAME: The lens's model, where the camera's file does not say: opencv or fisheye."),
    ] = None

    def read(
        self, folder: Path, pictures: tuple[int, int] | None, say: Callable[[str], None] = lambda line: None
    ) -> Camera:
        """The camera of a recording's pictures.

        Args:
            folder: Where its file is looked for, unless told.
            pictures: Their width and height.
            say: Takes lines that tell what was read.

        Raises:
            ConfigError: An option is wrong.
            DatasetError: See :func:`surgbench.camera.files.find_camera` and :func:`surgbench.camera.files.read_camera`.
        """
        try:
            model = None if self.distortion_model is None else model_named(self.distortion_model)
        except ConfigError as error:
            raise ConfigError(f"--distortion-model: {error}") from None
        size = None if self.camera_size is None else parse_size(self.camera_size, "--camera-size")
        path = find_camera(folder) if self.camera is None else self.camera
        return read_camera(path, pictures, calibrated_at=size, model=model, say=say)


def parse_size(text: str, option: str) -> tuple[int, int]:
    """Width and height of ``WIDTHxHEIGHT``.

    Raises:
        ConfigError: The text is no such thing.
    """
    match = re.fullmatch(r"\s*(\d{1,5})\s*x\s*(\d{1,5})\s*", text, re.IGNORECASE)
    if match is None:
        raise ConfigError(f"{option}: must be WIDTHxHEIGHT, for example 1400x986, not '{text}'")
    return int(match[1]), int(match[2])
