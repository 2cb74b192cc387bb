"""Presets of the wire chaser: everything that decides what a generated dataset looks like."""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal

from pydantic import Field, SerializerFunctionWrapHandler, field_validator, model_serializer, model_validator

from surgbench.config import Finite, Name, NotNegative, Positive, Section
from surgbench.generators.sections import Fraction
from surgbench.viewpoint.arm_files import CameraArmSpec, arm_of, load_camera_arm, unless_default
from surgbench.viewpoint.camera_arm import CameraArm
from surgbench.viewpoint.placement import DISTANCE_M
from surgbench.viewpoint.workspace import FLOOR_M, PREFERRED_SIDE, PROXIMITY_M

Range = tuple[Finite, Finite]
Vector = tuple[Finite, Finite, Finite]
Spread = tuple[NotNegative, NotNegative, NotNegative]

# Share of samples at which rules speak against the geometrically best pose, by level.
SHARES: dict[str, tuple[float, float]] = {"easy": (0.05, 0.15), "standard": (0.35, 0.45), "hard": (0.60, 0.75)}


def _ordered(section: Section, *names: str) -> None:
    for name in names:
        low, high = getattr(section, name)
        if not low <= high:
            raise ValueError(f"{name} must be [lower, upper] with lower <= upper")


class WireSettings(Section):
    """The wire, a cubic spline through points in the published no-go box, which encloses the task.

    Lengths of wire and ring are from no source (the exercise's are published nowhere); the box and the extents of the
    ring's way are AutoCam's.

    Attributes:
        box_m: Within which all of it lies, by ``margin_m``.
        margin_m: From the box's sides and top.
        base_m: From the box's base, so that the ring can pass.
        control_points: How many.
        length_m: One way.
        climb: Where the search for a wire begins: it climbs towards the camera arm on this share of its way, drawn
            between these, and then goes anywhere.
        wander_m: Standard deviation of the points from there.
        bend_radius_m: Nowhere is it bent more.
        apart_m: Parts of it that do not follow each other are this far apart, so that the ring fits between.
        extent_m: Of the ring's way along its three principal axes, long, middle, short.
        radius_m: Of the wire.
        ring_radius_m: Of the circle in the middle of the ring's tube.
        tube_radius_m: Of that tube.
    """

    box_m: tuple[Positive, Positive, Positive] = (0.082, 0.076, 0.049)
    margin_m: NotNegative = 0.002
    base_m: NotNegative = 0.006
    control_points: tuple[int, int] = (6, 8)
    length_m: Range = (0.135, 0.250)
    climb: tuple[Fraction, Fraction] = (0.45, 0.85)
    wander_m: NotNegative = 0.006
    bend_radius_m: Positive = 0.007
    apart_m: Positive = 0.016
    extent_m: tuple[Range, Range, Range] = ((0.060, 0.093), (0.026, 0.042), (0.024, 0.040))
    radius_m: Positive = 0.001
    ring_radius_m: Positive = 0.004
    tube_radius_m: Positive = 0.0008

    @model_validator(mode="after")
    def _possible(self) -> WireSettings:
        _ordered(self, "control_points", "length_m", "climb")
        if self.control_points[0] < 4:
            raise ValueError("control_points must be at least 4")
        if self.clearance_m <= 0:
            raise ValueError("the ring does not fit on the wire: ring_radius_m - tube_radius_m must exceed radius_m")
        if self.bend_radius_m <= self.ring_radius_m + self.tube_radius_m:
            raise ValueError("bend_radius_m must be more than the ring's outer radius, or it cannot pass")
        return self

    @property
    def clearance_m(self) -> float:
        """How far the ring's centre may be from the wire's where the ring is square to it."""
        return float(self.ring_radius_m - self.tube_radius_m - self.radius_m)


