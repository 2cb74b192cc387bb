"""Croissant 1.0: what a dataset holds, as JSON-LD that catalogues and loaders read."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, ClassVar

from pydantic import Field

from surgbench.config import Section
from surgbench.contract import Plugin
from surgbench.dataset.integrity import METADATA_NAME
from surgbench.dataset.manifest import MANIFEST_NAME, observations_path
from surgbench.dataset.storage import file_entry
from surgbench.dataset.tables import FRAME
from surgbench.errors import ConfigError
from surgbench.exporting import Material
from surgbench.tasks.instrument.dataset import (
    InstrumentDataset,
    Sequence,
    observation_columns,
    state_columns,
    visibility_columns,
)
from surgbench.tasks.instrument.exported import dataset_of
from surgbench.tasks.instrument.format import IMAGE_KIND, states_path, visibility_path

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
        return len(self._dataset(material).sequences)

    def write(self, material: Material, folder: Path, progress: Callable[[float], None]) -> None:
        """Write the metadata."""
        dataset = self._dataset(material)
        content = json.dumps(self._metadata(dataset), indent=1, ensure_ascii=False)
        (folder / METADATA_NAME).write_text(content + "\n", encoding="utf-8")
        progress(len(dataset.sequences))

    @staticmethod
    def _dataset(material: Material) -> InstrumentDataset:
        dataset = dataset_of(material)
        if dataset is None:
            raise ConfigError("--format croissant describes datasets; for runs choose csv, tum, bop or coco")
        return dataset

    def _metadata(self, dataset: InstrumentDataset) -> dict[str, Any]:
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
                f"Masks of surgical instruments and their poses and joints, {dataset.manifest.origin}: "
                f"{dataset.manifest.counts}. " + " ".join(f"{k}: {v}." for k, v in dataset.manifest.conventions.items())
            ),
            "version": own.version,
            **{key: value for key, value in told.items() if value is not None},
            "distribution": [self._manifest(dataset), *sets, *_pictures(dataset)],
            "recordSet": records,
        }

    def _manifest(self, dataset: InstrumentDataset) -> dict[str, Any]:
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

    def _tables(self, dataset: InstrumentDataset) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
        """A set of files and its records for all tables with the same columns."""
        groups: dict[tuple[str, ...], list[str]] = {}
        for sequence in dataset.sequences:
            for name, path, columns in _tables_of(sequence):
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


def _tables_of(sequence: Sequence) -> list[tuple[str, str, list[str]]]:
    tables = [("observations", observations_path(sequence.id), observation_columns(sequence.entry))]
    if sequence.entry.truth:
        tables.append(("states", states_path(sequence.id), state_columns(sequence.entry)))
    if sequence.entry.visibility:
        tables.append(("visibility", visibility_path(sequence.id), visibility_columns(sequence.entry)))
    return tables


def _pictures(dataset: InstrumentDataset) -> list[dict[str, Any]]:
    """Sets of the masks of each kind, observed and clean, and of the camera's pictures."""
    entries = [sequence.entry for sequence in dataset.sequences]
    sets = []
    for kind in dict.fromkeys(kind for entry in entries for kind in entry.kinds):
        sets.append(_file_set(f"masks-{kind}", [f"sequences/*/observed/{kind}/*.png"], "image/png", "Observed masks."))
        if any(entry.truth and kind in entry.kinds for entry in entries):
            name, words = f"true-masks-{kind}", "Masks before corruption."
            sets.append(_file_set(name, [f"truth/*/masks/{kind}/*.png"], "image/png", words))
    if any(entry.images for entry in entries):
        sets.append(_file_set("images", [f"sequences/*/observed/{IMAGE_KIND}/*.png"], "image/png", "Pictures."))
    return sets


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
