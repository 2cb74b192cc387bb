"""The whole job of the wire chaser: from a preset to a dataset on disk.

The same bytes every time with the same versions of the libraries on processors of one family; on others numbers within
1e-9 of them.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from surgbench.dataset.manifest import FORMAT, observations_path
from surgbench.dataset.writer import DatasetWriter, collect, read_part
from surgbench.generation import Workers
from surgbench.generators.resumable import (
    LISTED_BYTES_PER_FILE,
    blocks,
    configuration,
    in_this_process,
)
from surgbench.generators.wire_chaser.presets import WireChaser
from surgbench.generators.wire_chaser.trial import StoppedError, draw_samples, make_trial
from surgbench.processes.ending import end_worker_with_parent
from surgbench.tasks.viewpoint.format import TrialEntry, ViewpointManifest, feature_path, scene_path
from surgbench.tasks.viewpoint.writing import describe_trial, encode_trial
from surgbench.version import DATA_VERSION

# Numbers of six digits and more compress badly.
BYTES_PER_SAMPLE = 130
BYTES_PER_TRIAL = 120_000
# Each trial is a part of its own, written at once under this key.
TRIAL = "trial"


@dataclass(frozen=True)
class WirePlan:
    """What a generation will make; a :class:`surgbench.generation.GenerationPlan`.

    Attributes:
        preset: Effective preset.
        only: Ids of the trials that alone are made, each as in the whole; all where there are none.
    """

    preset: WireChaser
    only: tuple[str, ...] = ()

    @cached_property
    def samples(self) -> dict[str, int]:
        """Trial to its number of samples, in order."""
        digits = max(3, len(str(self.preset.trials - 1)))
        ids = [f"{index:0{digits}d}" for index in range(self.preset.trials)]
        return {id_: draw_samples(self.preset, id_) for id_ in ids if not self.only or id_ in self.only}

    @property
    def name(self) -> str:
        """The dataset's."""
        name: str = self.preset.name
        return name

    @property
    def frames(self) -> int:
        """Samples over all trials."""
        return sum(self.samples.values())

    @property
    def counts(self) -> str:
        """How much there will be, a few words."""
        trials = f"{len(self.samples)} {'trial' if len(self.samples) == 1 else 'trials'}"
        return f"{trials}, {self.frames} samples"

    @property
    def marker(self) -> dict[str, Any]:
        """Effective configuration."""
        whole = {"format": FORMAT, "preset": self.preset.model_dump(mode="json")}
        return {**whole, "part": list(self.samples)} if self.only else whole

    @property
    def paths(self) -> list[str]:
        """Every file but the manifest."""
        return [file for trial_id in self.samples for file in _files(trial_id)]

    @property
    def disk_bytes(self) -> int:
        """Disk that the whole dataset takes, an upper estimate."""
        size = self.frames * BYTES_PER_SAMPLE + len(self.samples) * BYTES_PER_TRIAL
        return int(blocks(size) + blocks(len(self.paths) * LISTED_BYTES_PER_FILE))

    def write(self, out: Path, workers: Workers, progress: Callable[[float], None]) -> ViewpointManifest:
        """Write everything but the manifest; what is there whole stays."""
        tasks = list(self.samples)
        if in_this_process(workers):
            worker = _Worker(self.preset, out)
            for trial_id in tasks:
                progress(worker.write(trial_id))
        else:
            workers.do(tasks, _write_trial, _start_worker, (self.preset, out), progress)
        files = collect(out, tasks, self.paths)
        trials = [TrialEntry.model_validate(read_part(out, trial_id)[TRIAL].about) for trial_id in tasks]
        return ViewpointManifest(
            name=self.preset.name,
            created_by=f"surgbench {DATA_VERSION}",
            origin="generated",
            seed=self.preset.seed,
            configuration=configuration(self),
            trials=tuple(trials),
            camera_arm=self.preset.camera_arm,
            files=files,
        )


class _Worker:
    """Makes trials.

    Args:
        preset: Effective preset.
        out: The dataset's folder.
        stop: Once true, no further wire is looked for.
    """

    def __init__(self, preset: WireChaser, out: Path, stop: ctypes.c_bool | None = None) -> None:
        self._preset, self._out, self._stop = preset, out, stop

    def write(self, trial_id: str) -> int:
        """Write a trial's files, if they are not there; returns its number of samples."""
        writer = DatasetWriter(self._out, trial_id)
        if writer.done(TRIAL) is None:
            try:
                trial = make_trial(self._preset, trial_id, lambda: self._stop is None or not self._stop.value)
            except StoppedError:
                return 0
            about = describe_trial(trial, self._preset.level).model_dump(mode="json")
            writer.write(TRIAL, encode_trial(trial), about)
        samples: int = draw_samples(self._preset, trial_id)
        return samples


def _files(trial_id: str) -> list[str]:
    return [observations_path(trial_id), feature_path(trial_id), scene_path(trial_id)]


_worker: _Worker | None = None


def _start_worker(preset: WireChaser, out: Path, stop: ctypes.c_bool) -> None:
    global _worker
    end_worker_with_parent()
    _worker = _Worker(preset, out, stop)


def _write_trial(trial_id: str) -> int:
    assert _worker is not None
    return _worker.write(trial_id)
