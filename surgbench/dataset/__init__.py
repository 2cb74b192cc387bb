"""Datasets on disk: the format, readers, importers and the validator."""

from surgbench.dataset.reader import Dataset, Sequence, Unit

__all__ = ["Dataset", "Sequence", "Unit"]
