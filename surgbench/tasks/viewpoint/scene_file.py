"""The scene around a recorded motion, from a user's file: what it leaves out is put around the motion."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, field_validator, model_validator
from scipy.spatial.transform import Rotation

from surgbench.config import Finite, NotNegative, Positive, Section, is_file, parse_model, read_yaml
from surgbench.geometry import FloatArray, rigid_transform
from surgbench.tasks.viewpoint.format import Point, TouchEntry
from surgbench.viewpoint.placement import DISTANCE_M, UP
from surgbench.viewpoint.workspace import FLOOR_M, PROXIMITY_M

Normal = Literal["x", "-x", "y", "-y", "z", "-z"]
# From AutoCam's tool to the ring that it holds, along the tool's z.
FEATURE_OFFSET_M = (0.0, 0.0, 0.033)
WORLD, CAMERA_BASE = "world", "camera-base"
# No part of an operating room's scene is farther off, or larger.
FARTHEST_M, LARGEST_ZONE_M = 20.0, 2.0


class PoseEntry(Section):
    """A pose.

    Attributes:
        position_m: Of its origin.
        quaternion_xyzw: Its rotation; made of unit length.
    """

    position_m: Point
    quaternion_xyzw: tuple[Finite, Finite, Finite, Finite] = (0.0, 0.0, 0.0, 1.0)

    @field_validator("quaternion_xyzw")
    @classmethod
    def _turns(cls, value: tuple[float, ...]) -> tuple[float, ...]:
        if np.linalg.norm(value) < 1e-6:
            raise ValueError("a quaternion must not be zero")
        return value

    def matrix(self) -> FloatArray:
        """``(4, 4)``."""
        return rigid_transform(Rotation.from_quat(self.quaternion_xyzw).as_matrix(), np.array(self.position_m))


class FeatureEntry(Section):
    """Where on the tool the feature is.

    Attributes:
        offset_m: Its centre in the tool's frame.
        normal: The tool's axis that is its normal, towards the side that the camera should see.
    """

    offset_m: Point = FEATURE_OFFSET_M
    normal: Normal = "y"

    def matrix(self) -> FloatArray:
        """``(4, 4)`` T_tool_feature: y is the normal, and z as near to the tool's z as can be."""
        axis = "xyz".index(self.normal[-1])
        y = np.eye(3)[axis] * (-1.0 if self.normal.startswith("-") else 1.0)
        z = np.eye(3)[0 if axis == 2 else 2]
        return rigid_transform(np.stack([np.cross(y, z), y, z], axis=1), np.array(self.offset_m))


class SceneFile(Section):
    """A scene's file; what is left out is put around the motion.

    Attributes:
        camera_arm: A name of ``surgbench list camera_arms``, or a file, relative to this one.
        base: The camera arm's, in the world.
        touches: The same points touched by both arms; without error unless told.
        zone_m: Five points touched around the no-go zone: A, B, C, D around its base, E as high as its top.
        start: Joints of the camera arm at rest before the first sample.
        distance_m: Wanted from camera to feature.
        floor_m: The camera stays this high above the base of the zone.
        proximity_m: And this far from the feature.
        preferred_side: The camera's y axis must not point along it.
        feature: Where on the tool the feature is.
        frame: Which frame the recorded poses are in: ``world``, ``camera-base``, or one of ``frames``.
        frames: Other frames' poses in the world, by name.
    """

    camera_arm: str | None = None
    base: PoseEntry | None = None
    touches: TouchEntry | None = None
    zone_m: Annotated[tuple[Point, ...], Field(min_length=5, max_length=5)] | None = None
    start: tuple[Finite, Finite, Finite, Finite, Finite, Finite] | None = None
    distance_m: Positive = DISTANCE_M
    floor_m: Finite = FLOOR_M
    proximity_m: NotNegative = PROXIMITY_M
    preferred_side: Point | None = None
    feature: FeatureEntry = FeatureEntry()
    frame: str | None = None
    frames: dict[str, PoseEntry] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _possible(self) -> SceneFile:
        if self.preferred_side is not None and np.linalg.norm(self.preferred_side) < 1e-6:
            raise ValueError("preferred_side must not be zero")
        if {WORLD, CAMERA_BASE} & set(self.frames):
            raise ValueError(f"frames: '{WORLD}' and '{CAMERA_BASE}' are known already")
        if self.distance_m <= self.proximity_m:
            raise ValueError(
                f"distance_m is {self.distance_m:g}, but proximity_m keeps the camera {self.proximity_m:g} away"
            )
        if self.zone_m is not None:
            self._check_zone(np.array(self.zone_m))
        for name, points in self._places().items():
            if len(points) and np.abs(points).max() > FARTHEST_M:
                raise ValueError(
                    f"{name} is {np.abs(points).max():.6g} m off; lengths are in metres: is it in millimetres?"
                )
        return self

    def _places(self) -> dict[str, FloatArray]:
        """Everything of the scene that has a place, ``(n, 3)`` each."""
        poses = {**({} if self.base is None else {"base": self.base}), **self.frames}
        places = {f"{name}.position_m": np.reshape(pose.position_m, (1, 3)) for name, pose in poses.items()}
        places["feature.offset_m"] = np.reshape(self.feature.offset_m, (1, 3))
        if self.touches is not None:
            places |= {"touches.world_m": np.reshape(self.touches.world_m, (-1, 3))}
            places |= {"touches.base_m": np.reshape(self.touches.base_m, (-1, 3))}
        return places

    @staticmethod
    def _check_zone(points: FloatArray) -> None:
        size = float(np.linalg.norm(points[:, None] - points[None], axis=2).max())
        if size > LARGEST_ZONE_M:
            raise ValueError(f"zone_m is {size:.6g} m wide; lengths are in metres: is it in millimetres?")
        if points[4] @ UP < points[:4].mean(axis=0) @ UP:
            raise ValueError("zone_m: its fifth point is as high as the zone's top, and must be above its base")


def load_scene(path: Path) -> SceneFile:
    """Load a scene's file.

    Raises:
        ConfigError: It is missing or wrong; one line that names file and key.
    """
    scene = parse_model(SceneFile, read_yaml(path, "scene"), str(path))
    arm = scene.camera_arm
    if arm is not None and is_file(arm):
        scene = scene.model_copy(update={"camera_arm": str(path.parent / arm)})
    return scene
