"""One run of an instrument tracker as pictures: what was seen, and the outline of what was estimated."""

from __future__ import annotations

from pathlib import Path

from surgbench.report.drawing import Picture
from surgbench.report.recorded import choose_runs
from surgbench.tasks.instrument.dataset import InstrumentDataset
from surgbench.tasks.instrument.records import InstrumentRecord
from surgbench.tasks.instrument.scenery import Scenery
from surgbench.tasks.instrument.video import make_shots

WIDTH = 560
# Of films: half as many pictures as most cameras take are smooth enough, and half as large.
FPS = 15.0


class FilmedTracker:
    """Pictures of one run.

    Args:
        record: The run.
        dataset_path: Where its dataset is, if not where the record says.

    Raises:
        SurgbenchError: The dataset is not there, or is another one.
    """

    def __init__(self, record: InstrumentRecord, dataset_path: Path | None = None) -> None:
        (job,) = choose_runs(InstrumentDataset, [record], (), (), dataset_path)
        self._scenery, self._shots = Scenery(job.dataset, record), make_shots([record])
        self.dt_s = self._scenery.recording.dt_s
        self.every = max(1, round(1.0 / (FPS * self.dt_s)))
        self.frames = min(len(record.frames.state), self._scenery.recording.frames)

    @property
    def legend(self) -> str:
        """What the two outlines are."""
        return "Green: outline of the mask that the tracker saw. Pink: outline of its estimate."

    def picture(self, frame: int) -> Picture:
        """The image, or the mask in grey, with both outlines."""
        camera = self._scenery.camera
        panel = self._scenery.panel(frame, self._shots, min(1.0, WIDTH / camera.width))
        height, width = panel.shape[:2]
        return panel[: height - height % 2, : width - width % 2]
