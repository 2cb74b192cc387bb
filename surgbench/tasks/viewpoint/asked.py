"""What a row of the viewpoint task may ask for."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from surgbench.suite.asked import RowRequest
from surgbench.viewpoint.registration import Method


class ViewpointRow(RowRequest):
    """A row of the viewpoint task.

    Attributes:
        registration: How touched points correct the camera arm's base.
        missing_face: The no-go zone as in the published code, which never tests one of its sides.
        photographs_hz: So many stereo pictures a second are rendered, and the feature is found in them.
    """

    registration: Annotated[Method, Field(description="How touched points correct the camera arm's base.")] = (
        "translation"
    )
    missing_face: Annotated[bool, Field(description="One side of the no-go zone open, as published.")] = False
    photographs_hz: Annotated[
        float,
        Field(
            ge=0,
            le=100,
            allow_inf_nan=False,
            description="HZ: find the feature in so many rendered pictures a second.",
            json_schema_extra={"option": "photographs"},
        ),
    ] = 0.0
