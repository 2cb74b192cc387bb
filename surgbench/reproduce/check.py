"""A committed table, checked: its files against each other, and a part of it run again."""

from __future__ import annotations

import json
import math
import statistics
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from surgbench.dataset.base import Dataset
from surgbench.dataset.open import open_dataset
from surgbench.errors import DatasetError
from surgbench.files import sha256_file
from surgbench.processes.reference import REFERENCE_MS
from surgbench.randomness import generator
from surgbench.records.format import SKIPPED
from surgbench.reproduce.consistency import inconsistencies
from surgbench.reproduce.datasets import MakeDataset, PartRequest, Watcher, provide
from surgbench.reproduce.files import LEADERBOARD_CSV, read_results
from surgbench.reproduce.fingerprint import head, largest_deviation
from surgbench.reproduce.results import Results
from surgbench.reproduce.table import Block, Definition, TableRow
from surgbench.suite.environment import environment
from surgbench.suite.perform import ThisMachine
from surgbench.suite.plan import complete
from surgbench.suite.plan import jobs as plan_jobs
from surgbench.suite.run import make_plan
from surgbench.suite.run import run as run_plan
from surgbench.suite.running import Run
from surgbench.suite.settings import Job
from surgbench.task import find_task

Outcome = Literal["identical", "close", "differs", "failed", "skipped"]

# Another processor rounds differently, and a search by samples then goes other ways. Its mean error over the first
# frames may differ by so many of its standard errors (ten frames counting as one, since they resemble each other),
# this share of it, and by what nobody would call a difference.
STANDARD_ERRORS, FRAMES_ALIKE, SHARE = 3.0, 10, 0.1


@dataclass(frozen=True)
class Chosen:
    """One arm or pair of one row that is run again."""

    block: Block
    row: TableRow
    unit: str
    frames: int

    @property
    def key(self) -> str:
        """Of its record in ``records.json``."""
        return f"{self.row.id}/{self.unit}/r0"


@dataclass(frozen=True)
class Verdict:
    """What came of it.

    Attributes:
        chosen: What was run again.
        outcome: ``identical`` to the last bit; ``close``: other bits, errors within tolerance; ``differs``:
            beyond it; ``failed``; ``skipped``: this machine lacks something for it.
        detail: One line.
        latency: What a frame took then and now, one line; ``None`` where that is not known.
    """

    chosen: Chosen
    outcome: Outcome
    detail: str
    latency: str | None = None

    @property
    def good(self) -> bool:
        """Nothing against the table."""
        return self.outcome in ("identical", "close", "skipped")


def check(
    definition: Definition, folder: Path, data: Path, jobs: int, make: MakeDataset, watcher: Watcher
) -> tuple[list[str], list[Verdict]]:
    """Check a table.

    Args:
        definition: The table as it is defined now.
        folder: Its files.
        data: Folder of datasets; what is not there whole is made in part, elsewhere, and removed again.
        jobs: Worker processes.
        make: Makes datasets.
        watcher: Is told what is going on.

    Returns:
        What does not fit among its files, and what came of each run.

    Raises:
        DatasetError: A file of the table is missing or damaged.
    """
    results = read_results(folder)
    problems = inconsistencies(definition, results, folder)
    for problem in problems:
        watcher.say(problem)
    if problems:
        return problems, []
    watcher.say(f"made on {processors(results.about)}; run again on {machine_text(environment()['machine'])}")
    commit = (environment()["git"] or {}).get("commit", "none")
    table_sha256 = sha256_file(folder / LEADERBOARD_CSV)
    chosen = choose(definition, results, table_sha256, commit)
    watcher.say(f"chosen by table {table_sha256[:12]} and commit {commit[:12]}:")
    for one in chosen:
        watcher.say(f"  {one.row.id} on {one.unit}, first {one.frames} frames ({one.block.dataset.folder})")
    verdicts: list[Verdict] = []
    with tempfile.TemporaryDirectory(prefix="surgbench-check-") as scratch:
        for block in definition.table.blocks:
            own = [one for one in chosen if one.block is block]
            if own:
                dataset = _dataset(block, own, results, data, Path(scratch), jobs, make)
                verdicts += _run_again(block, own, dataset, results, Path(scratch) / "records", jobs, watcher)
    return problems, verdicts


