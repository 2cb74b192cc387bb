"""The da Vinci's autonomous camera of Eslamian, Reisner and Pandya, with the settings of its published code.

The rule is in :mod:`surgbench.trackers.midpoint`. The code, of which facts are used here and no text, is
careslab/autocamera, ``scripts/autocamera_algorithm.py``: the first of its two methods of insertion (as deep as it was,
but for the zones), and a roll that is left alone (there it is always 0).
"""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

from pydantic import Field

from surgbench.trackers.midpoint import Midpoint, MidpointConfig


class MidpointPublishedConfig(MidpointConfig):
    """Options; the defaults are the first of the code's two methods."""

    insertion: Annotated[
        Literal["distance", "zones"],
        Field(description="zones: stay as deep, but for the zones; distance: stay as far from the feature as wanted"),
    ] = "zones"
    roll: Annotated[
        Literal["level", "keep"], Field(description="keep: it turns with the arm; level: the camera's x axis is level")
    ] = "keep"


class MidpointPublished(Midpoint):
    """Pan and tilt towards the midpoint; in and out by how much of the picture is filled; the roll is left alone."""

    name: ClassVar[str] = "midpoint-published"
    summary: ClassVar[str] = "the da Vinci's autonomous camera as its code does it: pan, tilt, zoom by zones"
    Config = MidpointPublishedConfig
