"""What an instrument file says: links in modified Denavit-Hartenberg convention, limits, tips, shapes."""

from __future__ import annotations

import itertools
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, field_validator, model_validator

from surgbench.config import Finite, Section
from surgbench.instrument.parts import Part
from surgbench.state import Symmetry

Range = tuple[Finite, Finite]
Vector3 = tuple[Finite, Finite, Finite]
Share = Annotated[float, Field(ge=0.0, le=1.0)]

JOINT_NAMES = ("wrist_pitch", "wrist_yaw", "jaw")
JointName = Literal["wrist_pitch", "wrist_yaw", "jaw"]
# What an instrument may show of its state besides place and direction: the turn about its shaft, and its joints.
Quantity = Literal["roll", "wrist_pitch", "wrist_yaw", "jaw"]


class CrossSection(Section):
    """One cross-section of a loft: a superellipse ``|a/ra|^n + |b/rb|^n = 1`` across the loft's axis.

    Attributes:
        at_m: Where along the axis.
        centre_m: Offset of the centre along the two cross axes.
        radii_m: Half widths along the two cross axes.
        exponent: 2 is an ellipse, larger is boxier.
    """

    at_m: Finite
    centre_m: tuple[Finite, Finite] = (0.0, 0.0)
    radii_m: tuple[Annotated[float, Field(gt=0)], Annotated[float, Field(gt=0)]]
    exponent: Annotated[float, Field(ge=1.0, le=20.0)] = 2.0


class Loft(Section):
    """A closed solid swept through cross-sections along one axis of the link frame.

    The cross axes follow the axis cyclically: (y, z) for x, (z, x) for y, (x, y) for z.
    """

    axis: Literal["x", "y", "z"]
    sides: Annotated[int, Field(ge=3, le=256)] = 16
    sections: Annotated[tuple[CrossSection, ...], Field(min_length=2)]

    @model_validator(mode="after")
    def _increasing(self) -> Loft:
        places = [section.at_m for section in self.sections]
        if any(b <= a for a, b in itertools.pairwise(places)):
            raise ValueError("sections must have increasing at_m")
        return self


class MeshFile(Section):
    """A triangle mesh beside the instrument file (STL, OBJ or PLY).

    Attributes:
        path: Relative to the instrument file.
        scale: Multiplies the coordinates (0.001 for a file in millimetres).
        rotation: Row-major ``(3, 3)`` from the file's frame to the link frame.
        translation_m: Added after the rotation.
        close_holes: Mend open meshes with pymeshlab (extra ``meshes``).
        max_triangles: Reduce larger meshes with pymeshlab (extra ``meshes``).
    """

    path: str
    scale: Annotated[float, Field(gt=0)] = 1.0
    rotation: tuple[Vector3, Vector3, Vector3] = ((1, 0, 0), (0, 1, 0), (0, 0, 1))
    translation_m: Vector3 = (0.0, 0.0, 0.0)
    close_holes: bool = False
    max_triangles: Annotated[int, Field(ge=4)] | None = None

    @field_validator("rotation")
    @classmethod
    def _rigid(cls, rows: tuple[Vector3, Vector3, Vector3]) -> tuple[Vector3, Vector3, Vector3]:
        matrix = np.array(rows)
        if not np.allclose(matrix @ matrix.T, np.eye(3), atol=1e-3) or np.linalg.det(matrix) < 0:
            raise ValueError("the rows must be those of a rotation matrix (for other units use 'scale')")
        return rows


class Link(Section):
    """One rigid body. Its frame is ``T_parent · Rx(alpha) Tx(a) Rz(theta) Tz(d)`` (Craig's convention).

    ``theta = theta_offset_rad + joint_scale * q[joint]``. The first link has no parent: its frame is the
    wrist-pitch frame (DH frame 4, z along the shaft towards the jaws) whose pose the state gives.
    """

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]+$")]
    parent: str | None = None
    alpha_rad: Finite = 0.0
    a_m: Finite = 0.0
    d_m: Finite = 0.0
    theta_offset_rad: Finite = 0.0
    joint: JointName | None = None
    joint_scale: Finite = 1.0
    shapes: tuple[Loft, ...] = ()
    parts: tuple[Part, ...] = ()
    mesh: MeshFile | None = None

    @model_validator(mode="after")
    def _one_geometry(self) -> Link:
        given = [key for key in ("shapes", "parts", "mesh") if getattr(self, key)]
        if len(given) > 1:
            raise ValueError(f"link '{self.name}' has both '{given[0]}' and '{given[1]}'; give one")
        return self


class LinkPoint(Section):
    """A point fixed to a link, metres in the link's frame."""

    link: str
    point_m: Vector3


