"""What a row of the instrument task may ask for."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from surgbench.suite.asked import RowRequest

Readings = Literal["none", "noisy", "true"]
Scored = Literal["raw", "filtered"]
Masks = Literal["auto", "union", "instances"]


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
        masks: What trackers are shown of two arms: their union alone, or besides what shows of each arm. ``auto`` is
            what there is in all of the dataset's pairs.
        scored: Which state is recorded and scored: the tracker's own, or what the filter makes of it.
    """

    initialiser: Annotated[
        str | None,
        Field(description="NAME: default: truth where there is any, else random."),
    ] = None
    filter: Annotated[str, Field(description="NAME: default: kalman.")] = "kalman"
    keypoints: Annotated[
        str | None, Field(description="NAME: keypoint source; default: resnet18, with joint readings observed.")
    ] = None
    readings: Annotated[Readings, Field(description="Which joint readings trackers are given.")] = "none"
    view: Annotated[
        str | None, Field(description="NAME: auxiliary view that trackers see besides the endoscope's.")
    ] = None
    masks: Annotated[
        Masks,
        Field(description="Of two arms: their mask alone, or one mask for each arm besides; auto: what is there."),
    ] = "auto"
    scored: Annotated[
        Scored, Field(description="Which state is scored: the tracker's own, or what the filter makes of it.")
    ] = "raw"
