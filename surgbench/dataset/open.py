"""Opening a dataset of whichever task it is."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

from surgbench.dataset.format import Manifest, read_manifest
from surgbench.dataset.reader import Dataset

if TYPE_CHECKING:
    from surgbench.viewpoint.dataset import ViewpointDataset


AnyDataset: TypeAlias = "Dataset | ViewpointDataset"


def open_dataset(path: Path | str) -> AnyDataset:
    """Open a dataset's folder; only the manifest is read.

    Raises:
        DatasetError: There is no complete dataset here, or its manifest is wrong; one line.
    """
    folder = Path(path)
    manifest, data = read_manifest(folder)
    hash_ = hashlib.sha256(data).hexdigest()
    if isinstance(manifest, Manifest):
        return Dataset(folder, manifest, hash_)
    from surgbench.viewpoint.dataset import ViewpointDataset

    return ViewpointDataset(folder, manifest, hash_)
