"""Rows of the viewpoint task, complete."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Any, ClassVar

from surgbench.errors import ConfigError
from surgbench.registry import find
from surgbench.suite.asked import Conditions
from surgbench.suite.plug import plug
from surgbench.suite.settings import Settings
from surgbench.suite.slices import cut
from surgbench.tasks.viewpoint.asked import ViewpointRow, WorksFrom
from surgbench.tasks.viewpoint.dataset import ViewpointDataset
from surgbench.viewpoint.disturbance import Disturbance
from surgbench.viewpoint.registration import Method


@dataclass(frozen=True)
class ViewpointSettings(Settings):
    """Settings of a row of the viewpoint task.

    Attributes:
        registration: How the touched points correct the camera arm's base.
        missing_face: The no-go zone as in the published code.
        photographs_hz: How many stereo pictures a second the feature is looked for in.
        disturbance: How much harder the trials are made.
        foresees: The controller is told the whole trial beforehand, which no real one can be.
        hand: Whose picture a simulated hand works by; ``None`` where the trial's own hand leads the ring.
        steady: The tool does not turn where teleoperation takes the view anew.
    """

    registration: Method
    missing_face: bool
    photographs_hz: float = 0.0
    disturbance: Disturbance = field(default_factory=Disturbance)
    foresees: bool = False
    hand: WorksFrom | None = None
    steady: bool = False

    task: ClassVar[str] = "viewpoint"

    @property
    def floor(self) -> bool:
        """Whether the controller knew what was to come."""
        return self.foresees

    def spec(self) -> dict[str, Any]:
        """Adds what the controller is told of the world."""
        spec = {**super().spec(), "registration": self.registration, "missing_face": self.missing_face}
        if levels := self.disturbance.levels():  # so that the hashes of undisturbed runs do not know of any
            spec["disturbance"] = levels
        if self.hand is not None:
            spec |= {"hand": self.hand, "steady": self.steady}
        return {**spec, "photographs_hz": self.photographs_hz} if self.photographs_hz else spec

    def words(self) -> list[str]:
        """Adds what the controller is told of the world."""
        words = ["FLOOR, NOT FOR RANKING: told the whole trial beforehand"] if self.foresees else []
        words += super().words()
        if self.registration != "translation":
            words.append(f"registration {self.registration}")
        if self.missing_face:
            words.append("zone without its fourth side")
        if self.photographs_hz:
            words.append(f"{self.photographs_hz:g} pictures a second")
        if self.hand is not None:
            words.append(f"a hand by the picture of the {self.hand}")
        if self.steady:
            words.append("a steady tool")
        return [*words, *self.disturbance.words()]


def complete(row: ViewpointRow, conditions: Conditions, dataset: ViewpointDataset) -> ViewpointSettings:
    """Look up a row's controller, check its options, and fill in the defaults.

    Raises:
        NotFoundError: A name that is not registered.
        ConfigError: A wrong option, or something that this task has not.
    """
    if conditions.device != "cpu" or conditions.arms != "single":
        raise ConfigError(f"--device and --arms are for the instrument task; '{dataset.name}' is of the viewpoint task")
    tracker = plug("tracker", row.tracker, row.options, "viewpoint")
    disturbance = Disturbance(**{level.name: getattr(row, level.name) for level in fields(Disturbance)})
    _check_hand(row, disturbance, dataset)
    return ViewpointSettings(
        row_id=row.row_id or "-".join([tracker.name, *filter(None, [row.hand]), *(["steady"] if row.steady else [])]),
        tracker=tracker,
        conditions=conditions,
        sequences=row.sequences,
        frames_limit=cut(row, [dataset.sequence(unit.sequence).frames for unit in dataset.units()]),
        registration=row.registration,
        missing_face=row.missing_face,
        photographs_hz=row.photographs_hz,
        disturbance=disturbance,
        foresees=bool(getattr(find("tracker", tracker.reference).cls, "foresees", False)),
        hand=row.hand,
        steady=row.steady,
    )


def _check_hand(row: ViewpointRow, disturbance: Disturbance, dataset: ViewpointDataset) -> None:
    """See that a simulated hand can do what is asked of it, as far as can be seen before the work."""
    if row.hand is None:
        if row.steady:
            raise ConfigError("--steady: is for a simulated hand; give --hand endoscope or --hand auxiliary")
        return
    if disturbance.levels():
        raise ConfigError("--hand: a simulated hand has its own noise; disturbances are for the trials' own motion")
    without = [trial.id for trial in dataset.trials if not trial.entry.truth]
    if without:
        raise ConfigError(
            f"--hand: trial '{without[0]}' of '{dataset.name}' has no truth, so no wire to lead a ring on"
        )
    controller = find("tracker", row.tracker).cls
    if getattr(controller, "elsewhere", False):
        raise ConfigError(f"--hand: '{row.tracker}' is in another process; the bridge plays trials' own motion only")
    if getattr(controller, "foresees", False):
        raise ConfigError(f"--hand: '{row.tracker}' must know the ring's way beforehand, which a hand only makes")
