"""One run of a camera controller as pictures: the scene in space, what both eyes see, errors and rules."""

from __future__ import annotations

from pathlib import Path

from surgbench.report.drawing import Picture, scaled
from surgbench.report.video_options import VideoOptions
from surgbench.tasks.viewpoint.film.film import FPS, make_film, plan
from surgbench.tasks.viewpoint.records import ViewpointRecord

WIDTH = 900


class FilmedController:
    """Pictures of one run.

    Args:
        record: The run.
        dataset_path: Where its dataset is, if not where the record says.

    Raises:
        SurgbenchError: The dataset is not there, or is another one; or the run did no step.
    """

    def __init__(self, record: ViewpointRecord, dataset_path: Path | None = None) -> None:
        (job,) = plan([record], VideoOptions(), dataset_path)
        self._film = make_film(job)
        self.frames = self._film.steps
        self.dt_s = job.dataset.sequence(record.spec.sequence).entry.dt_s
        self.every = max(1, round(1.0 / (FPS * self.dt_s)))

    @property
    def legend(self) -> str:
        """What the parts are."""
        return "Left: the scene in space. Right: what the camera's two eyes see. Below: errors and rules over time."

    def picture(self, frame: int) -> Picture:
        """A frame of the film, smaller."""
        picture = self._film.frame(frame)
        small = scaled(picture, min(1.0, WIDTH / picture.shape[1]))
        height, width = small.shape[:2]
        return small[: height - height % 2, : width - width % 2]