class Marker(Section):
    """A round spot of paint.

    Attributes:
        name: Of its own.
        point: Its middle, on the link's surface or less than its radius off.
        radius_m: Of the ball within which the surface is painted.
        colour: Linear red, green and blue, as painted.
    """

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]+$")]
    point: LinkPoint
    radius_m: Annotated[float, Field(gt=0, allow_inf_nan=False)]
    colour: tuple[Share, Share, Share]


class Joint(Section):
    """Limits of one joint, radians: what trackers search, and what the generator draws."""

    search_rad: Range
    generate_rad: Range

    @model_validator(mode="after")
    def _ordered(self) -> Joint:
        for name, (low, high) in (("search_rad", self.search_rad), ("generate_rad", self.generate_rad)):
            if not low < high:
                raise ValueError(f"{name} must be [lower, upper] with lower < upper")
            if max(abs(low), abs(high)) > 2 * np.pi:
                raise ValueError(
                    f"{name} is [{low:g}, {high:g}], more than a full turn; limits are radians "
                    f"([{np.deg2rad(low):.4g}, {np.deg2rad(high):.4g}] if these were degrees)"
                )
        if self.generate_rad[0] < self.search_rad[0] or self.generate_rad[1] > self.search_rad[1]:
            raise ValueError(
                f"generate_rad {list(self.generate_rad)} must lie within search_rad {list(self.search_rad)}: no "
                "tracker looks for what is beyond"
            )
        return self


class Model(Section):
    """One of the model numbers that an instrument is sold under: what differs between the generations of the robot.

    Attributes:
        number: The manufacturer's.
        generation: The robots that take it.
        roll_d_m: From the arm's remote centre of motion at no insertion to the pitch axis, DH's d of the roll joint.
        wrist_pitch_rad: What the robot's software allows.
        wrist_yaw_rad: Likewise.
        jaw_rad: Likewise, of the whole opening, twice the joint ``jaw``; below 0 the jaws are pressed together.
        coupling: Joints (roll, wrist pitch, wrist yaw, jaw) from the angles of the four drives, rows of the matrix.
    """

    number: str
    generation: str
    roll_d_m: Annotated[float, Field(gt=0, allow_inf_nan=False)]
    wrist_pitch_rad: Range | None = None
    wrist_yaw_rad: Range | None = None
    jaw_rad: Range | None = None
    coupling: tuple[tuple[Finite, ...], ...] | None = None


class InstrumentSpec(Section):
    """An instrument file. See ``docs/instruments.md`` for a commented example.

    Attributes:
        models: The model numbers that it stands for; nothing is computed from them.
        observable: What can be seen of its state besides where it is and points; errors of anything else are not
            scored. ``None``: the joints that move a body or a tip, and the roll unless the body is round.
        symmetry: What makes it look the same. ``None``: ``axis`` where the roll cannot be seen, else ``twin``.
        tips: The keypoints of its jaws; one of a tool that has no jaws, which then stands for both.
        markers: Painted on it, each of a colour of its own.
    """

    format: Literal["surgbench-instrument-1"]
    name: Annotated[str, Field(pattern=r"^[a-z0-9_]+$")]
    title: str
    sources: tuple[str, ...] = ()
    models: tuple[Model, ...] = ()
    joints: dict[JointName, Joint]
    links: Annotated[tuple[Link, ...], Field(min_length=1)]
    tips: Annotated[tuple[LinkPoint, ...], Field(min_length=1, max_length=2)]
    skeleton: tuple[tuple[LinkPoint, LinkPoint], ...] = ()
    observable: tuple[Quantity, ...] | None = None
    symmetry: Symmetry | None = None
    markers: tuple[Marker, ...] = ()

    @model_validator(mode="after")
    def _consistent(self) -> InstrumentSpec:
        missing = [name for name in JOINT_NAMES if name not in self.joints]
        if missing:
            raise ValueError(f"joints lacks '{missing[0]}'")
        seen: set[str] = set()
        for index, link in enumerate(self.links):
            if link.name in seen:
                raise ValueError(f"two links are named '{link.name}'")
            if (link.parent is None) != (index == 0):
                raise ValueError(f"link '{link.name}': the first link, and only it, has no parent")
            if link.parent is not None and link.parent not in seen:
                raise ValueError(f"link '{link.name}': its parent '{link.parent}' must stand before it")
            seen.add(link.name)
        points = [*self.tips, *(point for bone in self.skeleton for point in bone)]
        for point in points:
            if point.link not in seen:
                raise ValueError(f"unknown link '{point.link}' in tips or skeleton")
        names: set[str] = set()
        for marker in self.markers:
            if marker.name in names:
                raise ValueError(f"two markers are named '{marker.name}'")
            if marker.point.link not in seen:
                raise ValueError(f"unknown link '{marker.point.link}' of marker '{marker.name}'")
            names.add(marker.name)
        used = {link.joint for link in self.links}
        for quantity in self.observable or ():
            if quantity != "roll" and quantity not in used:
                raise ValueError(f"observable names '{quantity}', which is the joint of no link")
        return self
