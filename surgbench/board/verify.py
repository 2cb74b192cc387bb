"""A submission, verified: its estimates are scored again, and a part of it that nobody could choose is run again."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from surgbench.board.submission import Submission
from surgbench.dataset.base import Dataset
from surgbench.errors import ConfigError, SurgbenchError
from surgbench.files import sha256_text
from surgbench.geometry import FloatArray
from surgbench.registry import find
from surgbench.reproduce.check import beyond_tolerance
from surgbench.reproduce.fingerprint import head
from surgbench.suite.perform import perform
from surgbench.suite.running import Run
from surgbench.suite.settings import Job
from surgbench.task import find_task

# Errors are recorded to a millionth, and of estimates that were rounded.
ABSOLUTE, RELATIVE = 2e-6, 1e-5

Outcome = Literal["fits", "differs", "unknown"]


@dataclass(frozen=True)
class Finding:
    """What came of looking at one run.

    Attributes:
        run: Its row, unit and repeat.
        what: What was done: ``scored again`` or ``run again``.
        outcome: ``unknown`` where it could not be done.
        detail: One line.
    """

    run: str
    what: Literal["scored again", "run again"]
    outcome: Outcome
    detail: str

    @property
    def line(self) -> str:
        """For people."""
        return f"{self.run}: {self.what}: {self.outcome}: {self.detail}"


def rescore(submission: Submission, number: int, datasets: Mapping[str, Dataset[Any]], run: Run) -> Finding:
    """Score the estimates of one record against the truth, and hold the errors against the recorded ones.

    Args:
        submission: It.
        number: Of the record.
        datasets: By the hash of their manifest, those that are here.
        run: Is told how far it is.
    """
    record, content = submission.records[number], submission.content(number)
    what = named(submission, number)
    dataset = datasets.get(record.spec.dataset.sha256)
    if dataset is None:
        return Finding(what, "scored again", "unknown", f"its dataset '{record.spec.dataset.name}' is not here")
    try:
        found = find_task(record.spec.task).rescore(content, dataset, run)
    except ConfigError as error:
        return Finding(what, "scored again", "unknown", str(error))
    except (KeyError, IndexError, ValueError, TypeError, AttributeError) as error:
        # Estimates of a stranger: too few, of another shape, of units that the dataset has not.
        return Finding(what, "scored again", "differs", f"its estimates do not fit the dataset ({error})")
    if not found:
        return Finding(what, "scored again", "unknown", "nothing of it can be scored from its record")
    wrong = differences(content["errors"], found)
    if wrong:
        return Finding(what, "scored again", "differs", "; ".join(wrong[:3]))
    return Finding(what, "scored again", "fits", f"{len(found)} errors of {len(record.frames.index)} frames")


def differences(recorded: Mapping[str, Any], found: Mapping[str, Any]) -> list[str]:
    """One line for each error that is recorded otherwise than it is found; none where all fit."""
    lines = []
    for name, values in found.items():
        before, now = _numbers(recorded.get(name)), _numbers(values)
        if before.shape != now.shape:
            lines.append(f"{name} has {before.size} values, not {now.size}")
            continue
        same = np.isclose(before, now, rtol=RELATIVE, atol=ABSOLUTE, equal_nan=True)
        if not same.all():
            place = tuple(np.argwhere(~same)[0])
            lines.append(
                f"{name} of frame {place[0] if place else 0} is {now[place]:.6g}, not {before[place]:.6g} "
                f"({np.count_nonzero(~same)} values differ)"
            )
    return lines


def choose(submission: Submission, count: int, salt: str = "") -> list[int]:
    """Which records are run again: those whose hash, with the submission's and the salt, is least.

    Args:
        submission: It.
        count: How many.
        salt: What nobody who hands in knows, else they could try until the choice suits them.
    """
    order = sorted(
        range(len(submission.records)),
        key=lambda number: sha256_text(salt + submission.sha256 + submission.records[number].spec_hash),
    )
    return sorted(order[:count])


def run_again(
    submission: Submission,
    number: int,
    datasets: Mapping[str, Dataset[Any]],
    references: Mapping[str, str],
    frames: int,
    run: Run,
) -> Finding:
    """Run the first frames of one record again, and hold its estimates against the recorded ones.

    Args:
        submission: It.
        number: Of the record.
        datasets: By the hash of their manifest, those that are here.
        references: Name of a tracker to where it lies here, for those of ``FILE.py:Class``.
        frames: How many frames at most.
        run: Gives the process, and is told how far it is.
    """
    record, content = submission.records[number], submission.content(number)
    what = named(submission, number)

    def unknown(why: str) -> Finding:
        return Finding(what, "run again", "unknown", why)

    dataset = datasets.get(record.spec.dataset.sha256)
    if dataset is None:
        return unknown(f"its dataset '{record.spec.dataset.name}' is not here")
    name = record.spec.tracker.name
    # What a stranger's record says lies in some file is never run: only what is registered, or was given here.
    own = {kind: content["spec"][kind]["name"] for kind in content["references"] if kind in content["spec"]}
    own |= {"tracker": references.get(name, name)}
    try:
        job: Job = find_task(record.spec.task).recorded_job({**content, "references": own}, dataset)
        source = find("tracker", own["tracker"])
    except (SurgbenchError, KeyError, ValueError, TypeError) as error:
        where = f": {error}" if name in references else f"; where it is: --tracker {name}=FILE.py:Class"
        return unknown(f"tracker '{name}' cannot be run here{where}")
    recorded = record.spec.tracker.source.rpartition("@")[2]
    if source.name != name or source.hash != recorded:
        given = f"; for its own: --tracker {name}=FILE.py:Class" if name not in references else ""
        return unknown(
            f"{references.get(name, 'what is here')} is not the tracker '{name}' that was run (its code is "
            f"{source.hash[:8]}, not {recorded[:8]}){given}"
        )
    if job.settings.unavailable is not None:
        return unknown(job.settings.unavailable)
    count = min(frames, len(record.frames.index))
    done = perform(replace(job, frames=count), dataset, run)
    if done["status"] != "ok":
        return Finding(what, "run again", "differs", f"{done['status']}: {done['error']}")
    sheet = find_task(record.spec.task).sheet
    before, now = head(content, count, sheet), head(done, count, sheet)
    if before["states_sha256"] == now["states_sha256"]:
        return Finding(what, "run again", "fits", f"{count} estimates bit for bit")
    beyond = beyond_tolerance(before, now, sheet.no_difference)
    if beyond:
        lines = [f"mean {error} {later:.4g} instead of {then:.4g}" for error, then, later in beyond]
        return Finding(what, "run again", "differs", "; ".join(lines))
    return Finding(what, "run again", "fits", f"other bits in {count} estimates, errors within tolerance")


def named(submission: Submission, number: int) -> str:
    """Row, unit and repeat of a record."""
    spec = submission.records[number].spec
    return f"{spec.row_id} {spec.unit} r{spec.repeat}"


def incomplete(submission: Submission, datasets: Mapping[str, Dataset[Any]]) -> list[str]:
    """One line for each row that is not about all of its dataset, where that is here."""
    lines = []
    groups: dict[tuple[str, str, str], set[str]] = {}
    for record in submission.records:
        key = (record.spec.row_id, record.settings_hash, record.spec.dataset.sha256)
        groups.setdefault(key, set()).add(record.spec.unit)
    arms: Sequence[Literal["single", "dual"]] = ("single", "dual")
    for (row_id, _, sha256), units in groups.items():
        dataset = datasets.get(sha256)
        whole = [] if dataset is None else [_units(dataset, one) for one in arms]
        if dataset is not None and units not in whole:
            most = max((one for one in whole if units <= one), key=len, default=None)
            of = "units that it has not" if most is None else f"{len(units)} of {len(most)} units"
            lines.append(f"{row_id}: {of} of '{dataset.name}'; a row is about all of them")
    return lines


def _units(dataset: Dataset[Any], arms: Literal["single", "dual"]) -> set[str]:
    try:
        return {unit.id for unit in dataset.units(arms)}
    except SurgbenchError:
        return set()


def _numbers(values: Any) -> FloatArray:
    """Numbers of nested lists, NaN for ``None``; empty for what is no such list."""
    try:
        return np.array([] if values is None else values, dtype=np.float64)
    except (TypeError, ValueError):
        return np.array([])