class Hand(Section):
    """How a hand leads the ring.

    Attributes:
        duration_s: Mean and standard deviation of a trial's (AutoCam's users: 74.26 and 17.35 s).
        duration_range_s: Within which it is drawn again.
        speed_m_s: The ring goes no farther than this mean speed allows; short trials turn back before the wire's end.
        movement_s: Mean and standard deviation of a sub-movement's duration, gamma distributed.
        movement_range_s: Within which it is drawn again.
        peak_spread: Standard deviation of the peak speeds of sub-movements, as a share of their mean.
        rest_share: How much of a trial the ring rests, drawn between these.
        clutch_every_s: Mean time between pauses with the clutch pressed.
        clutch_s: Their length, drawn between these.
        curvature_power: Speed goes with the curvature to the power of minus this.
        curvature_range: Of the curvature times the wire's median bend radius, within which it counts.
        lean: The hand turns the ring's normal from the wire towards the camera arm: by a unit vector there of this
            weight. The mean normals of AutoCam's logs rise by 30 degrees and more, for which a wire in this box alone
            is too flat.
        wobble_rad: Root mean square of the angle by which the normal errs from that, drawn between these.
        wobble_s: Time constant of that.
        twist_rad: Standard deviation of the turn about the normal.
        play: Standard deviation of each component of the sideways offset that the hand would have, as a share of the
            clearance: mean and standard deviation over trials.
        play_s: Time constant of that.
        resting_pace: How fast wobble and play go on while the ring rests, as a share.
        tremor_m: Root mean square of the tremor's displacement.
        tremor_hz: Its band.
        release_m: A contact ends when the ring is this far from the wire.
        shortest_contact_s: Shorter contacts, and shorter gaps between them, do not count.
    """

    duration_s: tuple[Positive, NotNegative] = (74.26, 17.35)
    duration_range_s: Range = (45.0, 110.0)
    speed_m_s: Positive = 0.008
    movement_s: tuple[Positive, Positive] = (0.6, 0.12)
    movement_range_s: Range = (0.4, 0.8)
    peak_spread: NotNegative = 0.5
    rest_share: tuple[Fraction, Fraction] = (0.3, 0.5)
    clutch_every_s: Positive = 12.0
    clutch_s: Range = (0.5, 2.0)
    curvature_power: NotNegative = 1 / 3
    curvature_range: tuple[Positive, Positive] = (0.2, 5.0)
    lean: Annotated[float, Field(ge=0, le=0.6)] = 0.35
    wobble_rad: Range = (math.radians(5), math.radians(10))
    wobble_s: Positive = 1.0
    twist_rad: NotNegative = math.radians(5)
    play: tuple[Positive, NotNegative] = (0.77, 0.15)
    play_s: Positive = 0.4
    resting_pace: Fraction = 0.25
    tremor_m: NotNegative = 50e-6
    tremor_hz: tuple[Positive, Positive] = (8.0, 12.0)
    release_m: NotNegative = 0.0002
    shortest_contact_s: NotNegative = 0.1

    @model_validator(mode="after")
    def _possible(self) -> Hand:
        names = ("duration_range_s", "movement_range_s", "rest_share", "clutch_s", "curvature_range", "wobble_rad")
        _ordered(self, *names, "tremor_hz")
        for name, (mean, _), (low, high) in (
            ("duration_s", self.duration_s, self.duration_range_s),
            ("movement_s", self.movement_s, self.movement_range_s),
        ):
            if not 0 < low <= mean <= high:
                raise ValueError(f"{name}: its mean must lie within the range it is drawn from")
        if self.rest_share[1] > 0.9:
            raise ValueError("rest_share must be at most 0.9")
        return self


class Measurement(Section):
    """How the robot's report of the ring's pose errs.

    Attributes:
        constant_m: Mean length of the error that is constant over a trial: cables, calibration.
        constant_rad: The same, of the rotation.
        noise_m: Standard deviation of each component, new in every sample.
        noise_rad: The same, of each component of the rotation vector.
        dropout: Probability that a gap begins, in every sample.
        dropout_s: Mean length of a gap.
    """

    constant_m: NotNegative = 0.0005
    constant_rad: NotNegative = math.radians(0.3)
    noise_m: NotNegative = 0.00003
    noise_rad: NotNegative = math.radians(0.02)
    dropout: Fraction = 0.0
    dropout_s: Positive = 0.1


class Scene(Section):
    """Where the camera arm is, and what is known of it. Figures are from AutoCam's logs unless said otherwise.

    Attributes:
        centre_m: Of the box's base in the world.
        centre_spread_m: Each component of it is drawn this far around. Our choice.
        remote_centre_m: The camera arm's, from the wire's centre: the most likely place.
        remote_centre_low_m: Lowest of each component; they are drawn from triangles.
        remote_centre_high_m: Highest.
        base_tilt_rad: Angle between the base's frame and the world's, drawn between these.
        reported_rad: By which the set-up joints misreport the base's rotation: mean and standard deviation.
        reported_range_rad: Within which that is drawn again.
        reported_m: By which they misreport its position.
        reported_spread_m: Standard deviation of each component.
        touch_m: Root mean square of the error of each arm's touches.
        zone_yaw_rad: Standard deviation of the box's turn about the vertical.
        zone_tilt_rad: Standard deviation of its tilts.
        zone_m: Standard deviation of each component of its points as they are touched.
    """

    centre_m: Vector = (0.0, 0.12, -0.13)
    centre_spread_m: NotNegative = 0.03
    remote_centre_m: Vector = (0.165, -0.118, 0.190)
    remote_centre_low_m: Vector = (0.121, -0.139, 0.150)
    remote_centre_high_m: Vector = (0.187, -0.077, 0.207)
    base_tilt_rad: Range = (math.radians(5), math.radians(15))
    reported_rad: tuple[NotNegative, NotNegative] = (math.radians(10), math.radians(2))
    reported_range_rad: Range = (math.radians(6), math.radians(14))
    reported_m: Vector = (0.0, -0.145, 0.265)
    reported_spread_m: NotNegative = 0.02
    touch_m: NotNegative = 0.0022
    zone_yaw_rad: NotNegative = math.radians(8)
    zone_tilt_rad: NotNegative = math.radians(1.5)
    zone_m: NotNegative = 0.0003

    @model_validator(mode="after")
    def _possible(self) -> Scene:
        _ordered(self, "base_tilt_rad", "reported_range_rad")
        if not self.reported_range_rad[0] <= self.reported_rad[0] <= self.reported_range_rad[1]:
            raise ValueError("reported_rad: its mean must lie within reported_range_rad")
        for low, middle, high in zip(
            self.remote_centre_low_m, self.remote_centre_m, self.remote_centre_high_m, strict=True
        ):
            if not low <= middle <= high:
                raise ValueError("remote_centre_m must lie between its lowest and highest")
        return self


