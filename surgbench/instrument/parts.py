"""Parts that an instrument file builds a link's body from, each by a few lengths that a ruler measures.

All are metres in the link's frame. In the frames of a da Vinci tool (``docs/instruments.md``) the shaft runs along z
with the pitch axis along y; the wrist along x with the pitch axis along z and the yaw axis along y; a jaw along y with
the yaw axis along z, its side of the midline on x.
"""

from __future__ import annotations

import itertools
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from surgbench.config import Finite, NotNegative, Positive, Section

Axis = Literal["x", "y", "z"]
Side = Literal["left", "right"]
Sides = Annotated[int, Field(ge=3, le=256)]
Share = Annotated[float, Field(ge=0.0, le=1.0)]
Vector3 = tuple[Finite, Finite, Finite]

# What is left of a jaw beside a hole, at least.
THINNEST_RAIL_M = 1e-4


def mm(length_m: float) -> str:
    """A length as a person with a ruler says it."""
    return f"{1000 * length_m:.4g} mm"


class Tube(Section):
    """A round bar, drawn in at its far end.

    Attributes:
        axis: Along which it runs.
        radius_m: Of its outside.
        from_m: Where it begins.
        to_m: Where it ends, with its nose.
        nose_m: Length over which it is drawn in.
        nose_radius_m: Of its end; the whole radius unless told.
        sides: Corners of a section.
    """

    kind: Literal["tube"]
    axis: Axis = "z"
    radius_m: Positive
    from_m: Finite
    to_m: Finite
    nose_m: NotNegative = 0.0
    nose_radius_m: Positive | None = None
    sides: Sides = 20

    @model_validator(mode="after")
    def _sound(self) -> Tube:
        if not self.to_m - self.nose_m > self.from_m:
            raise ValueError(
                f"a tube from {mm(self.from_m)} to {mm(self.to_m)} with a nose of {mm(self.nose_m)} has no length"
            )
        if self.nose_radius_m is not None and (self.nose_radius_m > self.radius_m or self.nose_m == 0.0):
            raise ValueError("nose_radius_m is at most radius_m, and of a nose with a length nose_m")
        return self


class Pin(Section):
    """A round pin through the link's origin, along an axis.

    Attributes:
        axis: Along which it runs.
        radius_m: Of its outside.
        length_m: From end to end.
        sides: Corners of a section.
    """

    kind: Literal["pin"]
    axis: Axis
    radius_m: Positive
    length_m: Positive
    sides: Sides = 8


class Pulley(Section):
    """The disc of a jaw about the yaw axis (z), to its own side of the midplane.

    Attributes:
        side: Left is towards +z.
        radius_m: Of its rim.
        from_m: From the midplane to its inner face.
        to_m: From the midplane to its outer face.
        chamfer_m: Of its rim.
        sides: Corners of a section.
    """

    kind: Literal["pulley"]
    side: Side
    radius_m: Positive
    from_m: NotNegative
    to_m: Positive
    chamfer_m: Positive = 2e-4
    sides: Sides = 12

    @model_validator(mode="after")
    def _sound(self) -> Pulley:
        thickness = self.to_m - self.from_m
        if thickness <= 2 * self.chamfer_m or self.radius_m <= self.chamfer_m:
            raise ValueError(
                f"a pulley {mm(thickness)} thick, {mm(self.radius_m)} in radius has no room for chamfers of "
                f"{mm(self.chamfer_m)}"
            )
        return self


class Clevis(Section):
    """The two lugs at a shaft's end that hold the pitch pin: what a slot along x leaves of the shaft.

    Attributes:
        radius_m: Of the shaft.
        gap_m: Between the lugs, along the pitch axis.
        root_m: From the pitch axis back to where they begin.
        reach_m: From the pitch axis to their ends.
        sides: Corners of a section.
    """

    kind: Literal["clevis"]
    radius_m: Positive
    gap_m: Positive
    root_m: Positive
    reach_m: Positive
    sides: Sides = 10

    @model_validator(mode="after")
    def _sound(self) -> Clevis:
        if self.gap_m >= 1.9 * self.radius_m:
            raise ValueError(
                f"lugs {mm(self.gap_m)} apart leave nothing of a shaft of {mm(2 * self.radius_m)} (at most 0.95 of it)"
            )
        return self