def choose(definition: Definition, results: Results, table_sha256: str, commit: str) -> list[Chosen]:
    """Which rows, and of each which arm or pair: whoever has the same table and commit gets the same ones."""
    rng = generator(table=table_sha256, commit=commit, purpose="check")
    rows = list(definition.table.rows())
    chosen: list[Chosen] = []
    for place in rng.permutation(len(rows)):
        block, row = rows[place]
        sound = [
            one["unit"]
            for one in results.sequences
            if one["row_id"] == row.id and one["status"] == "ok" and one["repeat"] == 0
        ]
        unit = int(rng.integers(max(1, len(sound))))  # drawn for every row, so that one more sound row changes little
        if sound and len(chosen) < definition.table.check.runs:
            frames = results.about["records"][f"{row.id}/{sound[unit]}/r0"]["head"]["frames"]
            chosen.append(Chosen(block, row, sound[unit], frames))
    return sorted(chosen, key=lambda one: [row.id for _, row in rows].index(one.row.id))


def _dataset(
    block: Block, chosen: Sequence[Chosen], results: Results, data: Path, scratch: Path, jobs: int, make: MakeDataset
) -> Dataset[Any]:
    """The whole dataset where it lies already, else just what is needed of it."""
    committed = results.about["datasets"][block.dataset.folder]
    try:
        whole = open_dataset(data / block.dataset.folder)
        if whole.hash == committed["sha256"]:
            return whole
    except DatasetError:
        pass
    # A unit is a sequence, or one arm of it.
    ids = list(first_sha256(committed))
    needed = tuple(id_ for id_ in ids if any(one.unit.partition("-")[0] == id_ or one.unit == id_ for one in chosen))
    return provide(block.dataset, PartRequest(needed, results.about["first_frames"]), scratch, jobs, make)


def _run_again(
    block: Block,
    chosen: Sequence[Chosen],
    dataset: Dataset[Any],
    results: Results,
    out: Path,
    workers: int,
    watcher: Watcher,
) -> list[Verdict]:
    jobs = [_job(block, one, dataset) for one in chosen]
    plan = make_plan(jobs, out)
    with watcher.progress(block.heading, plan.frames) as bar:
        run_plan(plan, dataset, out, ThisMachine(workers), Run(bar, bar.stage), lambda record: None)
    verdicts = []
    for one, job in zip(chosen, jobs, strict=True):
        record = json.loads((out / job.path).read_text(encoding="utf-8"))
        judged = _judge(one, job, record, dataset, results)
        verdicts.append(replace(judged, latency=latency_text(one, record, results)))
    return verdicts


def _job(block: Block, chosen: Chosen, dataset: Dataset[Any]) -> Job:
    asked = chosen.row.asked(quick=False).model_copy(update={"sequences": None, "frames": chosen.frames})
    settings = complete(asked, block.conditions, dataset)
    return next(job for job in plan_jobs(settings, dataset) if job.unit.id == chosen.unit and job.repeat == 0)


