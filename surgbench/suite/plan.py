"""What is to be run: rows of settings, checked and complete, times the units of a dataset."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from surgbench.dataset.reader import Dataset, Unit
from surgbench.errors import ConfigError, unknown_name
from surgbench.files import canonical_json, sha256_text
from surgbench.registry import NAME_PATTERN, Kind, configure, find

Readings = Literal["none", "noisy", "true"]
Device = Literal["cpu", "cuda"]
HASH_DIGITS = 16


class Row(BaseModel):
    """One row of a suite, as a file or the command line asks for it.

    Attributes:
        tracker: Registered name or ``FILE.py:Class``.
        row_id: Name in the tables; unless told the tracker's name, with ``-joints`` where it reads joints, and with the
            view where it has one.
        initialiser: ``truth`` where the dataset has it, else ``random``, unless told.
        filter: State filter.
        keypoints: Keypoint source.
        readings: Which joint readings the tracker is given.
        view: Auxiliary view that the tracker is given besides the endoscope's.
        options: Plug-in name to its options, for example ``{"cmaes": {"iterations": 5}}``.
        sequences: Only so many units, spread evenly over the dataset's from the first to the last.
        frames: Only the first so many frames of each.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    tracker: str
    row_id: Annotated[str, Field(pattern=f"^{NAME_PATTERN}$")] | None = None
    initialiser: str | None = None
    filter: str = "kalman"
    keypoints: str = "observed"
    readings: Readings = "none"
    view: str | None = None
    options: dict[str, dict[str, Any]] = {}
    sequences: Annotated[int, Field(ge=1)] | None = None
    frames: Annotated[int, Field(ge=1)] | None = None


class Protocol(BaseModel):
    """What all rows of a run share."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    arms: Literal["single", "dual"] = "single"
    seed: Annotated[int, Field(ge=0)] = 0
    repeats: Annotated[int, Field(ge=1)] = 1
    timeout_s: Annotated[float, Field(gt=0)] = 120.0
    device: Device = "cpu"


class Suite(Protocol):
    """A suite file: rows and what they share."""

    rows: Annotated[tuple[Row, ...], Field(min_length=1)]


@dataclass(frozen=True)
class Plug:
    """A plug-in with its effective options, as it stands in a record and is sent to the child process."""

    kind: Kind
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
    """One row, complete: every option that the estimates depend on has its value.

    Attributes:
        sequences: How many of the dataset's units are run; ``None`` for all. Which ones are run changes no estimate,
            so that it is no part of the specification: a slice's records are those of the whole.
        frames_limit: How many frames of each unit are run; ``None`` where all units are run to their end.
        view: The auxiliary view, if there is one.
    """

    row_id: str
    tracker: Plug
    initialiser: Plug
    filter: Plug
    keypoints: Plug
    readings: Readings
    protocol: Protocol
    sequences: int | None = None
    frames_limit: int | None = None
    view: str | None = None

    def spec(self) -> dict[str, Any]:
        """The part of a record's specification that is the same for all units and repeats."""
        spec: dict[str, Any] = {
            "task": "instrument",
            "row_id": self.row_id,
            "tracker": self.tracker.spec(),
            "initialiser": self.initialiser.spec(),
            "filter": self.filter.spec(),
            "keypoints": self.keypoints.spec(),
            "readings": self.readings,
            "seed": self.protocol.seed,
        }
        if self.protocol.device != "cpu":  # so that the hashes of runs without a GPU do not know of GPUs
            spec["device"] = self.protocol.device
        if self.frames_limit is not None:  # likewise for whole units
            spec["frames_limit"] = self.frames_limit
        if self.view is not None:  # likewise for one view
            spec |= {"view": self.view, "views": 2}
        return spec

    @property
    def plugs(self) -> tuple[Plug, ...]:
        """All plug-ins of the row."""
        return self.tracker, self.initialiser, self.filter, self.keypoints

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
        return sha256_text(canonical_json(self.spec()))[:HASH_DIGITS]

    @property
    def variant(self) -> str:
        """What differs from the defaults, in a few words."""
        words = ["FLOOR, NOT FOR RANKING: every search starts from the truth"] if self.filter.needs_truth else []
        words += [f"{key}={value}" for key, value in _flat(self.tracker.changed)]
        if self.frames_limit is not None:
            words.append("first frame" if self.frames_limit == 1 else f"first {self.frames_limit} frames")
        if self.protocol.seed:
            words.append(f"seed {self.protocol.seed}")
        if self.readings != "none":
            words.append(f"{self.readings} readings")
        if self.view is not None:
            words.append(f"also the view {self.view}")
        if self.protocol.device != "cpu":
            words.append(f"device {self.protocol.device}")
        for plug, usual in ((self.filter, "kalman"), (self.keypoints, "observed"), (self.initialiser, "truth")):
            if plug.name != usual or plug.changed:
                changed = ", ".join(f"{key}={value}" for key, value in _flat(plug.changed))
                words.append(f"{plug.kind} {plug.name}" + (f" ({changed})" if changed else ""))
        return ", ".join(words) or "default"


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
            "arms": list(self.unit.arms),
            "mask_kind": self.unit.kind,
            "repeat": self.repeat,
        }

    @property
    def hash(self) -> str:
        """Hash of the specification: two runs with the same one have the same estimates."""
        return sha256_text(canonical_json(self.spec()))[:HASH_DIGITS]

    @property
    def path(self) -> str:
        """Where its record lies below the output folder."""
        folder = f"{self.dataset_name}-{self.dataset_sha256[:8]}/{self.settings.row_id}-{self.settings.hash[:8]}"
        return f"{folder}/{self.unit.id}-r{self.repeat}.json"


