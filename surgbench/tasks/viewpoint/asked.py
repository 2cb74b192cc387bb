"""What a row of the viewpoint task may ask for."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from surgbench.suite.asked import RowRequest

Registration = Literal["none", "translation", "rigid"]
WorksFrom = Literal["endoscope", "auxiliary"]


class ViewpointRow(RowRequest):
    """A row of the viewpoint task.

    Attributes:
        registration: How touched points correct the camera arm's base.
        missing_face: The no-go zone as in the published code, which never tests one of its sides.
        photographs_hz: So many stereo pictures a second are rendered, and the feature is found in them.
        hand: A simulated hand leads the ring, by the picture of this camera, in place of the trial's own.
        steady: Where teleoperation takes the view anew, the tool does not turn.
    """

    registration: Annotated[Registration, Field(description="How touched points correct the camera arm's base.")] = (
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
    hand: Annotated[
        WorksFrom | None,
        Field(description="A simulated hand leads the ring by this camera's picture, not the trial's own."),
    ] = None
    steady: Annotated[
        bool, Field(description="With --hand: the tool does not turn where teleoperation takes the view anew.")
    ] = False
