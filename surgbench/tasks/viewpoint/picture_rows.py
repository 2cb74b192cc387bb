"""Rows and columns of the pictures: where the feature was in them, and whether it was seen."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from surgbench.geometry import FloatArray
from surgbench.report.bootstrap import mean_interval
from surgbench.report.field import Field, number
from surgbench.report.losses import Losses, loss_row, losses
from surgbench.report.row import Row
from surgbench.tasks.viewpoint.records import ViewpointRecord
from surgbench.viewpoint.optics.centroids import ERRORS, centroid_table, visibility
from surgbench.viewpoint.optics.stereo import AUTOCAM_STEREO
from surgbench.viewpoint.optics.visibility import SEEN_SHARE

WHICH = ("left", "right", "any", "both")
SEEN = tuple(f"visibility_{which}_percent" for which in WHICH)
SOURCES = ("projected_px", "tags_px")


def picture_fields() -> tuple[Field, ...]:
    """Columns of visibility, their intervals over trials, and of what is in the pictures, covered or not."""
    return number(
        *(f"{key}{end}" for key in SEEN for end in ("", "_low", "_high")),
        *(f"framed_{which}_percent" for which in WHICH),
    )


def found_pixels(record: ViewpointRecord, source: str) -> FloatArray:
    """``(n, 2, 2)`` pixels of the feature in the left and the right picture, NaN where it was not seen.

    Args:
        record: Its steps.
        source: ``tags_px``: of the steps with pictures, where a tag was found. ``projected_px``: of all steps, where
            the ring's centre is in the picture and enough of the ring is seen (:data:`SEEN_SHARE`).
    """
    rows = [row for row in getattr(record.frames, source) if row is not None]
    pixels = np.array(rows, dtype=np.float64).reshape(-1, 2, 2)
    if source == "projected_px" and record.frames.ring_seen:
        pixels = np.where((_shares(record) >= SEEN_SHARE)[..., None], pixels, np.nan)
    return pixels


def seen_percent(record: ViewpointRecord) -> Row:
    """A run's visibility by geometry; empty columns where its record does not say."""
    return _percent(_seen(record, "projected_px"))


def visibility_row(records: Sequence[ViewpointRecord], source: str) -> Row:
    """Visibility of runs by one source, with intervals over trials.

    By tags, the feature is seen where one is found, as the authors have it. By geometry, where enough of the ring is in
    the picture and covered by nothing that holds it.
    """
    trials: dict[str, list[FloatArray]] = {}
    for record in records:
        trials.setdefault(record.spec.unit, []).append(_seen(record, source))
    of_trials = [seen for seen in map(np.concatenate, trials.values()) if len(seen)]
    row = _percent(np.concatenate([*of_trials, np.empty((0, 2), dtype=bool)]))
    shares, counts = [_percent(seen) for seen in of_trials], [len(seen) for seen in of_trials]
    for key in SEEN:
        interval = mean_interval([share[key] for share in shares], counts)
        row[f"{key}_low"], row[f"{key}_high"] = (None, None) if interval is None else interval
    return row


def lost_row(records: Sequence[ViewpointRecord]) -> Row:
    """From when neither camera sees the feature to when one sees it again."""
    trials: dict[str, list[Losses]] = {}
    for record in records:
        unseen = ~_seen(record, "projected_px").any(axis=1)
        trials.setdefault(record.spec.unit, []).append(losses(unseen, 0.5, 0.5))
    return loss_row(trials.values())


def framed_row(records: Sequence[ViewpointRecord]) -> Row:
    """How often the ring's centre was in the pictures, whatever covered it."""
    rows = [record.frames.projected_px for record in records]
    pixels = np.array([one for row in rows for one in row], dtype=np.float64).reshape(-1, 2, 2)
    found = visibility(pixels[:, 0], pixels[:, 1])
    return {f"framed_{which}_percent": None if np.isnan(share) else share for which, share in found.items()}


def picture_rows(records: Sequence[ViewpointRecord], source: str) -> list[Row]:
    """How far the feature was from the middle of the left picture, the right one, and any; trimmed as published."""
    pixels = np.concatenate([found_pixels(record, source) for record in records])
    if not len(pixels):
        return []
    table = centroid_table(pixels[:, 0], pixels[:, 1], (AUTOCAM_STEREO.left, AUTOCAM_STEREO.right))
    shared = {"samples": len(pixels), "pixels": source.removesuffix("_px"), **visibility_row(records, source)}
    if source == "projected_px":
        shared |= framed_row(records)
    rows = []
    for camera in ("left", "right", "any"):
        row: Row = {"camera": camera, **shared}
        eye = {"left": table.left, "right": table.right}.get(camera)
        for error in ERRORS:
            spreads = {"percent": table.combined[error]} if eye is None else {}
            if eye is not None:
                spreads = {"px": eye.pixels[error], "percent": eye.percent[error]}
            for unit, spread in spreads.items():
                for suffix, value in (("", spread.mean), ("_std", spread.deviation)):
                    row[f"{error}_error_{unit}{suffix}"] = None if np.isnan(value) else value
        rows.append(row)
    return rows


def _shares(record: ViewpointRecord) -> FloatArray:
    return np.array(record.frames.ring_seen, dtype=np.float64).reshape(-1, 2)


def _seen(record: ViewpointRecord, source: str) -> FloatArray:
    """``(n, 2)`` bool, left and right."""
    if source == "tags_px":
        return np.asarray(np.isfinite(found_pixels(record, source)).all(axis=2))
    return np.asarray(_shares(record) >= SEEN_SHARE)


def _percent(seen: FloatArray) -> Row:
    if not len(seen):
        return dict.fromkeys(SEEN)
    which = (seen[:, 0], seen[:, 1], seen.any(axis=1), seen.all(axis=1))
    return {key: 100.0 * float(one.mean()) for key, one in zip(SEEN, which, strict=True)}
