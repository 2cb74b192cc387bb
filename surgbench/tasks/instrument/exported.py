"""What exporters of this task ask of what they are given."""

from __future__ import annotations

from surgbench.errors import DatasetError
from surgbench.exporting import Material
from surgbench.tasks.instrument.dataset import InstrumentDataset
from surgbench.tasks.instrument.records import InstrumentRecord
from surgbench.tasks.instrument.tracks import Row, rows_of


def dataset_of(material: Material) -> InstrumentDataset | None:
    """The dataset that is to be exported; ``None`` where it is estimates.

    Raises:
        DatasetError: It is of another task.
    """
    dataset = material.dataset
    if dataset is not None and not isinstance(dataset, InstrumentDataset):
        raise DatasetError(f"{dataset.path}: a dataset of the {dataset.task} task; has no instruments")
    return dataset


def rows_in(material: Material) -> list[Row]:
    """The rows whose estimates are to be exported.

    Raises:
        DatasetError: A run is of another task, or its dataset is not there.
    """
    records = []
    for record in material.records:
        if not isinstance(record, InstrumentRecord):
            raise DatasetError(f"{record.path}: a record of the {record.spec.task} task; has no instruments")
        records.append(record)
    return rows_of(records, material.moved)


def frames_in(material: Material) -> int:
    """Frames of a dataset, or of all its runs, each arm once."""
    dataset = dataset_of(material)
    if dataset is not None:
        return sum(sequence.frames * len(sequence.arms) for sequence in dataset.sequences)
    return sum(len(record.frames.index) * len(record.spec.arms) for row in rows_in(material) for record in row.records)


def with_truth(dataset: InstrumentDataset, name: str) -> InstrumentDataset:
    """A dataset that has true states.

    Args:
        dataset: Any.
        name: Of the format, for the message.

    Raises:
        DatasetError: It has none; one line that says what can be exported instead.
    """
    if not any(sequence.entry.truth for sequence in dataset.sequences):
        raise DatasetError(
            f"{dataset.path}: has no true poses, which {name} is about; export what a tracker estimated "
            "(surgbench export RUNS), or what was observed with --format csv or coco"
        )
    return dataset
