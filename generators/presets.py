"""Presets: everything that decides what a generated dataset looks like."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, SerializerFunctionWrapHandler, field_validator, model_serializer, model_validator

from surgbench.camera import Camera
from surgbench.camera.plausible import implausible
from surgbench.config import SUFFIXES, Finite, Name, NotNegative, Positive, Section, locate, parse_model, read_yaml
from surgbench.errors import ConfigError, unknown_name
from surgbench.generation import with_settings
from surgbench.generators.looks.sections import Images
from surgbench.generators.sections import (
    Absences,
    Auxiliary,
    Correlation,
    Crossing,
    Fraction,
    Instances,
    Kinematics,
    Mismatch,
    Occluders,
)

Range = tuple[Finite, Finite]


def _less(content: dict[str, Any], **absent: Any) -> dict[str, Any]:
    """A section's content without the keys that have such a value."""
    return {key: value for key, value in content.items() if key not in absent or value != absent[key]}


Half = Literal["nominal", "fast"]


class WaypointInterval(Section):
    """Frames between waypoints; half as many, unless told, where the instruments move fast."""

    nominal: Annotated[int, Field(ge=2)] = 50
    fast: Annotated[int, Field(ge=2)] = 25


class MaxStep(Section):
    """The most that changes from one waypoint to the next.

    The paper's waypoints are every 50th pose of tracked SurgPose recordings. The defaults are how far the motions that
    SurgPose commands (its ``trajectory_generator.m``) go in that time, in the root mean square: roll 0.4 rad and wrist
    pitch 0.3 rad with a period of 100 frames, wrist yaw 0.6 rad and jaw 0.3 rad (half of that is q3) with one of 200,
    positions on a spline through a box of 40 x 30 x 10 mm, which tilts a shaft of 0.2 m by 0.1 rad.

    Attributes:
        position_m: Length of the wrist's way.
        tilt_rad: Each of alpha and gamma.
        roll_rad: beta.
        wrist_rad: Each of q1 and q2.
        jaw_rad: q3.
    """

    position_m: Positive = 0.02
    tilt_rad: Positive = 0.12
    roll_rad: Positive = 0.57
    wrist_rad: Positive = 0.5
    jaw_rad: Positive = 0.15


class Motion(Section):
    """How the instruments move.

    Attributes:
        kind: ``free``: poses are interpolated. ``rcm``: the joints of a whole arm about a fixed remote centre; then
            tilts are those of yaw and pitch, the roll's is that of the arm's roll, and lengths are those of the wrist.
        waypoint_interval: Frames between waypoints.
        fast_share: Share of the pairs, the last ones, that have the ``fast`` intervals and steps.
        max_step: Bounds of the steps between waypoints.
        fast_max_step: The same in those pairs, where it is another.
        ou_rho: Correlation of the Ornstein-Uhlenbeck perturbation from frame to frame.
        ou_sigma_angles_rad: Its stationary standard deviation for alpha, beta, gamma.
        ou_sigma_position_m: The same for x, y, z.
        ou_sigma_joints_rad: The same for q1, q2, q3.
        smoothing: ``butterworth``: of second order, run forwards and backwards. ``one-euro``: the filter of Casiez et
            al. (CHI 2012) at rest, which is exponential smoothing; it runs forwards.
        lowpass_cutoff_hz: Cutoff of the smoothing.
        absences: How the instruments leave the picture and come back; not at all unless told. Free motion only.
        crossing: How the arms cross; unless told, they do as it happens.
    """

    kind: Literal["free", "rcm"] = "free"
    waypoint_interval: WaypointInterval = WaypointInterval()
    fast_share: Fraction = 0.5
    max_step: MaxStep = MaxStep()
    fast_max_step: MaxStep | None = None
    ou_rho: Correlation = 0.99
    ou_sigma_angles_rad: tuple[NotNegative, NotNegative, NotNegative] = (0.01, 0.03, 0.01)
    ou_sigma_position_m: NotNegative = 0.002
    ou_sigma_joints_rad: NotNegative = 0.02
    smoothing: Literal["butterworth", "one-euro"] = "butterworth"
    lowpass_cutoff_hz: Positive = 3.0
    absences: Absences | None = None
    crossing: Crossing | None = None

    @model_validator(mode="after")
    def _free(self) -> Motion:
        if self.absences is not None and self.kind != "free":
            raise ValueError("absences needs kind: free")
        return self

    @model_serializer(mode="wrap")
    def _without_what_is_not_there(self, serialise: SerializerFunctionWrapHandler) -> dict[str, Any]:
        # So that the hash of a dataset that does without does not know of them.
        return _less(serialise(self), fast_max_step=None, smoothing="butterworth", absences=None, crossing=None)

    def longest_step(self, half: Half) -> MaxStep:
        """Bounds of the steps between waypoints in this half of the pairs."""
        return self.fast_max_step or self.max_step if half == "fast" else self.max_step

    def speed(self, half: Half) -> Half:
        """What instruments look like there: ``fast`` where they go further a frame in the fast half than in the other.

        Waypoints of fast recordings that are stretched over more frames make no fast sequence.
        """
        paces = (
            np.array(list(self.longest_step(one).model_dump().values())) / getattr(self.waypoint_interval, one)
            for one in ("nominal", "fast")
        )
        nominal, fast = paces
        return half if bool((fast > nominal).any()) else "nominal"


