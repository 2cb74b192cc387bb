"""Tables of numbers per frame as Parquet: float64 columns, NaN for what is missing, the same bytes every time."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence

import numpy as np

from surgbench.errors import DatasetError
from surgbench.geometry import FloatArray

FRAME = "frame"
TIMESTAMP = "timestamp_s"


def encode_table(columns: Mapping[str, FloatArray]) -> bytes:
    """The bytes of a Parquet file.

    Args:
        columns: Name to ``(frames,)`` values, in order; a column ``frame`` of 0, 1, ... is put before them.
    """
    import pyarrow as pa
    from pyarrow import parquet

    rows = len(next(iter(columns.values())))
    arrays = {FRAME: pa.array(np.arange(rows, dtype=np.int32))}
    # from_pandas=False keeps NaN a value; a null would read as another kind of missing.
    arrays |= {name: pa.array(np.asarray(values, np.float64), from_pandas=False) for name, values in columns.items()}
    buffer = io.BytesIO()
    parquet.write_table(pa.table(arrays), buffer, compression="zstd", use_dictionary=False)
    return buffer.getvalue()


def decode_table(data: bytes, name: str, rows: int, columns: Sequence[str]) -> dict[str, FloatArray]:
    """Read a Parquet file written by :func:`encode_table`.

    Args:
        data: The whole file.
        name: For the message.
        rows: How many frames it must have.
        columns: The columns it must have, besides ``frame``.

    Returns:
        Column name to ``(rows,)`` float64.

    Raises:
        DatasetError: It is truncated, lacks a column or a frame, or holds something else than numbers.
    """
    import pyarrow as pa
    from pyarrow import parquet

    try:
        # Not `read_table`: even without threads its scanner starts some, which may outlive the call and abort the
        # process at its end (https://github.com/apache/arrow/issues/34314).
        file = parquet.ParquetFile(pa.BufferReader(data), pre_buffer=False)
        for column in (FRAME, *columns):
            if column not in file.schema_arrow.names:
                raise DatasetError(f"{name}: lacks the column '{column}'")
        if file.metadata.num_rows != rows:  # before anything takes memory
            raise DatasetError(f"{name}: has {file.metadata.num_rows} rows; expected one per frame, {rows}")
        table = file.read([FRAME, *columns], use_threads=False)
    except (pa.ArrowException, OSError, ValueError):
        raise DatasetError(f"{name}: truncated or damaged Parquet file") from None
    if table.num_rows != rows:
        raise DatasetError(f"{name}: truncated or damaged Parquet file")
    values: dict[str, FloatArray] = {}
    for column in (FRAME, *columns):
        chunked = table.column(column)
        if chunked.null_count or not (pa.types.is_floating(chunked.type) or pa.types.is_integer(chunked.type)):
            raise DatasetError(f"{name}: column '{column}' must hold numbers (NaN for missing)")
        values[column] = chunked.to_numpy().astype(np.float64)
    if not np.array_equal(values.pop(FRAME), np.arange(rows)):
        raise DatasetError(f"{name}: column 'frame' must count 0, 1, ..., {rows - 1}")
    return values


def stack(values: Mapping[str, FloatArray], columns: Sequence[str]) -> FloatArray:
    """``(rows, len(columns))`` of the named columns."""
    return np.stack([values[column] for column in columns], axis=1)