def _flat(options: dict[str, Any], prefix: str = "") -> list[tuple[str, Any]]:
    pairs: list[tuple[str, Any]] = []
    for key, value in options.items():
        if isinstance(value, dict):
            pairs += _flat(value, f"{prefix}{key}.")
        else:
            pairs.append((f"{prefix}{key}", value))
    return pairs


def _plug(kind: Kind, reference: str, options: dict[str, dict[str, Any]]) -> Plug:
    found = find(kind, reference)
    given = options.get(found.name, {})
    config = configure(found, given)
    effective = {} if config is None else config.model_dump(mode="json")
    changed = {} if config is None else config.model_dump(mode="json", exclude_defaults=True)
    needs_truth = bool(getattr(found.cls, "needs_truth", False))
    source = f"{found.source}@{found.hash}"
    return Plug(kind, reference, found.name, source, effective, changed, needs_truth, found.unavailable)


def complete(row: Row, protocol: Protocol, dataset: Dataset) -> Settings:
    """Look up everything a row names, check its options, and fill in the defaults.

    Raises:
        NotFoundError: A name that is not registered.
        ConfigError: An option that no plug-in of the row takes, a wrong value, or a device that is not there.
    """
    if protocol.device != "cpu":
        from surgbench.silhouette.torch_evaluator import check_device

        check_device(protocol.device)
    has_truth = all(sequence.entry.truth for sequence in dataset.sequences)
    has_readings = all(sequence.entry.readings for sequence in dataset.sequences)
    tracker = _plug("tracker", row.tracker, row.options)
    initialiser = _plug("initialiser", row.initialiser or ("truth" if has_truth else "random"), row.options)
    state_filter = _plug("filter", row.filter, row.options)
    keypoints = _plug("keypoints", row.keypoints, row.options)
    names = [plug.name for plug in (tracker, initialiser, state_filter, keypoints)]
    for name in row.options:
        if name not in names:
            raise ConfigError(f"--set {name}.…: '{name}' takes no part in this run (taking part: {', '.join(names)})")
    for plug, other in ((initialiser, "random"), (state_filter, "kalman")):
        if plug.needs_truth and not has_truth:
            raise ConfigError(
                f"{plug.kind} '{plug.name}' needs ground truth, which '{dataset.name}' has not; "
                f"use --{plug.kind} {other}"
            )
    if row.readings == "true" and not has_truth:
        raise ConfigError(f"--readings true needs ground truth, which '{dataset.name}' has not; use --joints")
    if row.readings == "noisy" and not has_readings:
        raise ConfigError(f"'{dataset.name}' has no joint readings; use --no-joints")
    if row.view is not None:
        _check_view(row.view, protocol.arms, dataset)
        if getattr(find("tracker", row.tracker).cls, "one_view", False):
            raise ConfigError(f"--view {row.view}: tracker '{tracker.name}' looks at one view alone")
    joints, seen = "-joints" if row.readings != "none" else "", "" if row.view is None else f"-{row.view}"
    row_id = row.row_id or f"{tracker.name}{joints}{seen}"
    cut = row.frames is not None and any(row.frames < sequence.frames for sequence in dataset.sequences)
    plugs = (tracker, initialiser, state_filter, keypoints)
    return Settings(row_id, *plugs, row.readings, protocol, row.sequences, row.frames if cut else None, row.view)


def _check_view(view: str, arms: str, dataset: Dataset) -> None:
    """See that every sequence has an auxiliary view, of one arm alone or of both."""
    for sequence in dataset.sequences:
        there = sequence.entry.auxiliary
        if not there:
            raise ConfigError(f"--view {view}: '{dataset.name}' has no auxiliary views")
        if view not in there:
            raise ConfigError(f"--view {view}: {unknown_name('auxiliary view', view, there)}")
        if arms == "dual" and "both" not in there[view].kinds:
            raise ConfigError(f"--view {view}: shows each arm alone; use --arms single")


def spread(total: int, count: int | None) -> list[int]:
    """``count`` of ``total`` places, evenly from the first to the last; all where there are fewer, or for ``None``.

    On a dataset that ends with its fast sequences, and whose arms alternate, that takes some of each.
    """
    return sorted({round(place) for place in np.linspace(0, total - 1, min(count or total, total))})


def jobs(settings: Settings, dataset: Dataset) -> list[Job]:
    """One job per unit of the row's slice and repeat, in the dataset's order.

    Raises:
        DatasetError: The dataset has nothing to run with this number of arms.
    """
    units = dataset.units(settings.protocol.arms)
    lengths = [dataset.sequence(unit.sequence).frames for unit in units]
    return [
        Job(
            settings,
            dataset.name,
            dataset.hash,
            units[place],
            min(lengths[place], settings.frames_limit or lengths[place]),
            sum(lengths),
            repeat,
        )
        for place in spread(len(units), settings.sequences)
        for repeat in range(settings.protocol.repeats)
    ]
