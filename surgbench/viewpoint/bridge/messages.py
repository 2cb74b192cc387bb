"""What is said over the bridge, protocol 1: one JSON object a line, told apart by its ``type``.

Numbers are SI, joints ``(6,)`` in the order of :class:`surgbench.viewpoint.camera_arm.CameraArm`, poses four rows of
four. A number that is not finite is refused. Unknown keys are refused too, so that a misspelt one is noticed.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal, TypeVar

from pydantic import ConfigDict, Field, ValidationError, model_validator

from surgbench.config import Finite, NotNegative, Positive, Section, explain
from surgbench.kinds import NAME_PATTERN

PROTOCOL = 1

Three = tuple[Finite, Finite, Finite]
Six = tuple[Finite, Finite, Finite, Finite, Finite, Finite]
_Row = tuple[Finite, Finite, Finite, Finite]
Pose = tuple[_Row, _Row, _Row, _Row]
Line = Annotated[str, Field(max_length=2000)]
Id = Annotated[str, Field(max_length=100)] | int


class MessageError(Exception):
    """What was said is no message; one line that says why."""


class Message(Section):
    """Base of all."""

    def encode(self) -> bytes:
        """As a line."""
        return self.model_dump_json(exclude_none=False).encode() + b"\n"


class Hello(Message):
    """The first of a client.

    Attributes:
        protocol: That it speaks.
        name: Of the controller, as tables have it.
        version: Of the controller: records of another version are other records.
    """

    type: Literal["hello"] = "hello"
    protocol: int
    name: Annotated[str, Field(pattern=f"^{NAME_PATTERN}$", max_length=100)] = "remote"
    version: Annotated[str, Field(max_length=100)] = ""


class ArmEntry(Section):
    """The arm that holds the camera.

    Attributes:
        insertion_offset_m: Of the insertion's joint, and
        roll_offset_m: of the roll's, and
        wrist_length_m: from the wrist's pitch axis to its yaw axis: the kinematics
            (:mod:`surgbench.viewpoint.kinematics`).
        camera_m: From the tool's origin along its z to the camera.
        lower: Joint limits.
        upper: Joint limits.
        velocity: Largest, of the joints.
        acceleration: Largest, of the joints.
    """

    insertion_offset_m: Finite
    roll_offset_m: Finite
    wrist_length_m: Finite
    camera_m: Finite
    lower: Six
    upper: Six
    velocity: tuple[Positive, Positive, Positive, Positive, Positive, Positive]
    acceleration: tuple[Positive, Positive, Positive, Positive, Positive, Positive]


class WorkspaceEntry(Section):
    """Where the camera must not be.

    Attributes:
        zone_m: Five points around the no-go zone: A, B, C, D around its base, E at the height of its top.
        missing_face: Its side from D to A is open.
        floor_m: The camera stays this high above the base of the zone.
        proximity_m: And this far from the feature.
        preferred_side: Unit vector: the camera's y axis must not point along it.
    """

    zone_m: tuple[Three, Three, Three, Three, Three]
    missing_face: bool = False
    floor_m: Finite
    proximity_m: NotNegative
    preferred_side: Three


class SceneMessage(Message):
    """A trial begins, the arm at rest; answered with :class:`Ready`.

    Attributes:
        id: To be echoed.
        dt_s: Seconds between steps.
        servo_lag_s: Time constant with which the joints follow their set points, as far as is known.
        distance_m: Wanted from camera to feature.
        registration_error_m: What the registration of the arm's base states of its own error.
        T_world_base: Where the arm's base is, as reported.
        joints: Where the arm is.
        seed: For whatever is random in a controller.
        arm: Unless told by a client, the camera arm of ``surgbench``.
        workspace: The rules.
    """

    type: Literal["scene"] = "scene"
    id: Id
    dt_s: Positive
    servo_lag_s: NotNegative
    distance_m: Positive
    registration_error_m: NotNegative = 0.0
    T_world_base: Pose
    joints: Six
    seed: Annotated[int, Field(ge=0, lt=2**53)] = 0
    arm: ArmEntry | None = None
    workspace: WorkspaceEntry


class Ready(Message):
    """The answer to a scene, when everything slow is done."""

    type: Literal["ready"] = "ready"
    id: Id


class ObservationMessage(Message):
    """A step; answered with :class:`Command`.

    Attributes:
        id: To be echoed.
        index: Step, from 0.
        timestamp_s: Seconds since the first.
        T_world_feature: As measured: origin in the ring's centre, y axis along its normal. ``None`` from a client where
            it was not measured or is stale: the answer is to come to rest.
        joints: Measured.
        setpoint: What the joints are being told.
        setpoint_velocity: How fast that moves.
    """

    type: Literal["observation"] = "observation"
    id: Id
    index: Annotated[int, Field(ge=0)]
    timestamp_s: Finite
    T_world_feature: Pose | None
    joints: Six
    setpoint: Six
    setpoint_velocity: Six


class Command(Message):
    """The answer to an observation: where the arm should go.

    Attributes:
        id: Of the observation.
        joints: This, or
        pose: T_world_camera, which the arm turns into joints.
        mode: ``move``: go there and stop; ``servo``: be there at the next step.
        velocity: At the target; ``servo`` only.
        active: Rules active in the controller's own view.
        solver: Whether it had to optimise.
        held: From ``surgbench``: why the arm is to come to rest and not to follow.
    """

    type: Literal["command"] = "command"
    id: Id
    joints: Six | None = None
    pose: Pose | None = None
    mode: Literal["move", "servo"] = "move"
    velocity: Six | None = None
    active: Annotated[tuple[Annotated[str, Field(max_length=100)], ...], Field(max_length=10)] = ()
    solver: bool = False
    held: Line | None = None

    @model_validator(mode="after")
    def _one_target(self) -> Command:
        if (self.joints is None) == (self.pose is None):
            raise ValueError("a command has either 'joints' or 'pose'")
        return self


class ErrorMessage(Message):
    """Something is wrong, by whoever notices; one line.

    Attributes:
        id: Of the message that it is about, where there is one.
        error: What.
    """

    type: Literal["error"] = "error"
    id: Id | None = None
    error: Line


class Bye(Message):
    """It is over."""

    type: Literal["bye"] = "bye"


Said = TypeVar("Said", bound=Message)
_TYPES: dict[str, type[Message]] = {
    str(model.model_fields["type"].default): model
    for model in (Hello, SceneMessage, Ready, ObservationMessage, Command, ErrorMessage, Bye)
}


class _Head(Section):
    model_config = ConfigDict(extra="ignore")

    type: Annotated[str, Field(max_length=100)]


def decode(line: bytes) -> Message:
    """The message of a line.

    Raises:
        MessageError: It is none.
    """
    try:
        name = _Head.model_validate_json(line, strict=True).type
    except ValidationError as error:
        raise MessageError(f"no message ({_explain(_Head, error)})") from None
    if name not in _TYPES:
        raise MessageError(f"a message of an unknown type {name!r} (known: {', '.join(_TYPES)})")
    model = _TYPES[name]
    try:
        return model.model_validate_json(line, strict=True)
    except ValidationError as error:
        raise MessageError(f"a wrong '{name}' ({_explain(model, error)})") from None


def _explain(model: type[Section], error: ValidationError) -> str:
    return " ".join(explain(model, error).split())[:300]


def rows(pose: Any) -> Any:
    """A ``(4, 4)`` array, or one of points, as messages have it."""
    return tuple(tuple(row) for row in pose.tolist())
