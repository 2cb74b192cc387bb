"""Parts of a preset about what the robot reads of itself, and where data and tracker differ."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, field_validator, model_validator

from surgbench.camera import Camera
from surgbench.camera.plausible import implausible
from surgbench.config import Finite, NotNegative, Positive, Section
from surgbench.errors import SurgbenchError
from surgbench.registry import find
from surgbench.viewpoint.optics.stereo import AUTOCAM_STEREO

Fraction = Annotated[float, Field(ge=0, le=1)]
Correlation = Annotated[float, Field(ge=0, lt=1)]


class Kinematics(Section):
    """How the robot's reading of its tool pose errs, and the calibration of its base. Our choice, not published.

    With ``motion.kind: rcm`` the reading is the forward kinematics of disturbed joints: radians are those of yaw,
    pitch and roll, metres those of the insertion. With ``free`` there is no robot: drift and noise are those of one
    transform that lumps all errors together (rotation vector and translation in the camera frame).

    Attributes:
        hand_eye_rad: Standard deviation of the base's nominal place in the camera, each component of a rotation vector.
        hand_eye_m: The same, each component of its translation.
        bias_rad: Standard deviation of what is constant over a sequence; ``rcm`` only.
        bias_m: The same.
        drift_rad: Stationary standard deviation of what changes slowly.
        drift_m: The same.
        drift_rho: Its correlation from frame to frame.
        stretch_rad: How far the reading runs ahead of a moving joint, its cables stretched; ``rcm`` only.
        stretch_m: The same.
        noise_rad: Standard deviation of what is new in every frame.
        noise_m: The same.
    """

    hand_eye_rad: NotNegative = 0.015
    hand_eye_m: NotNegative = 0.002
    bias_rad: NotNegative = 0.005
    bias_m: NotNegative = 0.0005
    drift_rad: NotNegative = 0.003
    drift_m: NotNegative = 0.0005
    drift_rho: Correlation = 0.998
    stretch_rad: NotNegative = 0.003
    stretch_m: NotNegative = 0.0005
    noise_rad: NotNegative = 0.0002
    noise_m: NotNegative = 0.00005


Frames = Annotated[int, Field(ge=1)]


def _few_to_most(section: Section, *names: str) -> None:
    for name in names:
        low, high = getattr(section, name)
        if low > high:
            raise ValueError(f"{name} must be [fewest, most] with fewest <= most")


class Instances(Section):
    """What is seen of each arm besides what each arm is: masks of visible parts, and how much is visible.

    Attributes:
        swap_rate: Share of the frames in which the observed masks of the two arms are exchanged, as a segmentation
            confuses them; in the mean over many frames.
        swap_frames: For how many frames in a row, ``[fewest, most]``, drawn evenly.
    """

    swap_rate: Annotated[float, Field(ge=0, lt=1)] = 0.0
    swap_frames: tuple[Frames, Frames] = (1, 15)

    @model_validator(mode="after")
    def _ordered(self) -> Instances:
        _few_to_most(self, "swap_frames")
        return self


class Occluders(Section):
    """What else is in the way, each with a level from 0 (not at all) to 1.

    Attributes:
        tissue: A smooth blob in front of the arms that moves slowly. The level is the share of their ends (wrist, jaws
            and 3 cm of the shaft, as far as they are in the picture) that it hides, in the mean over a sequence.
        dropout: Spots of smoke and blood on the arms' ends, where a segmentation sees nothing; each grows and fades.
            The level is that share again.
        outside: Each arm is drawn back along its shaft, most of the time, until that share of wrist and jaws is out of
            the picture.
        third_tool: A third instrument, nearer to the camera, that nobody tracks. The level is the share of the frames
            in which it is in the picture. Its mask is part of that of both arms, and in each of its visits of one
            arm's or of none.
    """

    tissue: Fraction = 0.0
    dropout: Fraction = 0.0
    outside: Fraction = 0.0
    third_tool: Fraction = 0.0


class Crossing(Section):
    """How the arms cross in the picture, one before the other: both come, stay for a while, and part again.

    Attributes:
        share: Of the frames, in which the arms overlap in the picture.
        full: Of the crossings, in which wrist and jaws of the arm behind are to be hidden all but wholly; at the others
            the arm behind is crossed by the other's shaft or jaws.
        stay_frames: For how many frames they stay crossed, ``[fewest, most]``, drawn evenly; the ways there and back
            take more.
    """

    share: Annotated[float, Field(gt=0, le=0.9)] = 0.6
    full: Fraction = 0.75
    stay_frames: tuple[Frames, Frames] = (5, 60)

    @model_validator(mode="after")
    def _ordered(self) -> Crossing:
        _few_to_most(self, "stay_frames")
        return self


class Absences(Section):
    """How an instrument is drawn back along its shaft until nothing of it shows, and put in again.

    Each is ``[fewest, most]`` frames, drawn evenly and anew every time, for each arm on its own.

    Attributes:
        every_frames: In its place, before the first absence and between two.
        out_frames: Drawn back all the way, without the ways there and back, whose last frames show nothing either.
        travel_frames: Each way.
    """

    every_frames: tuple[Frames, Frames] = (40, 100)
    out_frames: tuple[Frames, Frames] = (2, 36)
    travel_frames: tuple[Frames, Frames] = (20, 40)

    @model_validator(mode="after")
    def _ordered(self) -> Absences:
        _few_to_most(self, *type(self).model_fields)
        return self


# The left one of AutoCam's stereo pair at the size at which it is used (arXiv 2505.10398, published calibration). Masks
# are those of its undistorted picture.
AUTOCAM_CAMERA: Camera = AUTOCAM_STEREO.left.pinhole


class Auxiliary(Section):
    """Further cameras that follow an instrument, each arm with cameras of its own.

    The world's z axis points up, and the endoscope looks along its y axis and down. What a camera follows is a point in
    the plane of the jaws, on the tool's z axis; the normal along which it is to be seen is the tool's y axis, as in
    AutoCam (the jaws open along it), or x (they turn about it), in that sense of the two which is nearer to the camera
    arm over the sequence.

    Attributes:
        camera: Of all views.
        views: Which there are: names of the viewpoint controllers that move the cameras.
        endoscope_pitch_rad: How far below the horizon the endoscope looks.
        feature_m: From the wrist's yaw axis to what is followed; the jaws' tips are at 9 mm.
        normal: Axis of the tool frame.
        distance_m: Wanted from camera to feature; d_t of AutoCam.
        calibration_rad: Standard deviation of what the reported T_view_cam is turned by over a whole sequence, each
            component of a rotation vector in the view's frame. It is the same for all views of a sequence.
        calibration_m: The same, each component of a translation.
        jitter_rad: Standard deviation of what is new in every frame.
        jitter_m: The same.
    """

    camera: Camera = AUTOCAM_CAMERA
    views: Annotated[tuple[str, ...], Field(min_length=1)] = ("static", "gaze")
    endoscope_pitch_rad: Annotated[float, Field(ge=0, lt=1.57)] = 0.7853981633974483
    feature_m: Finite = 0.009
    normal: Literal["x", "y"] = "y"
    distance_m: Positive = 0.11
    calibration_rad: NotNegative = 0.005235987755982988
    calibration_m: NotNegative = 0.001
    jitter_rad: NotNegative = 0.0
    jitter_m: NotNegative = 0.0001

    @field_validator("camera")
    @classmethod
    def _undistorted(cls, value: Camera) -> Camera:
        if value.is_distorted:
            raise ValueError("distortion must be left out or zero: masks are those of the undistorted picture")
        if problem := implausible(value):
            raise ValueError(problem)
        return value

    @field_validator("views")
    @classmethod
    def _controllers(cls, value: tuple[str, ...]) -> tuple[str, ...]:
        if len(set(value)) < len(value):
            raise ValueError("a view is named twice")
        for name in value:
            try:
                found = find("tracker", name)
            except SurgbenchError as error:
                raise ValueError(str(error)) from None
            if found.task != "viewpoint":
                raise ValueError(f"'{name}' is no controller of a camera's viewpoint")
        return value


class Mismatch(Section):
    """How what is rendered differs from the camera and the instrument that the dataset declares.

    Attributes:
        body_scale: Size of wrist and jaws, their distances included.
        shaft_radius_scale: Thickness of the shaft.
        jaw_extra_m: How much longer the jaws are, at their tips.
        focal_scale: Of fx and fy.
        centre_offset_px: Of the principal point.
        distortion: Of the lens, OpenCV's order (k1, k2, p1, p2, k3), where the declared camera has none.
        joint_offset_rad: Added to all readings of q1, q2, q3.
    """

    body_scale: Positive = 1.0
    shaft_radius_scale: Positive = 1.0
    jaw_extra_m: Finite = 0.0
    focal_scale: tuple[Positive, Positive] = (1.0, 1.0)
    centre_offset_px: tuple[Finite, Finite] = (0.0, 0.0)
    distortion: Annotated[tuple[Finite, ...], Field(max_length=5)] = ()
    joint_offset_rad: tuple[Finite, Finite, Finite] = (0.0, 0.0, 0.0)

    @field_validator("distortion")
    @classmethod
    def _count(cls, value: tuple[float, ...]) -> tuple[float, ...]:
        if len(value) not in (0, 4, 5):
            raise ValueError("distortion must have 4 or 5 coefficients, k1, k2, p1, p2 and k3, or none")
        return value
