"""A recording's video becomes images, with masks where there are any."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Annotated, ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from surgbench.contract import Plugin
from surgbench.errors import DatasetError
from surgbench.exchange.footage_options import Arms, FrameOptions, Masked, arms_shown
from surgbench.exchange.masks import SEQUENCE_ID, check_fps
from surgbench.leftovers import without_leftovers
from surgbench.pictures import as_rgb
from surgbench.recordings.folder import MASKS, find_masks
from surgbench.recordings.frame_masks import picked
from surgbench.recordings.video import VIDEO_SUFFIXES, MaskVideo
from surgbench.tasks.instrument.footage import Footage
from surgbench.tasks.instrument.imported import write_import


class VideoImporter(Plugin):
    """A video file, or a folder with one and its camera, and masks beside it."""

    name: ClassVar[str] = "video"
    summary: ClassVar[str] = "a video (MP4, AVI, MKV) and camera.json; masks/, masks.mp4 or masks.json"
    examples: ClassVar[tuple[str, ...]] = (
        "surgbench import video suturing.mp4 --camera camera.json --masks segmented.mp4 --out data/suturing",
    )

    class Config(FrameOptions):
        """Options."""

        fps: Annotated[float | None, Field(description="Frames per second; default: as the video says, else 30.")] = (
            None
        )
        every: Annotated[int, Field(ge=1, description="Keep one frame of so many.")] = 1
        arm: Annotated[
            Arms,
            Field(
                description="Which arm the video shows; both: two instruments; default: left.",
                json_schema_extra={"option": "arms", "also": "arm"},
            ),
        ] = "left"

    def __init__(self, config: Config | None = None) -> None:
        self.config = config or self.Config()
        self._video: MaskVideo | None = None

    def frames(self, source: Path) -> int:
        """How many frames the video has."""
        check_fps(self.config.fps)
        return -(-len(self._opened(source).numbers) // self.config.every)

    def run(self, source: Path, out: Path, progress: Callable[[float], None]) -> list[str]:
        """Make the dataset; returns what was made of the video, line by line."""
        config, lines = self.config, list[str]()
        check_fps(config.fps)
        video = self._opened(source)
        folder, size = video.place.parent, video.size
        camera = config.read(folder, size, lines.append)
        arms = arms_shown(config.arm, config)
        masked = Masked(config, config.masks or _beside(folder), size, video.numbers, arms)
        frames = [frame for frame in masked.frames if frame % config.every == 0]
        if not frames:
            raise DatasetError(f"{video.place}: none of every {config.every} frames has a mask; leave --every out")
        times_s = self._times(video)

        def images(wanted: Sequence[int]) -> Iterator[NDArray[np.uint8]]:
            return (as_rgb(picture) for picture in picked(video.pictures(), wanted))

        footage = Footage(
            id=SEQUENCE_ID,
            camera=camera,
            times_s=times_s[frames],
            names=[video.names[frame] for frame in frames],
            shots=lambda: masked.shots(frames, images),
            arms=arms,
            kinds=masked.kinds,
            images=True,
            dt_s=1.0 / (config.fps or 30.0),
        )
        said = write_import(
            out,
            [footage],
            name=config.name or video.place.stem,
            instruments=config.instruments(),
            configuration=config.configuration(self.name),
            progress=progress,
        )
        doubts = [] if video.doubt is None else [f"warning: {video.doubt}"]
        return [*lines, *doubts, *masked.lines, *said]

    def _opened(self, source: Path) -> MaskVideo:
        if self._video is None:
            place = find_video(source)
            self._video = MaskVideo(place)
        return self._video

    def _times(self, video: MaskVideo) -> NDArray[np.float64]:
        if video.times_s is not None and self.config.fps is None:
            return video.times_s
        return np.arange(len(video.numbers)) / (self.config.fps or 30.0)


def find_video(source: Path) -> Path:
    """The video of a recording.

    Args:
        source: It, or the folder that it lies in.

    Raises:
        DatasetError: There is none, or several; one line.
    """
    if not source.exists():
        raise DatasetError(f"{source}: no such file or folder; expected a video ({', '.join(VIDEO_SUFFIXES)})")
    if not source.is_dir():
        if source.suffix.lower() not in VIDEO_SUFFIXES:
            raise DatasetError(f"{source}: not a video ({', '.join(VIDEO_SUFFIXES)}); pictures are of: import masks")
        return source
    videos = [
        path
        for path in sorted(without_leftovers(source.iterdir()))
        if path.suffix.lower() in VIDEO_SUFFIXES and path.stem.lower() != MASKS
    ]
    if len(videos) != 1:
        what = f"{videos[0].name} and {videos[1].name}" if videos else "no video"
        raise DatasetError(f"{source}: holds {what}; say which is the recording: import video FILE")
    return videos[0]


def _beside(folder: Path) -> Path | None:
    """Masks that are called so, beside the video."""
    named = [path for path in without_leftovers(folder.iterdir()) if path.stem.lower() == MASKS]
    return find_masks(folder) if named else None
