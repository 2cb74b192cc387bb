"""The steps of ``surgbench track``, each in a folder of its own below one scratch folder."""

from __future__ import annotations

import sys
from functools import cached_property
from pathlib import Path
from typing import Any

from surgbench.cli.progress import progress
from surgbench.dataset.base import Dataset
from surgbench.dataset.open import open_dataset
from surgbench.errors import ConfigError, SurgbenchError
from surgbench.exporting import export, read_material
from surgbench.records.reader import read_records
from surgbench.registry import create, find
from surgbench.report.video_options import VideoOptions
from surgbench.suite.perform import ThisMachine
from surgbench.suite.plan import complete_all, jobs
from surgbench.suite.run import make_plan, run
from surgbench.suite.running import Run
from surgbench.suite.suites import from_command_line, parse_sets
from surgbench.task import find_task

# The longest wait for one answer of a tracker: nothing is measured here, and a machine may be busy.
PATIENCE_S = 600.0


class Tracking:
    """One recording on its way to poses.

    Args:
        scratch: A folder for everything that is made on the way.
        importer: What reads it.
    """

    def __init__(self, scratch: Path, importer: str) -> None:
        self._importer, self._pairs = importer, False
        self._data, self._runs, self._export, self._drawn = (
            scratch / name for name in ("dataset", "runs", "export", "video")
        )

    def read(self, source: Path, options: dict[str, Any]) -> None:
        """Import the recording, and say what was made of it.

        Args:
            source: A recording as the importer takes it.
            options: Those of the importer.

        Raises:
            SurgbenchError: Something in it is missing or wrong.
        """
        self._pairs = options.get("arm") == "both" and not options.get("instances")
        found = find("importer", self._importer)
        takes: Any = getattr(found.cls, "Config", None)
        for name in options:
            if name not in takes.model_fields:
                raise ConfigError(f"--{name.replace('_', '-')}: is for recordings with masks, not for --masks")
        importer = create(found, {"name": source.resolve().stem, **options})
        with progress("reading frames", importer.frames(source)) as advance:
            lines = importer.run(source, self._data, advance)
        for line in lines or ():
            print(line, file=sys.stderr)

    @cached_property
    def _dataset(self) -> Dataset[Any]:
        return open_dataset(self._data)

    def run(self, tracker: str, row: dict[str, Any], sets: list[str]) -> None:
        """Track every unit.

        Args:
            tracker: A name, or ``FILE.py:Class``.
            row: What else is asked for, as by options of ``surgbench run``.
            sets: Options of plug-ins, ``NAME.option=value``.

        Raises:
            SurgbenchError: The tracker is not there, cannot run here, or fails.
        """
        conditions: dict[str, Any] = {"timeout_s": PATIENCE_S, **({"arms": "dual"} if self._pairs else {})}
        suite = from_command_line(None, [tracker], row, conditions)
        planned = complete_all(suite.rows, suite, self._dataset, parse_sets(sets))
        todo = [job for one in planned for job in jobs(one, self._dataset)]
        for one in planned:
            if one.unavailable is not None:
                raise SurgbenchError(one.unavailable)
        plan = make_plan(todo, self._runs)
        problems: list[str] = []

        def finished(record: dict[str, Any]) -> None:
            if record["status"] != "ok":
                problems.append(f"{record['spec']['row_id']} {record['spec']['unit']}: {record['error']}")

        with progress("tracking frames", plan.frames) as bar:
            run(plan, self._dataset, self._runs, ThisMachine(), Run(bar, bar.stage), finished)
        if problems:
            raise SurgbenchError(problems[0])

    def poses(self) -> Path:
        """A table of the poses."""
        exporter = create(find("exporter", "csv"), {})
        export(exporter, read_material(self._runs), self._export, lambda frames: None)
        (table,) = self._export.glob("*.csv")
        return table

    def video(self) -> Path:
        """The estimates over the masks, or pictures where there are any."""
        records, options = read_records([self._runs]), VideoOptions(overlay=True)
        drawn = find_task(self._dataset.task).draw(records, options, None, self._drawn, progress)
        films = [path for path in drawn if path.suffix == ".mp4"]
        if len(films) > 1:
            print(f"the video shows the first of {len(films)} sequences", file=sys.stderr)
        return films[0]
