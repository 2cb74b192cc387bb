"""Croissant 1.0: what a dataset holds, as JSON-LD that catalogues and loaders read."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path, PurePosixPath
from typing import Annotated, Any, ClassVar

from pydantic import Field

from surgbench.config import Section
from surgbench.contract import Plugin
from surgbench.dataset.integrity import METADATA_NAME
from surgbench.dataset.manifest import MANIFEST_NAME, observations_path
from surgbench.dataset.storage import file_entry
from surgbench.dataset.tables import FRAME, TIMESTAMP
from surgbench.errors import ConfigError, DatasetError
from surgbench.exporting import Material
from surgbench.tasks.instrument.auxiliary import auxiliary_columns, pose_columns
from surgbench.tasks.instrument.dataset import (
    InstrumentDataset,
    Sequence,
    labelled_columns,
    observation_columns,
    state_columns,
    visibility_columns,
)
from surgbench.tasks.instrument.format import (
    IMAGE_KIND,
    clean_mask_path,
    labels_path,
    observed_path,
    poses_path,
    states_path,
    view_folder,
    visibility_path,
)
from surgbench.tasks.viewpoint.dataset import ViewpointDataset
from surgbench.tasks.viewpoint.format import CONTACT, FEATURE_COLUMNS, feature_path, scene_path

CONFORMS_TO = "http://mlcommons.org/croissant/1.0"
# Terms of the standard, as it lists them.
CONTEXT = {
    "@language": "en",
    "@vocab": "https://schema.org/",
    "sc": "https://schema.org/",
    "cr": "http://mlcommons.org/croissant/",
    "dct": "http://purl.org/dc/terms/",
    "conformsTo": "dct:conformsTo",
    "data": {"@id": "cr:data", "@type": "@json"},
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    "examples": {"@id": "cr:examples", "@type": "@json"},
    **{
        term: f"cr:{term}"
        for term in (
            "citeAs", "column", "extract", "field", "fileObject", "fileProperty", "fileSet", "format", "includes",
            "isLiveDataset", "jsonPath", "key", "md5", "parentField", "path", "recordSet", "references", "regex",
            "repeated", "replace", "separator", "source", "subField", "transform",
        )
    },
}  # fmt: skip
Described = InstrumentDataset | ViewpointDataset
UNITS = {"m": "metres", "rad": "radians", "px": "pixels", "s": "seconds"}


class CroissantExporter(Plugin):
    """``croissant.json``, which belongs into the dataset's folder, or tells where it is published."""

    name: ClassVar[str] = "croissant"
    summary: ClassVar[str] = "Croissant metadata of a dataset, to be put beside its dataset.json"

    class Config(Section):
        """Options: what a dataset does not know of itself."""

        url: Annotated[str | None, Field(description="Where the dataset's folder is published.")] = None
        license: Annotated[str | None, Field(description="The address of its licence.")] = None
        creator: Annotated[str | None, Field(description="Who made it.")] = None
        published: Annotated[str | None, Field(description="Date of publication, as 2026-01-31.")] = None
        version: Annotated[str, Field(description="Of the dataset.")] = "1.0.0"
        cite: Annotated[str | None, Field(description="How to cite it, BibTeX for example.")] = None

    def __init__(self, config: Config | None = None) -> None:
        self.config = config or self.Config()

    def count(self, material: Material) -> int:
        """Sequences: their frames are not looked at."""
        return len(_ids(self._dataset(material)))

    def write(self, material: Material, folder: Path, progress: Callable[[float], None]) -> None:
        """Write the metadata."""
        dataset = self._dataset(material)
        content = json.dumps(self._metadata(dataset), indent=1, ensure_ascii=False)
        (folder / METADATA_NAME).write_text(content + "\n", encoding="utf-8")
        progress(len(_ids(dataset)))

    @staticmethod
    def _dataset(material: Material) -> Described:
        dataset = material.dataset
        if dataset is None:
            raise ConfigError("--format croissant describes datasets; for runs choose csv, tum, bop or coco")
        if not isinstance(dataset, (InstrumentDataset, ViewpointDataset)):
            raise DatasetError(f"{dataset.path}: what a dataset of the {dataset.task} task holds is not known here")
        return dataset

    def _metadata(self, dataset: Described) -> dict[str, Any]:
        own = self.config
        told = {
            "url": own.url,
            "license": own.license,
            "creator": None if own.creator is None else {"@type": "Person", "name": own.creator},
            "datePublished": own.published,
            "citeAs": own.cite,
        }
        sets, records = self._tables(dataset)
        return {
            "@context": CONTEXT,
            "@type": "sc:Dataset",
            "conformsTo": CONFORMS_TO,
            "name": dataset.name,
            "description": (
                f"{_subject(dataset)}, {dataset.manifest.origin}: {_contents(dataset)}; "
                f"{dataset.manifest.counts}. " + " ".join(f"{k}: {v}." for k, v in dataset.manifest.conventions.items())
            ),
            "version": own.version,
            **{key: value for key, value in told.items() if value is not None},
            "distribution": [self._manifest(dataset), *sets, *_pictures(dataset)],
            "recordSet": records,
        }

    def _manifest(self, dataset: Described) -> dict[str, Any]:
        """The file that holds the hash of every other."""
        entry = file_entry((dataset.path / MANIFEST_NAME).read_bytes())
        base = "" if self.config.url is None else self.config.url.rstrip("/") + "/"
        return {
            "@type": "cr:FileObject",
            "@id": MANIFEST_NAME,
            "name": MANIFEST_NAME,
            "description": "Cameras, instruments, sequences, and the SHA-256 of every other file.",
            "contentUrl": f"{base}{MANIFEST_NAME}",
            "contentSize": f"{entry.bytes} B",
            "encodingFormat": "application/json",
            "sha256": entry.sha256,
        }

    def _tables(self, dataset: Described) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
        """A set of files and its records for all tables with the same columns."""
        groups: dict[tuple[str, ...], list[str]] = {}
        for name, path, columns in _all_tables(dataset):
            groups.setdefault((name, *columns), []).append(path)
        sets, records = [], []
        names: list[str] = []
        for (kind, *columns), paths in groups.items():
            name = kind if kind not in names else f"{kind}-{names.count(kind) + 1}"
            names.append(kind)
            files = f"{name}-files"
            sets.append(_file_set(files, paths, "application/x-parquet", f"Tables of {kind}, one per sequence."))
            fields = [_field(name, files, column) for column in (FRAME, *columns)]
            records.append(
                {
                    "@type": "cr:RecordSet",
                    "@id": name,
                    "name": name,
                    "description": f"A row per frame: {kind}; the sequences one after the other.",
                    "field": fields,
                }
            )
        return sets, records


