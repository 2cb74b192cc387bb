"""What a row of the viewpoint task may ask for."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from surgbench.config import NotNegative
from surgbench.suite.asked import RowRequest
from surgbench.viewpoint.registration import Method

WorksFrom = Literal["endoscope", "auxiliary"]


class ViewpointRow(RowRequest):
    """A row of the viewpoint task.

    Attributes:
        registration: How touched points correct the camera arm's base.
        missing_face: The no-go zone as in the published code, which never tests one of its sides.
        photographs_hz: So many stereo pictures a second are rendered, and the feature is found in them.
        told_lag: A level of a disturbance, as all that follow (:class:`surgbench.viewpoint.disturbance.Disturbance`).
        hand: A simulated hand leads the ring, by the picture of this camera, in place of the trial's own.
        steady: Where teleoperation takes the view anew, the tool does not turn.
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
    told_lag: Annotated[
        NotNegative, Field(le=10, description="FACTOR: the joints' lag that controllers are told, in true ones.")
    ] = 1.0
    jitter_s: Annotated[
        NotNegative, Field(le=1, description="SECONDS: measurements are up to so much older than they say.")
    ] = 0.0
    dropouts: Annotated[
        NotNegative, Field(le=0.5, description="SHARE: so many of the measurements are missing, in gaps.")
    ] = 0.0
    dropout_s: Annotated[
        NotNegative, Field(le=60, description="SECONDS: length of these gaps in the mean; default: 0.1.")
    ] = 0.1
    noise_m: Annotated[
        NotNegative, Field(le=0.1, description="METRES: white noise on the measured position, of each coordinate.")
    ] = 0.0
    noise_rad: Annotated[
        NotNegative, Field(le=1, description="RADIANS: white noise on the measured rotation, about each axis.")
    ] = 0.0
    registration_error_m: Annotated[
        NotNegative, Field(le=0.1, description="METRES: the camera arm's base is registered so far beside its place.")
    ] = 0.0
    hand: Annotated[
        WorksFrom | None,
        Field(description="A simulated hand leads the ring by this camera's picture, not the trial's own."),
    ] = None
    steady: Annotated[
        bool, Field(description="With --hand: the tool does not turn where teleoperation takes the view anew.")
    ] = False