class Wrist(Section):
    """The piece between the pitch and the yaw axis: a tongue, a body that bulges, and two cheeks that hold the jaws.

    Attributes:
        length_m: From the pitch to the yaw axis.
        reach_m: From the yaw axis to the ends of the cheeks.
        tongue_m: From the pitch axis back to the tongue's end.
        width_m: Along the yaw axis, at the widest.
        depth_m: Along the pitch axis, at the deepest.
        belly_m: From the pitch axis to where it is deepest.
        tongue_width_m: Along the yaw axis, at the pitch axis.
        tongue_depth_m: Along the pitch axis.
        slot_m: Between the cheeks, along the yaw axis.
        slot_depth_m: From the yaw axis back to the slot's bottom.
        end_width_m: Over both cheeks, at their ends.
        corner_m: Of its edges, cut off.
    """

    kind: Literal["wrist"]
    length_m: Positive
    reach_m: Positive
    tongue_m: Positive
    width_m: Positive
    depth_m: Positive
    belly_m: Positive
    tongue_width_m: Positive
    tongue_depth_m: Positive
    slot_m: Positive
    slot_depth_m: Positive
    end_width_m: Positive
    corner_m: Positive = 3e-4

    @model_validator(mode="after")
    def _sound(self) -> Wrist:
        if not self.slot_m < self.end_width_m <= self.width_m:
            raise ValueError(
                f"cheeks over {mm(self.end_width_m)} at their ends of a wrist {mm(self.width_m)} wide do not go with "
                f"a slot of {mm(self.slot_m)}: slot_m < end_width_m <= width_m"
            )
        if self.tongue_width_m > self.width_m or self.tongue_depth_m > self.depth_m:
            raise ValueError("the tongue is at most as wide and as deep as the wrist: tongue_width_m, tongue_depth_m")
        if not 0 < self.belly_m < self.length_m - self.slot_depth_m + self.reach_m:
            raise ValueError(f"belly_m ({mm(self.belly_m)}) lies between the pitch axis and the cheeks")
        if not self.slot_depth_m < self.length_m:
            raise ValueError(f"slot_depth_m ({mm(self.slot_depth_m)}) reaches behind the pitch axis")
        return self


class Hole(Section):
    """A window through a jaw, from its outside to its inner face, with round ends.

    Attributes:
        from_m: From the yaw axis to its near end.
        to_m: From the yaw axis to its far end.
        width_m: Along the yaw axis.
    """

    from_m: Finite
    to_m: Finite
    width_m: Positive


class Station(Section):
    """What a jaw measures at one place; what is left out is between what its neighbours say.

    Attributes:
        at: Share of the way from the jaw's ``from_m`` to its tip.
        width_m: Along the yaw axis.
        thickness_m: From its inner face outwards.
        gap_m: From the midline to its inner face; negative where it reaches beyond (blades that slide by each other).
        curve_m: Its middle's offset along the yaw axis, the same for both jaws.
        stagger_m: The same, to each jaw's own side (left: +).
    """

    at: Share
    width_m: Positive | None = None
    thickness_m: Positive | None = None
    gap_m: Finite | None = None
    curve_m: Finite | None = None
    stagger_m: Finite | None = None


class Measures(Section):
    """A jaw at one place, all of :class:`Station` told."""

    width_m: float
    thickness_m: float
    gap_m: float
    curve_m: float
    stagger_m: float


