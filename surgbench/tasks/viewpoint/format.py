"""What ``dataset.json`` says of the viewpoint task, and where everything lies in such a dataset's folder."""

from __future__ import annotations

from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, SerializerFunctionWrapHandler, model_serializer, model_validator

from surgbench.config import Finite, Name, NotNegative, Positive, Section, Step
from surgbench.dataset.manifest import Frames, Manifest
from surgbench.geometry import is_rigid
from surgbench.viewpoint.arm_files import CameraArmSpec
from surgbench.viewpoint.placement import DISTANCE_M
from surgbench.viewpoint.workspace import FLOOR_M, PREFERRED_SIDE, PROXIMITY_M

CONVENTIONS = {
    "world": "z up; the frame that the cart of the arms reports poses in",
    "feature": "T_world_feature: origin in the ring's centre, y axis along the ring's normal, towards the side that "
    "the camera should see, z axis as the tool that holds the ring points; in tables as a rotation vector (rx, ry, rz) "
    "and a position (x, y, z)",
    "base": "T_world_base, row by row: the camera arm's base (origin in its remote centre, z up along the arm) as the "
    "set-up joints report it",
    "touches": "the same points touched by the arm that holds the ring (world_m) and by the camera arm (base_m, in the "
    "frame of its base)",
    "zone": "five points touched around the no-go zone: A, B, C, D around its base, E at the height of its top",
    "joints": "yaw, pitch, insertion, roll, wrist pitch, wrist yaw of the camera arm",
    "missing": "NaN",
}

# A row of the table says of a missing feature: all six numbers are NaN.
FEATURE_COLUMNS = (
    "feature_rx_rad",
    "feature_ry_rad",
    "feature_rz_rad",
    "feature_x_m",
    "feature_y_m",
    "feature_z_m",
)
CONTACT = "contact"

Level = Literal["easy", "standard", "hard", "custom"]
Point = tuple[Finite, Finite, Finite]
Matrix = Annotated[tuple[Finite, ...], Field(min_length=16, max_length=16)]


def _check_rigid(name: str, numbers: tuple[float, ...]) -> None:
    if not is_rigid(np.reshape(numbers, (4, 4))):
        raise ValueError(f"{name} is not a rotation and a translation")


class TouchEntry(Section):
    """Points that both arms touched.

    Attributes:
        world_m: Tips of the arm that the world frame belongs to.
        base_m: Tips of the camera arm in the frame of its base.
    """

    world_m: tuple[Point, ...]
    base_m: tuple[Point, ...]

    @model_validator(mode="after")
    def _paired(self) -> TouchEntry:
        if len(self.world_m) != len(self.base_m):
            raise ValueError(
                f"world_m has {len(self.world_m)} points and base_m {len(self.base_m)}; both arms touched the same ones"
            )
        return self


class TrialEntry(Section):
    """One trial: the way of a feature, and the workspace of the camera arm that is to follow it.

    Attributes:
        id: Names its folders.
        samples: How many, numbered from 0.
        dt_s: Seconds between samples.
        level: How often rules speak against the geometrically best pose.
        truth: Whether ``truth/<id>/`` is there.
        T_world_base: ``(4, 4)`` row by row.
        touches: From before the trial.
        zone_m: A, B, C, D, E.
        start: Joints of the camera arm at rest before the first sample.
        distance_m: Wanted from camera to feature.
        floor_m: The camera stays this high above the base of the zone.
        proximity_m: And this far from the feature.
        preferred_side: Unit vector: the camera's y axis must not point along it.
    """

    id: Name
    samples: Frames
    dt_s: Step
    level: Level = "custom"
    truth: bool = False
    T_world_base: Matrix
    touches: TouchEntry
    zone_m: tuple[Point, Point, Point, Point, Point]
    start: tuple[Finite, Finite, Finite, Finite, Finite, Finite]
    distance_m: Positive = DISTANCE_M
    floor_m: Finite = FLOOR_M
    proximity_m: NotNegative = PROXIMITY_M
    preferred_side: Point = PREFERRED_SIDE

    @model_validator(mode="after")
    def _consistent(self) -> TrialEntry:
        _check_rigid("T_world_base", self.T_world_base)
        if abs(np.linalg.norm(self.preferred_side) - 1.0) > 1e-6:
            raise ValueError("preferred_side must be of unit length")
        return self


class WireEntry(Section):
    """The wire that the ring goes along, for pictures and checks.

    Attributes:
        points_m: Its centre line, a polyline in the world frame.
        radius_m: Of the wire.
        ring_radius_m: Of the circle in the middle of the ring's tube.
        tube_radius_m: Of that tube.
    """

    points_m: Annotated[tuple[Point, ...], Field(min_length=2)]
    radius_m: Positive
    ring_radius_m: Positive
    tube_radius_m: Positive


class SceneTruth(Section):
    """``truth/<id>/scene.json``: what is true over a whole trial.

    Attributes:
        T_world_base: ``(4, 4)`` row by row, where the camera arm's base really is.
        wire: Where there is one.
    """

    T_world_base: Matrix
    wire: WireEntry | None = None

    @model_validator(mode="after")
    def _rigid(self) -> SceneTruth:
        _check_rigid("T_world_base", self.T_world_base)
        return self


class ViewpointManifest(Manifest):
    """The whole of ``dataset.json`` of the viewpoint task.

    Attributes:
        task: What controllers do on it.
        trials: In order.
        camera_arm: Holds the camera in all of them; the da Vinci Classic's patient-side manipulator unless told.
    """

    task: Literal["viewpoint"] = "viewpoint"
    conventions: dict[str, str] = CONVENTIONS
    trials: Annotated[tuple[TrialEntry, ...], Field(min_length=1)]
    camera_arm: CameraArmSpec | None = None

    @model_validator(mode="after")
    def _references(self) -> ViewpointManifest:
        ids = [trial.id for trial in self.trials]
        if len(set(ids)) != len(ids):
            raise ValueError("two trials have the same id")
        return self

    @model_serializer(mode="wrap")
    def _short(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Without a camera arm that is not told, as such datasets were written before there were others."""
        data: dict[str, Any] = handler(self)
        return {key: value for key, value in data.items() if key != "camera_arm" or value is not None}

    @property
    def counts(self) -> str:
        """Trials and samples."""
        return f"{len(self.trials)} trials, {sum(trial.samples for trial in self.trials)} samples"


def feature_path(trial: str) -> str:
    """Where a trial's true feature poses and contacts lie."""
    return f"truth/{trial}/feature.parquet"


def scene_path(trial: str) -> str:
    """Where what is true over a whole trial lies."""
    return f"truth/{trial}/scene.json"
