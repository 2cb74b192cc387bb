"""The contract between the suite and whatever plugs into it.

A tracker is any class with a ``name``, ``reset`` and ``step``; a plain array is a valid answer. The base
classes here are for convenience and type checkers: nothing requires inheriting from them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from surgbench.camera import Camera
from surgbench.generation import GenerationPlan, GenerationRequest
from surgbench.geometry import FloatArray
from surgbench.instrument import Instrument
from surgbench.keypoints.found import FoundTips, Tips
from surgbench.state import JointLimits

Mask = NDArray[np.bool_]


# No lambda: views are pickled on their way to a tracker's process.
def no_image() -> None:
    """The image of a view that has none."""


# Masks of two arms that have so much of their union in common are of one and the same arm, or of both.
SAME_SHARE = 0.9


def all_but_same(one: Mask, other: Mask) -> bool:
    """Whether masks of two arms are of one and the same arm, of both, or of nothing."""
    return bool(np.count_nonzero(one & other) >= SAME_SHARE * np.count_nonzero(one | other))


@dataclass(frozen=True, init=False)
class View:
    """What one camera saw in one frame.

    Attributes:
        camera: Intrinsics.
        T_view_cam: ``(4, 4)`` from the reference camera's frame (in which states are given) to this camera's.
        mask: ``(height, width)`` bool: the instruments.
        instance_masks: What shows of each arm, one mask per arm, where the recording tells the arms apart, else
            ``None``. Their identities may be exchanged, and together they need not be ``mask``: a segmenter made them.
        image: Call it for the ``(height, width, 3)`` uint8 RGB image; ``None`` where there are no images.
        found: What ``keypoints`` and ``tips`` are made from when one of them is first looked at: who looks at neither
            does not wait for the keypoint source.

    Args:
        keypoints: Per arm ``(2, 2)`` tip pixels in no particular order, ``(1, 2)`` where one is seen, or ``None``; also
            as a keyword of ``dataclasses.replace``.

    Example:
        The reference camera, an empty mask, both tips of one arm and one of another:

        >>> import numpy as np
        >>> from surgbench.camera import Camera
        >>> from surgbench.contract import View
        >>> camera = Camera(width=160, height=120, fx=200, fy=200, cx=80, cy=60)
        >>> both = np.array([[80.0, 60.0], [84.0, 61.0]])  # pixels (u, v)
        >>> one = np.array([[20.0, 61.0]])
        >>> view = View(camera, np.eye(4), np.zeros((120, 160), dtype=bool), keypoints=(both, one))
        >>> view.image() is None, view.instance_masks is None
        (True, True)
        >>> [tips.shape for tips in view.tips]
        [(2, 2), (1, 2)]
        >>> view.keypoints[0] is both, view.keypoints[1] is None
        (True, True)
    """

    camera: Camera
    T_view_cam: FloatArray
    mask: Mask
    instance_masks: tuple[Mask, ...] | None
    image: Callable[[], NDArray[np.uint8] | None]
    found: FoundTips = field(repr=False)

    def __init__(
        self,
        camera: Camera,
        T_view_cam: FloatArray,
        mask: Mask,
        instance_masks: tuple[Mask, ...] | None = None,
        keypoints: Tips | None = None,
        image: Callable[[], NDArray[np.uint8] | None] = no_image,
        *,
        found: FoundTips | None = None,
    ) -> None:
        if keypoints is not None or found is None:
            found = FoundTips((None,) if keypoints is None else keypoints)
        values = {"camera": camera, "T_view_cam": T_view_cam, "mask": mask, "instance_masks": instance_masks}
        self.__dict__.update({**values, "image": image, "found": found})

    if TYPE_CHECKING:
        # A field for `replace`, which would look at it otherwise.
        keypoints: Tips
    else:

        @property
        def keypoints(self) -> Tips:
            """Per arm both tips, ``(2, 2)`` pixels in no particular order, or ``None`` where not both were seen."""
            return self.found.pairs

    @property
    def tips(self) -> Tips:
        """Per arm all tips that were seen, ``(2, 2)`` or ``(1, 2)`` pixels, or ``None``."""
        return self.found.every

    @property
    def told_apart(self) -> tuple[Mask, ...] | None:
        """The instance masks, but where two of them are all but the same, or both empty, and so tell nothing apart."""
        alone = self.instance_masks
        if alone is None or len(alone) != 2:
            return alone
        return None if all_but_same(*alone) else alone

    def __getstate__(self) -> dict[str, Any]:
        # As bits a mask fits the buffer of a pipe, so that it reaches a tracker's process in one go.
        alone = self.instance_masks
        packed = None if alone is None else tuple(_packed(mask) for mask in alone)
        return {**self.__dict__, "mask": _packed(self.mask), "instance_masks": packed}

    def __setstate__(self, state: dict[str, Any]) -> None:
        alone = state["instance_masks"]
        masks = None if alone is None else tuple(_unpacked(mask) for mask in alone)
        self.__dict__.update({**state, "mask": _unpacked(state["mask"]), "instance_masks": masks})


def _packed(mask: Mask) -> tuple[tuple[int, ...], NDArray[np.uint8]]:
    return mask.shape, np.packbits(mask)


def _unpacked(packed: tuple[tuple[int, ...], NDArray[np.uint8]]) -> Mask:
    shape, bits = packed
    return np.unpackbits(bits, count=int(np.prod(shape))).reshape(shape).view(np.bool_)


@dataclass(frozen=True)
class Observation:
    """What a tracker may know of one frame.

    Attributes:
        index: Frame number, from 0.
        timestamp_s: Seconds since the first frame. Frames of recordings may be missing, so that the time from one to
            the next is not always :attr:`Scene.dt_s`; :func:`surgbench.timing.step_s` gives it.
        views: At least one; ``views[0]`` is the reference camera.
        start: ``(9 * arms,)`` where this frame's search begins: the filtered state, joints within limits,
            replaced by the readings where there are any.
        joints: Joint readings, ``(3,)`` or ``(2, 3)``, clipped to the search limits; ``None`` without readings.
        kinematics: ``(arms, 4, 4)`` T_base_tool: the robot's own reading of where each arm's wrist-pitch frame is in
            the frame of its base (:attr:`Scene.T_cam_base`), cable stretch and drift included; ``None`` where the
            dataset has none, or without readings.

    Example:
        What ``step`` is called with, here with joint readings:

        >>> from surgbench.tasks.instrument.conformance.scenes import make_play
        >>> frame = make_play(readings=True).observations[3]  # a needle driver in slow motion, 30 frames a second
        >>> frame.index, round(frame.timestamp_s, 9), len(frame.views)
        (3, 0.1, 1)
        >>> frame.mask.shape == (frame.views[0].camera.height, frame.views[0].camera.width)
        True
        >>> frame.start.shape, frame.joints.shape, frame.kinematics is None
        ((9,), (3,), True)
    """

    index: int
    timestamp_s: float
    views: tuple[View, ...]
    start: FloatArray
    joints: FloatArray | None = None
    kinematics: FloatArray | None = None

    @property
    def mask(self) -> Mask:
        """Mask of the reference view."""
        return self.views[0].mask


@dataclass(frozen=True)
class Scene:
    """What stays the same over a sequence.

    Attributes:
        instruments: One per arm.
        views: The cameras, with empty masks.
        limits: Joint box of each arm that states should stay in.
        dt_s: Seconds between frames, as a rule: the median where they differ.
        arms: 1 or 2.
        speed: ``"nominal"`` or ``"fast"``: how fast the instruments move, where the recording's author knows.
        device: Where candidates may be scored: ``"cpu"``, or ``"cuda"`` where the user asks for it.
        T_cam_base: ``(arms, 4, 4)`` nominal place of each arm's base frame in the reference camera, as a hand-eye
            calibration gives it; ``None`` where the dataset has no kinematics.

    Example:
        One needle driver before one camera:

        >>> import numpy as np
        >>> from surgbench.camera import Camera
        >>> from surgbench.contract import Scene, View
        >>> from surgbench.instrument import load_instrument
        >>> camera = Camera(width=160, height=120, fx=200, fy=200, cx=80, cy=60)
        >>> view = View(camera, np.eye(4), np.zeros((120, 160), dtype=bool))
        >>> driver = load_instrument("large_needle_driver")
        >>> scene = Scene((driver,), (view,), (driver.search_limits,), dt_s=1 / 30, arms=1)
        >>> scene.joint_limits.upper_rad  # a row for each arm
        array([[1.5707, 1.3963, 1.5707]])
    """

    instruments: tuple[Instrument, ...]
    views: tuple[View, ...]
    limits: tuple[JointLimits, ...]
    dt_s: float
    arms: int
    speed: str = "nominal"
    device: str = "cpu"
    T_cam_base: FloatArray | None = None

    @property
    def joint_limits(self) -> JointLimits:
        """The boxes of all arms together, ``(arms, 3)``."""
        return JointLimits(
            np.stack([box.lower_rad for box in self.limits]), np.stack([box.upper_rad for box in self.limits])
        )


@dataclass(frozen=True)
class Estimate:
    """A tracker's answer.

    Attributes:
        state: ``(9 * arms,)``.
        confidence: 0 to 1; of all arms together, or ``(arms,)``.
        lost: The tracker itself thinks it has lost the instrument; of all arms together, or ``(arms,)`` bool.
        standard_deviations: ``(9 * arms,)`` how far off the tracker expects each component of the state to be (rad, m,
            rad), as of a Gaussian; all greater than 0. ``None`` where it does not know.

    Example:
        13 cm before the camera, the shaft along its axis, joints straight and jaws closed; not to be trusted:

        >>> import numpy as np
        >>> from surgbench.contract import Estimate
        >>> estimate = Estimate(np.array([0, 0, 0, 0, 0, 0.13, 0, 0, 0]), confidence=0.2, lost=True)

        Two arms, of which the right one has gone behind the other:

        >>> both = np.array([0, 0, 0, 0, 0, 0.13, 0, 0, 0, 0, 0, 0, 0.01, 0, 0.14, 0, 0, 0])
        >>> estimate = Estimate(both, confidence=np.array([0.9, 0.1]), lost=np.array([False, True]))
    """

    state: FloatArray
    confidence: float | FloatArray = 1.0
    lost: bool | NDArray[np.bool_] = False
    standard_deviations: FloatArray | None = None


class Plugin:
    """Base of everything the registry finds by name. ``Config`` holds its options, each with a default.

    Example:
        What ``--set mine.samples=100`` does:

        >>> from pydantic import BaseModel
        >>> from surgbench.contract import Plugin
        >>> class Mine(Plugin):
        ...     name = "mine"
        ...
        ...     class Config(BaseModel):
        ...         samples: int = 50
        ...
        ...     def __init__(self, config):
        ...         self.config = config
        >>> Mine(Mine.Config(samples=100)).config.samples
        100
    """

    name: ClassVar[str]
    summary: ClassVar[str] = ""

    @classmethod
    def unavailable(cls) -> str | None:
        """One line on why it cannot run on this machine; ``None`` where it can.

        Runs that need it are then recorded as ``skipped``. It is called in the command's own process, so that a library
        that may end the process is to be tried in another one. A class without this method is available.
        """
        return None


class InstrumentTracker(Plugin):
    """Estimates the state of one or two instruments frame by frame.

    Attributes:
        one_view: It looks at the reference view alone; then it is not run where there are more.
        reads_images: It looks at ``view.image()``; then images are in memory before the clock starts, and it is not run
            where there are none.

    Example:
        One that believes that nothing moves, and what it is off by in the second frame of a needle driver in motion:

        >>> import numpy as np
        >>> from surgbench.tasks.instrument.conformance.scenes import make_play
        >>> from surgbench.contract import Estimate, InstrumentTracker
        >>> class Still(InstrumentTracker):
        ...     name = "still"
        ...
        ...     def reset(self, scene, state, rng):
        ...         self.state = state.copy()
        ...
        ...     def step(self, observation):
        ...         return Estimate(self.state, lost=not observation.mask.any())
        >>> play, tracker = make_play(frames=2), Still()
        >>> tracker.reset(play.scene, play.truth[0], np.random.default_rng(0))
        >>> estimates = [tracker.step(observation) for observation in play.observations]
        >>> (estimates[1].state - play.truth[1])[3:6].round(6)  # metres
        array([-0.0004, -0.0003, -0.0002])
    """

    task: ClassVar[str] = "instrument"
    one_view: ClassVar[bool] = False
    reads_images: ClassVar[bool] = False

    def reset(self, scene: Scene, state: FloatArray, rng: np.random.Generator) -> None:
        """Start a sequence at ``state`` (``(9 * arms,)``). Untimed; everything slow belongs here."""
        raise NotImplementedError

    def step(self, observation: Observation) -> FloatArray | Estimate:
        """Estimate the state of one frame. Timed."""
        raise NotImplementedError


@dataclass
class Trace:
    """Candidates a tracker looked at in its last step, for drawing: one entry per iteration.

    Attributes:
        states: Each ``(n, 9 * arms)``, best first.
        losses: Each ``(n,)``.
    """

    states: list[FloatArray] = field(default_factory=list)
    losses: list[FloatArray] = field(default_factory=list)


@runtime_checkable
class Traceable(Protocol):
    """A tracker that can show its candidates: set ``trace`` to a :class:`Trace` and it fills it."""

    trace: Trace | None


@runtime_checkable
class Generator(Protocol):
    """Makes datasets from presets."""

    name: ClassVar[str]
    task: ClassVar[str]

    def plan(self, preset: Path, request: GenerationRequest) -> GenerationPlan:
        """What a preset makes, with what is asked for put over it; nothing is made yet.

        Raises:
            ConfigError: The file is wrong, or an option has a value that will not do; one line.
        """
        ...


@runtime_checkable
class Importer(Protocol):
    """Turns a recording into a dataset; its ``Config`` becomes options of ``surgbench import NAME``.

    One whose ``several`` is true takes several recordings in one call: a tuple of paths as ``source``.
    """

    name: ClassVar[str]

    def frames(self, source: Path) -> int:
        """How many frames a recording has, or as many as the work is to be counted in.

        Raises:
            DatasetError: Something in it is missing or wrong; one line.
        """
        ...

    def run(self, source: Path, out: Path, progress: Callable[[float], None]) -> Sequence[str] | None:
        """Make the dataset.

        What it returns is told line by line: what was made of the recording, and what is to be doubted.

        Args:
            source: The recording.
            out: The dataset's folder: new or empty. It appears when the import is complete.
            progress: Takes the number of frames just done.

        Raises:
            SurgbenchError: Something in the source is missing or wrong, ``out`` holds something, or the disk is full.
        """
        ...


@runtime_checkable
class Initialiser(Protocol):
    """Finds the state of a sequence's first frame.

    Example:
        13 cm before the camera, wherever the mask is:

        >>> import numpy as np
        >>> from surgbench.contract import Initialiser
        >>> class Ahead:
        ...     name = "ahead"
        ...     needs_truth = False
        ...
        ...     def initialise(self, scene, observation, rng, truth, progress):
        ...         return np.tile([0, 0, 0, 0, 0, 0.13, 0, 0, 0], scene.arms)
        >>> isinstance(Ahead(), Initialiser)
        True
    """

    name: ClassVar[str]
    needs_truth: ClassVar[bool]

    def initialise(
        self,
        scene: Scene,
        observation: Observation,
        rng: np.random.Generator,
        truth: FloatArray | None,
        progress: Callable[[float], None],
    ) -> FloatArray:
        """State ``(9 * arms,)`` of the first frame.

        Args:
            scene: The sequence's constants.
            observation: The first frame; its ``start`` means nothing yet.
            rng: The only source of randomness.
            truth: True state, given only to initialisers with ``needs_truth``.
            progress: Call it with the fraction done, 0 to 1.
        """
        ...


@runtime_checkable
class StateFilter(Protocol):
    """Says where the next frame's search begins; what it makes of an estimate is reported where a row asks for it.

    Example:
        The change from the last frame to this one, once more:

        >>> import numpy as np
        >>> from surgbench.contract import StateFilter
        >>> class Again:
        ...     name = "again"
        ...
        ...     def reset(self, scene, state):
        ...         self.last = self.state = state
        ...
        ...     def predict(self):
        ...         return 2 * self.state - self.last
        ...
        ...     def update(self, estimate):
        ...         self.last, self.state = self.state, estimate
        ...         return estimate
        >>> isinstance(Again(), StateFilter)
        True
        >>> again, state = Again(), np.array([0, 0, 0, 0, 0, 0.13, 0, 0, 0])
        >>> again.reset(None, state)
        >>> _ = again.update(state + [0, 0, 0, 0.001, 0, 0, 0, 0, 0])
        >>> again.predict()[3:6]  # metres
        array([0.002, 0.   , 0.13 ])
    """

    name: ClassVar[str]

    def reset(self, scene: Scene, state: FloatArray) -> None:
        """Start at ``state``, ``(9 * arms,)``."""
        ...

    def predict(self) -> FloatArray:
        """State predicted for the frame to come, ``(9 * arms,)``."""
        ...

    def update(self, estimate: FloatArray) -> FloatArray:
        """Take a frame's estimate in; returns the filtered state."""
        ...