class Jaw(Section):
    """A jaw along y, by its profile. Left lies towards -x; right is the same about the midline.

    Attributes:
        side: Of the two.
        from_m: From the yaw axis to where it begins.
        length_m: From the yaw axis to its tip.
        profile: Stations along it, the first at 0, the last at 1.
        tip_round_m: Length over which its width is rounded off to the tip.
        corner_m: Of its edges, cut off; 0 leaves them sharp, with half of the triangles.
        holes: Windows through it, none within another.
    """

    kind: Literal["jaw"]
    side: Side
    from_m: Finite
    length_m: Positive
    profile: Annotated[tuple[Station, ...], Field(min_length=2)]
    tip_round_m: NotNegative = 0.0
    corner_m: NotNegative = 0.0
    holes: tuple[Hole, ...] = ()

    @model_validator(mode="after")
    def _sound(self) -> Jaw:
        places = [station.at for station in self.profile]
        if places[0] != 0.0 or places[-1] != 1.0 or any(b <= a for a, b in itertools.pairwise(places)):
            raise ValueError(f"profile goes from at: 0 to at: 1, each station beyond the one before (it has {places})")
        if self.profile[0].width_m is None or self.profile[0].thickness_m is None:
            raise ValueError("the first station of profile has width_m and thickness_m")
        if self.from_m + self.tip_round_m >= self.length_m:
            raise ValueError(
                f"a jaw from {mm(self.from_m)} to {mm(self.length_m)} has no room for a tip of {mm(self.tip_round_m)}"
            )
        end = self.from_m
        for hole in sorted(self.holes, key=lambda hole: hole.from_m):
            self._check_hole(hole, end)
            end = hole.to_m
        return self

    def _check_hole(self, hole: Hole, end: float) -> None:
        about = f"the hole from {mm(hole.from_m)} to {mm(hole.to_m)}"
        if not end < hole.from_m < hole.to_m < self.length_m:
            raise ValueError(
                f"{about} does not lie within the jaw ({mm(self.from_m)} to {mm(self.length_m)}) or beside the others"
            )
        if hole.to_m - hole.from_m < hole.width_m:
            raise ValueError(f"{about} is wider ({mm(hole.width_m)}) than it is long; its ends are round")
        for place in (*np.linspace(hole.from_m, hole.to_m, 33), *self.places()):
            half = hole_half_width(hole, place)
            if half > 0 and self.measures(place).width_m / 2 - half < THINNEST_RAIL_M:
                raise ValueError(
                    f"{about} is {mm(hole.width_m)} wide, and the jaw only {mm(self.measures(place).width_m)} "
                    f"at {mm(place)} from the yaw axis: nothing is left beside it"
                )

    def places(self) -> tuple[float, ...]:
        """Where the profile's stations and the rounded tip's rings are, metres from the yaw axis."""
        whole = self.length_m - self.from_m
        found = {self.from_m + station.at * whole for station in self.profile}
        if self.tip_round_m:
            found |= {self.length_m - share * self.tip_round_m for share in (1.0, 0.6, 0.25, 0.06)}
        return tuple(sorted(found))

    def measures(self, place_m: float) -> Measures:
        """What it measures at a distance from the yaw axis."""
        share = (place_m - self.from_m) / (self.length_m - self.from_m)
        told = {}
        for name in Measures.model_fields:
            known = {station.at: value for station in self.profile if (value := getattr(station, name)) is not None}
            told[name] = float(np.interp(share, [*known], [*known.values()])) if known else 0.0
        left = self.length_m - place_m
        if left < self.tip_round_m:
            told["width_m"] *= max(np.sqrt(1 - (1 - left / self.tip_round_m) ** 2), 0.3)
        return Measures(**told)


def hole_half_width(hole: Hole, place_m: float) -> float:
    """Half of a hole's width at a distance from the yaw axis; its ends are half circles."""
    radius = hole.width_m / 2
    inside = min(place_m - hole.from_m, hole.to_m - place_m, radius)
    return 0.0 if inside <= 0 else float(np.sqrt(radius**2 - (radius - inside) ** 2))


class Knot(Section):
    """A corner of a bar's path.

    Attributes:
        point_m: Where, in the link's frame.
        width_m: There; as at the corner before unless told.
        thickness_m: There; likewise.
    """

    point_m: Vector3
    width_m: Positive | None = None
    thickness_m: Positive | None = None


class Bar(Section):
    """A bar along a path: hooks, spatulas, rods that are bent.

    Attributes:
        path: Its corners, from its root to its end.
        across: The axis along which its width is measured (as near as the path allows).
        corner_m: Of its edges, cut off; 0 leaves them sharp.
    """

    kind: Literal["bar"]
    path: Annotated[tuple[Knot, ...], Field(min_length=2)]
    across: Axis
    corner_m: NotNegative = 0.0

    @model_validator(mode="after")
    def _sound(self) -> Bar:
        if self.path[0].width_m is None or self.path[0].thickness_m is None:
            raise ValueError("the first corner of path has width_m and thickness_m")
        points = np.array([knot.point_m for knot in self.path])
        steps = np.diff(points, axis=0)
        lengths = np.linalg.norm(steps, axis=1)
        if lengths.min() == 0:
            raise ValueError("two corners of path that follow each other are the same point")
        if (np.abs(steps[:, "xyz".index(self.across)]) > 0.95 * lengths).any():
            raise ValueError(f"path runs along {self.across}, across which its width is to be")
        return self


Part = Annotated[Tube | Pin | Pulley | Clevis | Wrist | Jaw | Bar, Field(discriminator="kind")]
