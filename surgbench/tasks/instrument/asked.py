"""What a row of the instrument task may ask for."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from surgbench.suite.asked import RowRequest

Readings = Literal["none", "noisy", "true"]
Scored = Literal["raw", "filtered"]
Masks = Literal["auto", "union", "instances"]
# Points in first pictures as a specification holds them: sequence to view to arm to points (u, v, inside).
ToldPrompts = dict[str, dict[str, dict[str, list[tuple[float, float, bool]]]]]
OF_DATASET: tuple[Masks, ...] = ("auto", "union", "instances")


class InstrumentRow(RowRequest):
    """A row of the instrument task.

    Attributes:
        row_id: Unless told the tracker's name, with ``-joints`` where it reads joints, and with the view where it has
            one.
        initialiser: ``truth`` where the dataset has it, else ``random``, unless told.
        filter: State filter.
        keypoints: Keypoint source; unless told ``resnet18``, which finds the tips in the mask, but for rows with
            readings on data that holds tips ``observed``.
        readings: Which joint readings the tracker is given.
        view: Auxiliary view that the tracker is given besides the endoscope's.
        masks: Where the masks come from: a mask source by name; or the dataset's own, of two arms their ``union``
            alone, or ``instances``, what shows of each arm, besides. ``auto`` is what there is in all of the dataset's
            pairs.
        prompts: A file with points in the first pictures, for mask sources (:mod:`surgbench.prompts`).
        told_prompts: The same as a record holds them.
        scored: Which state is recorded and scored: the tracker's own, or what the filter makes of it.
    """

    initialiser: Annotated[
        str | None,
        Field(
            description="NAME: default: truth where there is any, else random.",
            json_schema_extra={"plugins": "initialiser"},
        ),
    ] = None
    filter: Annotated[str, Field(description="NAME: default: kalman.", json_schema_extra={"plugins": "filter"})] = (
        "kalman"
    )
    keypoints: Annotated[
        str | None,
        Field(
            description="NAME: keypoint source; default: resnet18, with joint readings observed.",
            json_schema_extra={"plugins": "keypoints"},
        ),
    ] = None
    readings: Annotated[Readings, Field(description="Which joint readings trackers are given.")] = "none"
    view: Annotated[
        str | None, Field(description="NAME: auxiliary view that trackers see besides the endoscope's.")
    ] = None
    masks: Annotated[
        str,
        Field(
            description="NAME: mask source, which makes masks of images; or union, instances: of two arms the "
            "dataset's mask of both alone, or one of each besides; default: auto, what is there.",
            json_schema_extra={"plugins": "mask_source"},
        ),
    ] = "auto"
    prompts: Annotated[
        Path | None,
        Field(description="FILE: points on the instruments in the first pictures, for the mask source."),
    ] = None
    told_prompts: ToldPrompts = Field(default={}, json_schema_extra={"hidden": True})
    scored: Annotated[
        Scored, Field(description="Which state is scored: the tracker's own, or what the filter makes of it.")
    ] = "raw"

    @property
    def mask_source(self) -> str | None:
        """Reference of the mask source; ``None`` for the dataset's own masks."""
        return None if self.masks in OF_DATASET else self.masks