class Workspace(Section):
    """Where waypoints may be.

    Attributes:
        joints_rad: Ranges of q1, q2 and q3; the instrument's own ``generate_rad`` unless told.
        distance_m: From the camera to the wrist.
        elevation_rad: Angle between the shaft and the image plane, jaws pointing away from the camera.
        direction_rad: Where the left arm's jaws point in the image: 0 right, positive down. Mirrored for the right.
        reach: How far across the image from its own side the middle of an arm's tips may be, as a share of the width.
        tip_margin: Tips stay this far inside the image, as a share of its height, in every frame.
        waypoint_margin: The same, before the perturbation.
        clearance_m: Between the centre lines of the two arms, in every frame.
    """

    distance_m: Range = (0.10, 0.17)
    elevation_rad: Range = (0.5235987755982988, 1.0471975511965976)
    direction_rad: Range = (-0.7, 0.35)
    reach: tuple[Fraction, Fraction] = (0.2, 0.65)
    tip_margin: Annotated[float, Field(ge=0, lt=0.5)] = 0.02
    waypoint_margin: Annotated[float, Field(ge=0, lt=0.5)] = 0.09
    clearance_m: NotNegative = 0.009
    joints_rad: tuple[Range, Range, Range] | None = None

    @model_serializer(mode="wrap")
    def _without_what_is_not_there(self, serialise: SerializerFunctionWrapHandler) -> dict[str, Any]:
        return _less(serialise(self), joints_rad=None)

    @model_validator(mode="after")
    def _ordered(self) -> Workspace:
        ranges = {name: getattr(self, name) for name in ("distance_m", "elevation_rad", "direction_rad", "reach")}
        for place, joint in enumerate(self.joints_rad or ()):
            ranges[f"joints_rad[{place}]"] = joint
        for name, (low, high) in ranges.items():
            if not low < high:
                raise ValueError(f"{name} must be [lower, upper] with lower < upper")
        if self.distance_m[0] <= 0:
            raise ValueError("distance_m must be greater than 0")
        if self.waypoint_margin < self.tip_margin:
            raise ValueError("waypoint_margin must be at least tip_margin")
        return self


class Morphology(Section):
    """One dilation or erosion with a square of ones. A kernel of 1 changes nothing but ends the search for a hit."""

    kernel_px: Annotated[int, Field(ge=1, le=99)]
    probability: Fraction

    @field_validator("kernel_px")
    @classmethod
    def _odd(cls, value: int) -> int:
        if value % 2 == 0:
            raise ValueError("kernel_px must be odd")
        return value


class Blobs(Section):
    """Discs centred on the mask's edge: with ``probability``, a Poisson number of them."""

    radius_px: Annotated[int, Field(ge=1, le=200)]
    mean_count: Annotated[float, Field(ge=0, le=1000)]
    probability: Fraction


class Corruption(Section):
    """What happens to a rendered mask before a tracker sees it.

    Attributes:
        level: Name of the settings: published, strong, none, or custom.
        morphology: Tried in order; the first that hits is applied, and no other.
        dilation_share: How often that is a dilation and not an erosion.
        blobs: Each tried on its own.
        blob_add: Probability that a disc is added.
        blob_remove: Probability that a disc is cut out; otherwise it is left alone.
    """

    level: Literal["published", "strong", "none", "custom"] = "custom"
    morphology: tuple[Morphology, ...] = (
        Morphology(kernel_px=1, probability=0.1),
        Morphology(kernel_px=1, probability=0.05),
        Morphology(kernel_px=3, probability=0.05),
    )
    dilation_share: Fraction = 0.5
    blobs: tuple[Blobs, ...] = (
        Blobs(radius_px=3, mean_count=20, probability=0.2),
        Blobs(radius_px=7, mean_count=5, probability=0.1),
        Blobs(radius_px=11, mean_count=3, probability=0.05),
    )
    blob_add: Fraction = 0.5
    blob_remove: Fraction = 0.0

    @model_validator(mode="after")
    def _shares(self) -> Corruption:
        if self.blob_add + self.blob_remove > 1:
            raise ValueError("blob_add + blob_remove must be at most 1")
        return self


