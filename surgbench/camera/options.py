"""What a command may be told of the camera of somebody's recording."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated

from pydantic import Field

from surgbench.camera.pinhole import Camera, read_camera
from surgbench.config import Section
from surgbench.errors import DatasetError


class CameraOptions(Section):
    """Which file."""

    camera: Annotated[
        Path | None,
        Field(description="FILE: The camera: camera.json; default: the one in the recording's folder."),
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
            DatasetError: There is none, or it is of another size; one line that names the option.
        """
        path = self.camera or folder / "camera.json"
        if not path.exists():
            raise DatasetError(
                f"{path}: camera file is missing (keys: width, height, fx, fy, cx, cy); --camera FILE names another"
            )
        camera = read_camera(path)
        if pictures not in (None, (camera.width, camera.height)):
            raise DatasetError(
                f"{path}: is of {camera.width}x{camera.height} pixels, the pictures are {pictures[0]}x{pictures[1]}; "
                "--camera FILE names another"
            )
        return camera