def _ids(dataset: Described) -> list[str]:
    """Of its sequences, or trials."""
    parts: Any = dataset.sequences if isinstance(dataset, InstrumentDataset) else dataset.trials
    return [part.id for part in parts]


def _subject(dataset: Described) -> str:
    return "Surgical instruments" if isinstance(dataset, InstrumentDataset) else "What a camera should follow"


def _all_tables(dataset: Described) -> Iterator[tuple[str, str, list[str]]]:
    """What each table is about, where it lies, and its columns besides the frame."""
    if isinstance(dataset, InstrumentDataset):
        for sequence in dataset.sequences:
            yield from _tables_of(sequence)
        return
    for trial in dataset.manifest.trials:
        yield "observations", observations_path(trial.id), [TIMESTAMP, *FEATURE_COLUMNS]
        if trial.truth:
            yield "feature", feature_path(trial.id), [*FEATURE_COLUMNS, CONTACT]


def _tables_of(sequence: Sequence) -> list[tuple[str, str, list[str]]]:
    entry = sequence.entry
    tables = [("observations", observations_path(entry.id), observation_columns(entry))]
    if entry.truth:
        tables.append(("states", states_path(entry.id), state_columns(entry)))
    if entry.visibility:
        tables.append(("visibility", visibility_path(entry.id), visibility_columns(entry)))
    if entry.labels:
        tables.append(("labels", labels_path(entry.id), labelled_columns(entry)))
    for name, view in entry.auxiliary.items():
        folder = view_folder(entry.id, name)
        tables.append((f"view-{name}", observations_path(folder), auxiliary_columns(view)))
        if entry.truth:
            tables.append((f"view-{name}-poses", poses_path(folder), pose_columns(view)))
    return tables


