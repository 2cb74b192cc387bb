"""What is kept of a sequence's first masks."""

from __future__ import annotations

from surgbench.files import sha256_text
from surgbench.tasks.instrument.dataset import InstrumentDataset
from surgbench.tasks.instrument.format import observed_path


def sequence_head_sha256(dataset: InstrumentDataset, sequence: str, frames: int) -> str:
    """SHA-256 over the hashes of a sequence's first masks, as its manifest has them."""
    kinds = dataset.sequence(sequence).entry.kinds
    paths = [observed_path(sequence, kind, frame) for frame in range(frames) for kind in kinds]
    files = dataset.manifest.files
    return sha256_text("\n".join(files[path].sha256 for path in paths if path in files))