CorruptionLevel = Literal["published", "strong", "none"]
CORRUPTION_LEVELS: dict[str, Corruption] = {
    # The settings of the paper's released generator: discs are only ever added, half of those drawn.
    "published": Corruption(level="published"),
    # Most frames are hit, and the edge is eaten into as often as it is grown, as segmentation networks do.
    "strong": Corruption(
        level="strong",
        morphology=(Morphology(kernel_px=5, probability=0.3), Morphology(kernel_px=3, probability=0.5)),
        blobs=(
            Blobs(radius_px=3, mean_count=20, probability=0.6),
            Blobs(radius_px=7, mean_count=8, probability=0.5),
            Blobs(radius_px=11, mean_count=4, probability=0.3),
        ),
        blob_add=0.5,
        blob_remove=0.5,
    ),
    "none": Corruption(level="none", morphology=(), blobs=()),
}


class Keypoints(Section):
    """Tip keypoints as a detector would give them.

    Attributes:
        noise_px: Standard deviation of each coordinate.
        dropout: Probability that a tip is not seen in a frame.
    """

    noise_px: NotNegative = 1.5
    dropout: Fraction = 0.03


class Readings(Section):
    """Joint readings of a cable-driven wrist: q + bias + drift + stretch + noise, per joint. Our choice, not published.

    Attributes:
        bias_rad: Standard deviation of what is constant over a sequence.
        drift_rad: Stationary standard deviation of what changes slowly.
        drift_rho: Its correlation from frame to frame.
        stretch_rad: How far the reading runs ahead of a moving joint, its cables stretched.
        noise_rad: Standard deviation of what is new in every frame.
        lag_frames: How far readings, tool poses included, are behind the images, drawn for each sequence; below 0 they
            are ahead.
    """

    bias_rad: NotNegative = 0.02
    drift_rad: NotNegative = 0.01
    drift_rho: Correlation = 0.995
    stretch_rad: NotNegative = 0.0
    noise_rad: NotNegative = 0.002
    lag_frames: tuple[Finite, Finite] = (0.0, 0.0)

    @field_validator("lag_frames")
    @classmethod
    def _ordered(cls, value: tuple[float, float]) -> tuple[float, float]:
        if value[0] > value[1]:
            raise ValueError("must be [least, most] with least <= most")
        return value

    @model_serializer(mode="wrap")
    def _without_what_is_not_there(self, serialise: SerializerFunctionWrapHandler) -> dict[str, Any]:
        content: dict[str, Any] = serialise(self)
        return content if self.lag_frames != (0.0, 0.0) else _less(content, lag_frames=content["lag_frames"])


# The left camera of SurgPose at half size, as the paper's code uses it.
PAPER_CAMERA = Camera(width=700, height=493, fx=905.955, fy=904.820, cx=294.280, cy=238.699)

NO_OCCLUDERS = Occluders()