def _pictures(dataset: Described) -> list[dict[str, Any]]:
    """Sets of the masks of each kind, observed and clean, of each view, and of the camera's pictures; else of scenes.

    Sequences are named one by one: a star that crosses folders would find the views' masks among the camera's own.
    """
    if isinstance(dataset, ViewpointDataset):
        scenes = [scene_path(trial.id) for trial in dataset.manifest.trials if trial.truth]
        return [_file_set("scenes", scenes, "application/json", "The wire, and the arm's base.")] if scenes else []
    sets: dict[str, tuple[str, list[str]]] = {}

    def add(name: str, description: str, place: str) -> None:
        sets.setdefault(name, (description, []))[1].append(str(PurePosixPath(place).with_name("*.png")))

    for entry in (sequence.entry for sequence in dataset.sequences):
        views = [("", entry.id, entry.kinds)]
        views += [(f"view-{name}-", view_folder(entry.id, name), view.kinds) for name, view in entry.auxiliary.items()]
        for prefix, folder, kinds in views:
            for kind in kinds:
                add(f"{prefix}masks-{kind}", "Observed masks.", observed_path(folder, kind, 0))
                if entry.truth:
                    place = clean_mask_path(folder, kind, 0)
                    add(f"{prefix}true-masks-{kind}", "Masks before corruption.", place)
        if entry.images:
            add("images", "Pictures.", observed_path(entry.id, IMAGE_KIND, 0))
    return [_file_set(name, includes, "image/png", description) for name, (description, includes) in sets.items()]


def _contents(dataset: Described) -> str:
    """What a dataset has, in a few words."""
    if isinstance(dataset, ViewpointDataset):
        truth = any(trial.truth for trial in dataset.manifest.trials)
        return f"measured poses over time, touched points, zones{', true poses and wires' if truth else ''}"
    entries = [sequence.entry for sequence in dataset.sequences]
    there = {
        "masks": any(entry.kinds for entry in entries),
        "pictures": any(entry.images for entry in entries),
        "marked points": any(entry.labels for entry in entries),
        "tips": any(entry.keypoints for entry in entries),
        "joint readings": any(entry.readings or entry.arm_joints for entry in entries),
        "true poses and joints": any(entry.truth for entry in entries),
        "auxiliary views": any(entry.auxiliary for entry in entries),
    }
    return ", ".join(word for word, has in there.items() if has)


def _file_set(name: str, includes: list[str], encoding: str, description: str) -> dict[str, Any]:
    return {
        "@type": "cr:FileSet",
        "@id": name,
        "name": name,
        "description": description,
        "encodingFormat": encoding,
        "includes": includes,
    }


def _field(records: str, files: str, column: str) -> dict[str, Any]:
    unit = UNITS.get(column.rpartition("_")[2], "number")
    return {
        "@type": "cr:Field",
        "@id": f"{records}/{column}",
        "name": f"{records}/{column}",
        "description": "Frame number, from 0." if column == FRAME else f"{column}, {unit}; NaN: missing.",
        "dataType": "sc:Integer" if column == FRAME else "sc:Float",
        "source": {"fileSet": {"@id": files}, "extract": {"column": column}},
    }
