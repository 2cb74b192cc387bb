"""Rows made complete, and one run of one of them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar

from surgbench.dataset.base import Unit
from surgbench.files import short_hash
from surgbench.records.format import DEFAULT
from surgbench.suite.asked import Conditions


@dataclass(frozen=True)
class Plug:
    """A plug-in with its effective options, as it stands in a record and is sent to the child process."""

    kind: str
    reference: str
    name: str
    source: str
    options: dict[str, Any]
    changed: dict[str, Any]
    needs_truth: bool
    unavailable: str | None = None

    def spec(self) -> dict[str, Any]:
        """Its part of a record's specification."""
        return {"name": self.name, "options": self.options, "source": self.source}


@dataclass(frozen=True)
class Settings:
    """One row, complete: every option that the results depend on has its value. Each task has its own kind.

    Attributes:
        sequences: How many of the dataset's units are run; ``None`` for all. Which ones are run changes no estimate,
            so that it is no part of the specification: a slice's records are those of the whole.
        frames_limit: How many frames of each unit are run; ``None`` where all units are run to their end.
        engine: Hash of the code besides plug-ins that makes estimates and errors; set by
            :func:`surgbench.suite.plan.complete`.
    """

    row_id: str
    tracker: Plug
    conditions: Conditions
    sequences: int | None
    frames_limit: int | None
    engine: str = field(default="", kw_only=True)

    task: ClassVar[str]

    @property
    def plugs(self) -> tuple[Plug, ...]:
        """All plug-ins of the row."""
        return (self.tracker,)

    @property
    def floor(self) -> bool:
        """Whether something of the row knew the truth."""
        return False

    def spec(self) -> dict[str, Any]:
        """The part of a record's specification that is the same for all units and repeats."""
        spec: dict[str, Any] = {
            "task": self.task,
            "row_id": self.row_id,
            "seed": self.conditions.seed,
            "engine": self.engine,
        }
        spec |= {plug.kind: plug.spec() for plug in self.plugs}
        if self.conditions.device != "cpu":  # so that the hashes of runs without a GPU do not know of GPUs
            spec["device"] = self.conditions.device
        if self.frames_limit is not None:  # likewise for whole units
            spec["frames_limit"] = self.frames_limit
        return spec

    @property
    def references(self) -> dict[str, str]:
        """By what each plug-in was asked for: a name, or a file that may lie elsewhere tomorrow."""
        return {plug.kind: plug.reference for plug in self.plugs}

    @property
    def unavailable(self) -> str | None:
        """Why the row cannot be run on this machine, one line; ``None`` where it can."""
        for plug in self.plugs:
            if plug.unavailable is not None:
                return f"{plug.kind} '{plug.name}' cannot run here: {plug.unavailable}"
        return None

    @property
    def hash(self) -> str:
        """Hash of the settings without dataset, unit and repeat."""
        return short_hash(self.spec())

    @property
    def variant(self) -> str:
        """What differs from the defaults, in a few words."""
        return ", ".join(self.words()) or DEFAULT

    def words(self) -> list[str]:
        """The parts of the variant."""
        words = [f"{key}={value}" for key, value in flat(self.tracker.changed)]
        if self.frames_limit is not None:
            words.append("first frame" if self.frames_limit == 1 else f"first {self.frames_limit} frames")
        if self.conditions.seed:
            words.append(f"seed {self.conditions.seed}")
        return words


@dataclass(frozen=True)
class Job:
    """One run: one tracker with its settings on one unit, one repeat.

    Attributes:
        frames: How many are to be tracked.
        dataset_frames: How many there are in all of the dataset's units.
    """

    settings: Settings
    dataset_name: str
    dataset_sha256: str
    unit: Unit
    frames: int
    dataset_frames: int
    repeat: int

    def spec(self) -> dict[str, Any]:
        """The whole specification: everything that the estimates depend on."""
        return {
            **self.settings.spec(),
            "dataset": {"name": self.dataset_name, "sha256": self.dataset_sha256},
            "unit": self.unit.id,
            "sequence": self.unit.sequence,
            **self.unit.spec(),
            "repeat": self.repeat,
        }

    @property
    def hash(self) -> str:
        """Hash of the specification: two runs with the same one have the same estimates."""
        return short_hash(self.spec())

    @property
    def path(self) -> str:
        """Where its record lies below the output folder."""
        folder = f"{self.dataset_name}-{self.dataset_sha256[:8]}/{self.settings.row_id}-{self.settings.hash[:8]}"
        return f"{folder}/{self.unit.id}-r{self.repeat}.json"


def flat(options: dict[str, Any], prefix: str = "") -> list[tuple[str, Any]]:
    """Nested options as dotted names and values."""
    pairs: list[tuple[str, Any]] = []
    for key, value in options.items():
        if isinstance(value, dict):
            pairs += flat(value, f"{prefix}{key}.")
        else:
            pairs.append((f"{prefix}{key}", value))
    return pairs