def _judge(chosen: Chosen, job: Job, record: dict[str, Any], dataset: Dataset[Any], results: Results) -> Verdict:
    if record["status"] == SKIPPED:
        return Verdict(chosen, "skipped", record["error"])
    if record["status"] != "ok":
        return Verdict(chosen, "failed", f"{record['status']}: {record['error']}")
    sheet = find_task(job.settings.task).sheet
    committed, found = results.about["records"][chosen.key]["head"], head(record, chosen.frames, sheet)
    if committed["states_sha256"] == found["states_sha256"]:
        return Verdict(chosen, "identical", f"{found['frames']} states bit for bit")
    beyond = beyond_tolerance(committed, found, sheet.no_difference)
    notes = [f"frame {found['frames'] - 1} off by {largest_deviation(committed['last'], found['last']):.2g}"]
    notes += [f"mean {name} {now:.4g} instead of {then:.4g}" for name, then, now in beyond]
    if not _same_data(chosen, job, dataset, results):
        notes.append("the data are not the committed ones")
    settings_hash = next(row["settings_hash"] for row in results.rows if row["row_id"] == chosen.row.id)
    if chosen.row.frames is None and replace(job.settings, frames_limit=None).hash != settings_hash:
        notes.append("options, or the source of a plug-in or the engine, have changed since the table was made")
    return Verdict(chosen, "differs" if beyond else "close", "; ".join(notes))


def processors(about: dict[str, Any]) -> str:
    """The machines that a table was made on."""
    return " and ".join(sorted({machine_text(one["machine"]) for one in about["environments"]}))


def machine_text(machine: dict[str, Any]) -> str:
    """A processor and what is known of it besides; records of old versions know less."""
    more = [machine["vectors"]] if machine.get("vectors") else []
    if machine.get("threads"):
        more.append("1 thread" if machine["threads"] == 1 else f"{machine['threads']} threads")
    return ", ".join([str(machine["processor"]), *more])


def latency_text(chosen: Chosen, record: dict[str, Any], results: Results) -> str | None:
    """Medians of a frame of the row, then and now, also as the reference machine would have them. They are not judged.

    Those of the table are of more frames, one run at a time; a check's runs go on beside each other.
    """
    own = (row for row in results.rows if row["row_id"] == chosen.row.id)
    row = next((row for row in own if find_task(row["task"]).is_whole(row)), None)
    taken = [value for value in (record["frames"] or {}).get("latency_ms", []) if value is not None]
    if row is None or row["latency_ms"] is None or not taken:
        return None
    calibration = record.get("calibration_ms")
    now = _latency_words(statistics.median(taken), None if calibration is None else calibration / REFERENCE_MS)
    return f"latency {now} here, {_latency_words(row['latency_ms'], row['calibration_ratio'])} in the table"


def _latency_words(latency_ms: float, ratio: float | None) -> str:
    if not ratio:
        return f"{latency_ms:.3g} ms"
    return f"{latency_ms:.3g} ms (calibration ratio {ratio:.2f}: {latency_ms / ratio:.3g} ms on the reference machine)"


def beyond_tolerance(
    committed: dict[str, Any], found: dict[str, Any], no_difference: dict[str, float]
) -> list[tuple[str, float, float]]:
    """Errors of the first frames that no rounding explains: name, mean then, mean now."""
    beyond = []
    independent = max(1.0, committed["frames"] / FRAMES_ALIKE)
    for name, (mean, std) in committed["errors"].items():
        tolerance = STANDARD_ERRORS * std / math.sqrt(independent) + SHARE * abs(mean) + no_difference[name]
        now = found["errors"].get(name, [math.inf])[0]
        if abs(now - mean) > tolerance:
            beyond.append((name, mean, now))
    return beyond


def _same_data(chosen: Chosen, job: Job, dataset: Dataset[Any], results: Results) -> bool:
    committed = first_sha256(results.about["datasets"][chosen.block.dataset.folder])[job.unit.sequence]
    found = find_task(job.settings.task).sheet.describe(dataset, results.about["first_frames"])
    return bool(committed == found["first_sha256"][job.unit.sequence])


def first_sha256(dataset: dict[str, Any]) -> dict[str, str]:
    """Sequence to the hash of its first frames, as a table keeps it of a dataset."""
    # Tables made before there was another task than that of masks have the older name.
    hashes: dict[str, str] = dataset.get("first_sha256") or dataset["first_masks_sha256"]
    return hashes