@runtime_checkable
class TimedFilter(StateFilter, Protocol):
    """A filter that is told how long it is from frame to frame, which differs where a recording lacks frames."""

    def elapse(self, dt_s: float) -> None:
        """Seconds from the last frame to the one to come, called before ``predict``.

        It is :attr:`Scene.dt_s` itself where frames are as far apart as that.
        """
        ...


@runtime_checkable
class OracleFilter(StateFilter, Protocol):
    """A filter that is told the truth: it measures floors, and is never for ranking.

    With one, the first frame's search begins at its true state whatever the initialiser says, and the rows of its runs
    are marked (column ``floor``).
    """

    needs_truth: ClassVar[bool]

    def give_truth(self, states: FloatArray) -> None:
        """The true states of all frames to be run, ``(T, 9 * arms)``; called before ``reset``.

        Frame ``k``'s prediction is asked for after ``k`` calls of ``predict``: the first frame has none.
        """
        ...


@runtime_checkable
class KeypointSource(Protocol):
    """Finds the two tips of each arm in a view.

    It is asked when a tracker first looks at a view's tips, and so perhaps not in every frame: what it finds in a frame
    must not depend on whether it was asked before. One that follows tips from frame to frame says
    ``every_frame = True``, and is asked in all frames in turn, whether anyone looks or not.

    Example:
        It never finds any:

        >>> from surgbench.contract import KeypointSource
        >>> class Blind:
        ...     name = "blind"
        ...
        ...     def reset(self, scene):
        ...         self.arms = scene.arms
        ...
        ...     def detect(self, observation, view):
        ...         return (None,) * self.arms
        >>> isinstance(Blind(), KeypointSource)
        True
    """

    name: ClassVar[str]

    def reset(self, scene: Scene) -> None:
        """Start a sequence."""
        ...

    def detect(self, observation: Observation, view: View) -> tuple[FloatArray | None, ...]:
        """Per arm ``(2, 2)`` pixels, ``(1, 2)`` where one tip was found, ``None`` where none was.

        Args:
            observation: The frame; its views have the dataset's own tips.
            view: Which of them.
        """
        ...
