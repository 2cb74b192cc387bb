"""What a record is, whatever the task: one JSON file per tracker, unit and repeat."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, ClassVar

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator

from surgbench.config import one_line
from surgbench.geometry import FloatArray

RECORD_FORMAT = "surgbench-record-2"
UNSEALED_FORMAT = "surgbench-record-1"  # still read
FORMATS = (UNSEALED_FORMAT, RECORD_FORMAT)
FORMAT_STEM = "surgbench-record-"
DEFAULT = "default"  # the variant of a row whose options nobody has set
SKIPPED = "skipped"  # the status of a run that the machine lacks something for

Number = float | None
# Files that are made of a record are called by these: no place elsewhere, nothing that a terminal takes for an order.
FileName = Annotated[str, Field(pattern=r"^[^./\\\x00-\x1f\x7f-\x9f][^/\\\x00-\x1f\x7f-\x9f]*$")]
# Whatever else a record says is shown in terminals and tables, too.
Said = Annotated[str, AfterValidator(one_line)]


class Part(BaseModel):
    """Base of what a report reads of a record."""

    # Records hold more than a report reckons with (machine, versions, git state): that is shown as it stands.
    model_config = ConfigDict(frozen=True, extra="ignore", arbitrary_types_allowed=True)


class DatasetRef(Part):
    """Which dataset a run was made on."""

    name: FileName
    sha256: str


class Plug(Part):
    """A plug-in, its effective options, and where its code is from, with the hash of that: ``place@hash``."""

    name: Said
    source: Said = ""
    options: dict[str, Any] = {}


class RecordSpec(Part):
    """What was run, whatever the task.

    Attributes:
        engine: Hash of the code besides plug-ins that made it; empty in records of old versions.
    """

    task: Said
    engine: Said = ""
    dataset: DatasetRef
    unit: FileName
    sequence: FileName
    row_id: FileName
    tracker: Plug
    repeat: int
    level: Said | float | None = None


class Frames(Part):
    """Per-frame results; all lists have the same length T, in the order the frames were run."""

    index: list[int] = []

    @model_validator(mode="after")
    def _same_length(self) -> Frames:
        for key in type(self).model_fields:
            found = len(getattr(self, key))
            if found not in (0, len(self.index)):
                raise ValueError(f"'{key}' has {found} entries but 'index' has {len(self.index)}")
        return self


class Record(Part):
    """One run of one tracker on one unit.

    Attributes:
        path: The file it was read from.
        errors: Error name to ``(T,)`` or ``(T, arms)`` values, NaN where a frame has none; a missing truth
            leaves the name out.
        unit_frames: Frames that were asked for.
        dataset_frames: Frames of all units of the dataset; ``None`` in records of old versions.
        floor: The filter knew the truth.
        calibration_ms: What the reference work took beside the run; ``None`` in records of old versions.
        elapsed_s: From the run's beginning to its end; ``None`` in records of old versions.
        hint: One line on what is odd about the data, or what was made of them.
        about: All that the file says besides ``frames``, ``errors`` and ``traceback``: machine, versions, seeds.
        whole: Errors that are not of single frames, but of all of them together.
        error_names: All errors that are written.
    """

    path: Path
    spec_hash: str
    settings_hash: str
    spec: RecordSpec
    variant: Said = ""
    status: Said
    error: Said | None = None
    dataset_path: str | None = None
    unit_frames: int
    dataset_frames: int | None = None
    floor: bool = False
    calibration_ms: Number = None
    elapsed_s: Number = None
    hint: Said | None = None
    about: dict[str, Any] = {}
    frames: Frames
    errors: dict[str, FloatArray]

    whole: ClassVar[tuple[str, ...]] = ()
    error_names: ClassVar[tuple[str, ...]] = ()

    @property
    def processor(self) -> str | None:
        """Model of the processor that it was made on; ``None`` where it does not say."""
        environment = self.about.get("environment")
        machine = environment.get("machine") if isinstance(environment, dict) else None
        found = machine.get("processor") if isinstance(machine, dict) else None
        return one_line(found) if isinstance(found, str) else None

    @model_validator(mode="after")
    def _errors_match(self) -> Record:
        for key, values in self.errors.items():
            if key not in self.whole and len(values) != len(self.frames.index):
                raise ValueError(f"'errors.{key}' has {len(values)} entries but 'index' has {len(self.frames.index)}")
        return self