class Preset(Section):
    """A whole preset; the defaults are those of ``paper-wide``.

    Attributes:
        name: Becomes the dataset's name.
        seed: 0 is a seed like any other.
        pairs: Sequences, each with a left and a right arm.
        frames: Per sequence.
        lengths: Frames of each sequence, at most ``frames``, in turn, where they are not all as long.
        dt_s: Seconds between frames.
        camera: Intrinsics.
        instrument: Built-in name or instrument file, for both arms. In a preset file, a path is relative to it.
        motion: How the instruments move.
        workspace: Where they move.
        corruption: Settings, or a level: published, strong, none.
        keypoints: Noise of the tip keypoints.
        readings: Errors of the joint readings.
        kinematics: Errors of the robot's reading of its tool pose.
        mismatch: How the real camera and instrument differ from those that are declared; not at all unless told.
        auxiliary: Further cameras; none unless told.
        instances: Masks of what is seen of each arm, and how much that is; none unless told.
        occluders: What else is in the way; nothing unless told.
        images: Images beside the masks; none unless told.
    """

    name: Name
    seed: Annotated[int, Field(ge=0)] = 0
    pairs: Annotated[int, Field(ge=1, le=1000)]
    frames: Annotated[int, Field(ge=2, le=1_000_000)]
    lengths: tuple[Annotated[int, Field(ge=2)], ...] = ()
    dt_s: Positive = 1 / 30
    camera: Camera = PAPER_CAMERA
    instrument: str = "large_needle_driver"
    motion: Motion = Motion()
    workspace: Workspace = Workspace()
    corruption: Corruption = CORRUPTION_LEVELS["published"]
    keypoints: Keypoints = Keypoints()
    readings: Readings = Readings()
    kinematics: Kinematics = Kinematics()
    mismatch: Mismatch = Mismatch()
    auxiliary: Auxiliary | None = None
    instances: Instances | None = None
    occluders: Occluders = NO_OCCLUDERS
    images: Images | None = None

    def length(self, index: int) -> int:
        """Frames of a pair."""
        return min(self.frames, self.lengths[index % len(self.lengths)]) if self.lengths else self.frames

    def half(self, index: int) -> Half:
        """Which half of the pairs a pair is in: the last ones, ``fast_share`` of all, have the fast waypoints."""
        return "fast" if index >= self.pairs - int(self.pairs * self.motion.fast_share) else "nominal"

    @model_serializer(mode="wrap")
    def _without_what_is_not_there(self, serialise: SerializerFunctionWrapHandler) -> dict[str, Any]:
        content: dict[str, Any] = serialise(self)
        if not self.lengths:
            del content["lengths"]
        return _less(content, auxiliary=None, instances=None, images=None, occluders=NO_OCCLUDERS.model_dump())

    @model_validator(mode="after")
    def _possible(self) -> Preset:
        if self.camera.is_distorted:
            raise ValueError("camera.distortion must be left out or zero: a lens is in mismatch.distortion")
        if problem := implausible(self.camera):
            raise ValueError(f"camera.{problem}")
        if self.occluders != NO_OCCLUDERS and self.instances is None:
            raise ValueError("occluders needs the section instances, which says how much of the arms is seen")
        if self.motion.lowpass_cutoff_hz >= 0.5 / self.dt_s:
            raise ValueError(f"motion.lowpass_cutoff_hz must be below half the frame rate, {0.5 / self.dt_s:g}")
        return self


def _parse(content: dict[str, Any], source: str) -> Preset:
    """A preset from a file's content, in which a level stands for all settings of the corruption."""
    level = content.get("corruption")
    if isinstance(level, str):
        if level not in CORRUPTION_LEVELS:
            raise ConfigError(f"{source}: {unknown_name('corruption level', level, CORRUPTION_LEVELS)}")
        content = {**content, "corruption": CORRUPTION_LEVELS[level].model_dump(mode="json")}
    return parse_model(Preset, content, source)


def load_preset(
    name_or_path: str | Path,
    *,
    pairs: int | None = None,
    frames: int | None = None,
    seed: int | None = None,
    corruption: str | None = None,
    settings: Mapping[str, Any] | None = None,
) -> Preset:
    """Load a preset and put the given options over it.

    Args:
        name_or_path: A built-in name, or a file (any ``Path``, a string with a slash, or one ending in ``.yaml``).
        pairs: Overrides the file's.
        frames: Overrides the file's.
        seed: Overrides the file's.
        corruption: Level that overrides the file's settings.
        settings: Keys of the preset and their values, which override the file's.

    Raises:
        NotFoundError: No built-in preset has this name.
        ConfigError: The file is missing or wrong, or an option has a value that will not do; one line.
    """
    overrides = {"pairs": pairs, "frames": frames, "seed": seed, "corruption": corruption}
    given = {key: value for key, value in overrides.items() if value is not None}
    path = locate("presets", "preset", name_or_path)
    content = read_yaml(path, "preset")
    if content.get("task", "instrument") != "instrument":
        raise ConfigError(f"{path}: a preset of the {content['task']} task; expected one of the instrument task")
    preset = _parse({key: value for key, value in content.items() if key not in ("task", "generator")}, str(path))
    if "/" in preset.instrument or preset.instrument.lower().endswith(SUFFIXES):
        preset = preset.model_copy(update={"instrument": str(path.parent.absolute() / preset.instrument)})
    if settings:
        preset = _with_settings(preset, settings)
    if not given:
        return preset
    names = {"pairs": "--sequences"}
    for key, value in given.items():
        # One at a time, so that the message names the option and not the file.
        try:
            _parse({**preset.model_dump(mode="json"), key: value}, names.get(key, f"--{key}"))
        except ConfigError as error:
            raise ConfigError(str(error).replace(f"'{key}': ", "", 1)) from None
    return _parse({**preset.model_dump(mode="json"), **given}, str(path))


def _with_settings(preset: Preset, settings: Mapping[str, Any]) -> Preset:
    content = with_settings(preset.model_dump(mode="json"), settings)
    if "corruption.level" not in settings and any(key.startswith("corruption.") for key in settings):
        content["corruption"]["level"] = "custom"
    return _parse(content, "--set")
