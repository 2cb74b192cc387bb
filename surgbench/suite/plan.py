"""What is to be run: rows of settings, checked and complete, times the units of a dataset."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, cast

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from surgbench.dataset.reader import Dataset, Unit
from surgbench.errors import ConfigError, unknown_name
from surgbench.files import canonical_json, sha256_text
from surgbench.registry import NAME_PATTERN, Kind, configure, find

if TYPE_CHECKING:
    from surgbench.dataset.open import AnyDataset
    from surgbench.viewpoint.dataset import TrialUnit, ViewpointDataset

Readings = Literal["none", "noisy", "true"]
Registration = Literal["none", "translation", "rigid"]
Device = Literal["cpu", "cuda"]
HASH_DIGITS = 16
# What a row may ask for on datasets of one task alone.
TASK_FIELDS = {
    "instrument": ("initialiser", "filter", "keypoints", "readings", "view"),
    "viewpoint": ("registration", "missing_face", "photographs_hz"),
}


class Row(BaseModel):
    """One row of a suite, as a file or the command line asks for it.

    Attributes:
        tracker: Registered name or ``FILE.py:Class``.
        row_id: Name in the tables; unless told the tracker's name, with ``-joints`` where it reads joints, and with the
            view where it has one.
        initialiser: ``truth`` where the dataset has it, else ``random``, unless told.
        filter: State filter.
        keypoints: Keypoint source; unless told ``resnet18``, which finds the tips in the mask, but for rows with
            readings on data that holds tips ``observed``.
        readings: Which joint readings the tracker is given.
        view: Auxiliary view that the tracker is given besides the endoscope's.
        registration: Viewpoint task: how touched points correct the camera arm's base.
        missing_face: Viewpoint task: the no-go zone as in the published code, which never tests one of its sides.
        photographs_hz: Viewpoint task: so many stereo pictures a second are rendered, and the feature is found in them.
        options: Plug-in name to its options, for example ``{"cmaes": {"iterations": 5}}``.
        sequences: Only so many units, spread evenly over the dataset's from the first to the last.
        frames: Only the first so many frames of each.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    tracker: str
    row_id: Annotated[str, Field(pattern=f"^{NAME_PATTERN}$")] | None = None
    initialiser: str | None = None
    filter: str = "kalman"
    keypoints: str | None = None
    readings: Readings = "none"
    view: str | None = None
    registration: Registration = "translation"
    missing_face: bool = False
    photographs_hz: Annotated[float, Field(ge=0, le=100, allow_inf_nan=False)] = 0.0
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
    """One row, complete: every option that the results depend on has its value. Each task has its own kind.

    Attributes:
        sequences: How many of the dataset's units are run; ``None`` for all. Which ones are run changes no estimate,
            so that it is no part of the specification: a slice's records are those of the whole.
        frames_limit: How many frames of each unit are run; ``None`` where all units are run to their end.
    """

    row_id: str
    tracker: Plug
    protocol: Protocol
    sequences: int | None
    frames_limit: int | None

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
        spec: dict[str, Any] = {"task": self.task, "row_id": self.row_id, "seed": self.protocol.seed}
        spec |= {plug.kind: plug.spec() for plug in self.plugs}
        if self.protocol.device != "cpu":  # so that the hashes of runs without a GPU do not know of GPUs
            spec["device"] = self.protocol.device
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
        return sha256_text(canonical_json(self.spec()))[:HASH_DIGITS]

    @property
    def variant(self) -> str:
        """What differs from the defaults, in a few words."""
        return ", ".join(self.words()) or "default"

    def words(self) -> list[str]:
        """The parts of the variant."""
        words = [f"{key}={value}" for key, value in flat(self.tracker.changed)]
        if self.frames_limit is not None:
            words.append("first frame" if self.frames_limit == 1 else f"first {self.frames_limit} frames")
        if self.protocol.seed:
            words.append(f"seed {self.protocol.seed}")
        return words


@dataclass(frozen=True)
class InstrumentSettings(Settings):
    """Settings of a row of the instrument task.

    Attributes:
        view: Auxiliary view that the tracker is given besides the endoscope's.
    """

    initialiser: Plug
    filter: Plug
    keypoints: Plug
    readings: Readings
    view: str | None = None

    task: ClassVar[str] = "instrument"

    @property
    def plugs(self) -> tuple[Plug, ...]:
        """All plug-ins of the row."""
        return self.tracker, self.initialiser, self.filter, self.keypoints

    @property
    def floor(self) -> bool:
        """Whether the filter knew the truth."""
        return self.filter.needs_truth

    def spec(self) -> dict[str, Any]:
        """Adds the readings, and the view where there is one besides the endoscope's."""
        spec = {**super().spec(), "readings": self.readings}
        return spec if self.view is None else {**spec, "view": self.view, "views": 2}

    def words(self) -> list[str]:
        """Adds the other plug-ins."""
        words = ["FLOOR, NOT FOR RANKING: every search starts from the truth"] if self.floor else []
        words += super().words()
        if self.readings != "none":
            words.append(f"{self.readings} readings")
        if self.view is not None:
            words.append(f"also the view {self.view}")
        if self.protocol.device != "cpu":
            words.append(f"device {self.protocol.device}")
        usual_keypoints = usual_keypoint_source(self.readings)
        for plug, usual in ((self.filter, "kalman"), (self.keypoints, usual_keypoints), (self.initialiser, "truth")):
            if plug.name != usual or plug.changed:
                changed = ", ".join(f"{key}={value}" for key, value in flat(plug.changed))
                words.append(f"{plug.kind} {plug.name}" + (f" ({changed})" if changed else ""))
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
    unit: Unit | TrialUnit
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
        return sha256_text(canonical_json(self.spec()))[:HASH_DIGITS]

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


