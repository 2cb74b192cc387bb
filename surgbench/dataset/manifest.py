"""What ``dataset.json`` says, and where everything lies in a dataset's folder (``docs/dataset.md``)."""

from __future__ import annotations

import json
import re
from pathlib import PurePosixPath
from typing import Annotated, Any, Final, Literal

from pydantic import (
    Field,
    field_validator,
)

from surgbench.config import LONGEST_NAME, Name, Section
from surgbench.files import canonical_json

FORMAT: Final = "surgbench-dataset-1"
MANIFEST_NAME = "dataset.json"
# Holds the effective configuration while a dataset is being written; gone when it is complete.
MARKER_NAME = "generating.json"


UNITS = {
    "length": "metre",
    "angle": "radian",
    "time": "second",
    "image": "pixel",
}
VISIBILITY = {
    "tracker": ["dataset.json", "instruments/**", "sequences/**"],
    "truth": ["truth/**"],
}


# Frames of a sequence: more than four days of video.
Frames = Annotated[int, Field(gt=0, le=10_000_000)]


class FileEntry(Section):
    """One file of the dataset."""

    bytes: Annotated[int, Field(ge=0)]
    sha256: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]


class Manifest(Section):
    """What ``dataset.json`` says whatever the task.

    Attributes:
        format: Version of the layout.
        task: What trackers do on it.
        name: The preset's or recording's name.
        created_by: Program and version.
        origin: Generated here, or imported from a recording.
        seed: Of everything random in it; ``None`` for a recording.
        configuration: The whole effective configuration: the preset after all options, or the import's options.
        units: Text.
        conventions: Text.
        visibility: Which files a tracker may be shown, and which hold the truth.
        files: Path to size and SHA-256, every file but ``dataset.json``.
    """

    format: Literal["surgbench-dataset-1"] = FORMAT
    task: str
    name: Name
    created_by: str
    origin: Literal["generated", "imported"]
    seed: int | None = None
    configuration: dict[str, Any]
    units: dict[str, str] = UNITS
    conventions: dict[str, str]
    visibility: dict[str, list[str]] = VISIBILITY
    files: dict[str, FileEntry]

    @field_validator("files")
    @classmethod
    def _inside(cls, files: dict[str, FileEntry]) -> dict[str, FileEntry]:
        for path in files:
            pure = PurePosixPath(path)
            if pure.is_absolute() or ".." in pure.parts or str(pure) != path:
                raise ValueError(f"'{path}' is not a path inside the dataset")
        return files

    @property
    def counts(self) -> str:
        """How much there is, a few words."""
        raise NotImplementedError

    def to_bytes(self) -> bytes:
        """The bytes of ``dataset.json``: sorted keys, a line for each file, so that it can be read and diffed."""
        data = self.model_dump(mode="json")
        files = data.pop("files")
        head = json.dumps(data, indent=1, sort_keys=True, allow_nan=False)
        rows = ",\n".join(f"  {json.dumps(path)}: {canonical_json(files[path])}" for path in sorted(files))
        return f'{head[:-2]},\n "files": {{\n{rows}\n }}\n}}\n'.encode()


def dataset_name(text: str) -> str:
    """A name of a dataset, or of a part of one, from any text: what cannot stand in it is replaced."""
    return re.sub(r"[^A-Za-z0-9_.-]", "-", text).lstrip("-_.")[:LONGEST_NAME] or "recording"


def observations_path(sequence: str) -> str:
    """Where a sequence's keypoints, readings and timestamps lie."""
    return f"sequences/{sequence}/observations.parquet"