class Rules(Section):
    """Where the camera should be and must not be; AutoCam's.

    Attributes:
        distance_m: Wanted from camera to ring.
        floor_m: The camera stays this high above the base of the no-go box.
        proximity_m: And this far from the ring.
        preferred_side: Unit vector: the camera's y axis must not point along it.
    """

    distance_m: Positive = DISTANCE_M
    floor_m: Finite = FLOOR_M
    proximity_m: NotNegative = PROXIMITY_M
    preferred_side: Vector = PREFERRED_SIDE

    @field_validator("preferred_side")
    @classmethod
    def _unit(cls, value: Vector) -> Vector:
        if abs(math.hypot(*value) - 1.0) > 1e-6:
            raise ValueError("preferred_side must be of unit length")
        return value


class WireChaser(Section):
    """A whole preset; the defaults are AutoCam's where it has any.

    Attributes:
        task: Tells presets of this task from others.
        name: Becomes the dataset's name.
        seed: 0 is a seed like any other.
        trials: How many.
        samples: Of each trial; drawn per trial unless given.
        dt_s: Seconds between samples; as long as the authors' loop took (952.4 s for 75463).
        level: How often rules speak against the geometrically best pose: easy 5 to 15 %, standard 35 to 45 %, hard 60
            to 75 % of the samples of every trial, or custom.
        share: That share, from and to; for the level custom.
        tries: How many wires are looked at for a trial until one is within that.
        wire: The wire and the ring.
        hand: How the ring is led along it.
        measurement: How the report of its pose errs.
        scene: The camera arm, the no-go box, and what is known of them.
        rules: Where the camera should be.
        camera_arm: Holds the camera: a name of ``surgbench list camera_arms``, or a file; kept as what that says.
    """

    task: Literal["viewpoint"]
    name: Name
    seed: Annotated[int, Field(ge=0)] = 0
    trials: Annotated[int, Field(ge=1, le=1000)]
    samples: Annotated[int, Field(ge=100, le=1_000_000)] | None = None
    dt_s: Positive = 0.0126
    level: Literal["easy", "standard", "hard", "custom"] = "standard"
    share: tuple[Fraction, Fraction] | None = None
    tries: Annotated[int, Field(ge=1)] = 50_000
    wire: WireSettings = WireSettings()
    hand: Hand = Hand()
    measurement: Measurement = Measurement()
    scene: Scene = Scene()
    rules: Rules = Rules()
    camera_arm: CameraArmSpec | None = None

    @field_validator("camera_arm", mode="before")
    @classmethod
    def _read(cls, value: Any) -> Any:
        return load_camera_arm(value) if isinstance(value, str) else value

    @field_validator("camera_arm", mode="after")
    @classmethod
    def _told(cls, value: CameraArmSpec | None) -> CameraArmSpec | None:
        return unless_default(value)

    @model_serializer(mode="wrap")
    def _short(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Without the default camera arm: presets and their datasets say what they said before there were others."""
        data: dict[str, Any] = handler(self)
        return {key: value for key, value in data.items() if key != "camera_arm" or value is not None}

    @property
    def arm(self) -> CameraArm:
        """Holds the camera."""
        return arm_of(self.camera_arm)

    @model_validator(mode="after")
    def _possible(self) -> WireChaser:
        if (self.share is not None) != (self.level == "custom"):
            raise ValueError("share is for the level custom, which needs it")
        _ordered(self, *(["share"] if self.share else []))
        if self.hand.tremor_hz[1] >= 0.5 / self.dt_s:
            raise ValueError(f"hand.tremor_hz must be below half the sample rate, {0.5 / self.dt_s:g}")
        return self

    @property
    def constrained(self) -> tuple[float, float]:
        """From which to which share of samples rules speak against the best pose."""
        return SHARES[self.level] if self.share is None else self.share