def plug(kind: Kind, reference: str, options: dict[str, dict[str, Any]], task: str) -> Plug:
    """A plug-in with its options.

    Raises:
        NotFoundError: No such plug-in.
        ConfigError: A wrong option, or it is for another task.
    """
    found = find(kind, reference)
    if found.task != task and not hasattr(found.cls, "task") and kind == "tracker":
        raise ConfigError(
            f"tracker '{found.name}' is for the {found.task} task, as its class has no 'task'; this dataset is of the "
            f'{task} task, whose controllers have task = "{task}"'
        )
    if found.task != task:
        raise ConfigError(f"{kind} '{found.name}' is for the {found.task} task; this dataset is of the {task} task")
    given = options.get(found.name, {})
    config = configure(found, given)
    effective = {} if config is None else config.model_dump(mode="json")
    # What an option finds out for itself is no change that somebody asked for.
    changed = {} if config is None else config.model_dump(mode="json", exclude_defaults=True, exclude_unset=True)
    needs_truth = bool(getattr(found.cls, "needs_truth", False))
    source = f"{found.source}@{found.hash}"
    return Plug(kind, reference, found.name, source, effective, changed, needs_truth, found.unavailable)


def complete(row: Row, protocol: Protocol, dataset: AnyDataset) -> Settings:
    """Look up everything a row names, check its options, and fill in the defaults.

    Raises:
        NotFoundError: A name that is not registered.
        ConfigError: An option that no plug-in of the row takes, a wrong value, or a device that is not there.
    """
    for task, names in TASK_FIELDS.items():
        for name in names:
            if task != dataset.task and getattr(row, name) != Row.model_fields[name].default:
                raise ConfigError(f"'{name}' is for the {task} task; '{dataset.name}' is of the {dataset.task} task")
    if dataset.task == "instrument":
        settings: Settings = _complete_instrument(row, protocol, cast("Dataset", dataset))
    else:
        from surgbench.viewpoint.plan import complete_viewpoint

        settings = complete_viewpoint(row, protocol, cast("ViewpointDataset", dataset))
    names = tuple(one.name for one in settings.plugs)
    for name in row.options:
        if name not in names:
            raise ConfigError(f"--set {name}.…: '{name}' takes no part in this run (taking part: {', '.join(names)})")
    return settings


def usual_keypoint_source(readings: Readings, has_tips: bool = True) -> str:
    """The keypoint source of rows that name none: without readings only what the mask shows."""
    return "observed" if readings != "none" and has_tips else "resnet18"


def cut(row: Row, lengths: Sequence[int]) -> int | None:
    """The row's limit of frames, where any unit is longer."""
    return row.frames if row.frames is not None and any(row.frames < length for length in lengths) else None


def _complete_instrument(row: Row, protocol: Protocol, dataset: Dataset) -> InstrumentSettings:
    if protocol.device != "cpu":
        from surgbench.silhouette.torch_evaluator import check_device

        check_device(protocol.device)
    has_truth = all(sequence.entry.truth for sequence in dataset.sequences)
    has_readings = all(sequence.entry.readings for sequence in dataset.sequences)
    tracker = plug("tracker", row.tracker, row.options, "instrument")
    initialiser = plug(
        "initialiser", row.initialiser or ("truth" if has_truth else "random"), row.options, "instrument"
    )
    state_filter = plug("filter", row.filter, row.options, "instrument")
    has_tips = all(sequence.entry.keypoints for sequence in dataset.sequences)
    keypoints_name = row.keypoints or usual_keypoint_source(row.readings, has_tips)
    keypoints = plug("keypoints", keypoints_name, row.options, "instrument")
    for one, other in ((initialiser, "random"), (state_filter, "kalman")):
        if one.needs_truth and not has_truth:
            raise ConfigError(
                f"{one.kind} '{one.name}' needs ground truth, which '{dataset.name}' has not; use --{one.kind} {other}"
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
    return InstrumentSettings(
        row_id=row.row_id or f"{tracker.name}{joints}{seen}",
        tracker=tracker,
        protocol=protocol,
        sequences=row.sequences,
        frames_limit=cut(row, [sequence.frames for sequence in dataset.sequences]),
        initialiser=initialiser,
        filter=state_filter,
        keypoints=keypoints,
        readings=row.readings,
        view=row.view,
    )


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


def jobs(settings: Settings, dataset: AnyDataset) -> list[Job]:
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
