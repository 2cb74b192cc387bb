"""Rows of the instrument task, complete."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

from surgbench.errors import ConfigError, unknown_name
from surgbench.registry import find
from surgbench.suite.asked import Conditions
from surgbench.suite.plug import plug
from surgbench.suite.settings import Plug, Settings, flat
from surgbench.suite.slices import cut
from surgbench.tasks.instrument.asked import InstrumentRow, Masks, Readings, Scored
from surgbench.tasks.instrument.dataset import InstrumentDataset


@dataclass(frozen=True)
class InstrumentSettings(Settings):
    """Settings of a row of the instrument task.

    Attributes:
        view: Auxiliary view that the tracker is given besides the endoscope's.
        masks: What it is shown: the mask of all arms alone (``union``), or ``instances`` besides.
        scored: Which state is scored.
    """

    initialiser: Plug
    filter: Plug
    keypoints: Plug
    readings: Readings
    view: str | None = None
    masks: Masks = "union"
    scored: Scored = "raw"

    task: ClassVar[str] = "instrument"

    @property
    def plugs(self) -> tuple[Plug, ...]:
        """All plug-ins of the row."""
        return self.tracker, self.initialiser, self.filter, self.keypoints

    @property
    def floor(self) -> bool:
        """Whether the filter knew the truth."""
        return self.filter.needs_truth

    def spec(self) -> dict[str, Any]:
        """Adds the readings, and a view besides the endoscope's, masks of single arms and a scored state where set."""
        spec = {**super().spec(), "readings": self.readings}
        if self.scored != "raw":
            spec["scored"] = self.scored
        if self.masks != "union":
            spec["masks"] = self.masks
        return spec if self.view is None else {**spec, "view": self.view, "views": 2}

    def words(self) -> list[str]:
        """Adds the other plug-ins."""
        words = ["FLOOR, NOT FOR RANKING: every search starts from the truth"] if self.floor else []
        words += super().words()
        if self.readings != "none":
            words.append(f"{self.readings} readings")
        if self.view is not None:
            words.append(f"also the view {self.view}")
        if self.masks == "instances":
            words.append("a mask for each arm")
        if self.scored == "filtered":
            words.append("the filtered state is scored")
        if self.conditions.device != "cpu":
            words.append(f"device {self.conditions.device}")
        usual_keypoints = usual_keypoint_source(self.readings)
        for one, usual in ((self.filter, "kalman"), (self.keypoints, usual_keypoints), (self.initialiser, "truth")):
            if one.name != usual or one.changed:
                changed = ", ".join(f"{key}={value}" for key, value in flat(one.changed))
                words.append(f"{one.kind} {one.name}" + (f" ({changed})" if changed else ""))
        return words


def usual_keypoint_source(readings: Readings, has_tips: bool = True) -> str:
    """The keypoint source of rows that name none: without readings only what the mask shows."""
    return "observed" if readings != "none" and has_tips else "resnet18"


def complete(row: InstrumentRow, conditions: Conditions, dataset: InstrumentDataset) -> InstrumentSettings:
    """Look up everything a row names, check its options, and fill in the defaults.

    Raises:
        NotFoundError: A name that is not registered.
        ConfigError: A wrong option, something that the dataset has not, or a device that is not there.
    """
    if conditions.device != "cpu":
        from surgbench.silhouette.torch_evaluator import check_device

        check_device(conditions.device)
    has_truth = all(sequence.entry.truth for sequence in dataset.sequences)
    has_readings = all(sequence.entry.readings for sequence in dataset.sequences)
    tracker = plug("tracker", row.tracker, row.options, "instrument")
    initialiser = plug(
        "initialiser", row.initialiser or ("truth" if has_truth else "random"), row.options, "instrument"
    )
    state_filter = plug("filter", row.filter, row.options, "instrument")
    has_tips = all(sequence.entry.keypoints for sequence in dataset.sequences)
    keypoints_name = row.keypoints or usual_keypoint_source(row.readings, has_tips)
    keypoints = plug("keypoints", keypoints_name, row.options, "instrument")
    for one, other in ((initialiser, "random"), (state_filter, "kalman")):
        if one.needs_truth and not has_truth:
            raise ConfigError(
                f"{one.kind} '{one.name}' needs ground truth, which '{dataset.name}' has not; use --{one.kind} {other}"
            )
    if row.readings == "true" and not has_truth:
        raise ConfigError(f"--readings true needs ground truth, which '{dataset.name}' has not; use --joints")
    if row.readings == "noisy" and not has_readings:
        raise ConfigError(f"'{dataset.name}' has no joint readings; use --no-joints")
    if row.view is not None:
        _check_view(row.view, conditions.arms, dataset)
        if getattr(find("tracker", row.tracker).cls, "one_view", False):
            raise ConfigError(f"--view {row.view}: tracker '{tracker.name}' looks at one view alone")
    joints, seen = "-joints" if row.readings != "none" else "", "" if row.view is None else f"-{row.view}"
    return InstrumentSettings(
        row_id=row.row_id or f"{tracker.name}{joints}{seen}",
        tracker=tracker,
        conditions=conditions,
        sequences=row.sequences,
        frames_limit=cut(row, [sequence.frames for sequence in dataset.sequences]),
        initialiser=initialiser,
        filter=state_filter,
        keypoints=keypoints,
        readings=row.readings,
        view=row.view,
        masks=shown_masks(row.masks, conditions.arms, dataset),
        scored=row.scored,
    )


def shown_masks(asked: Masks, arms: str, dataset: InstrumentDataset) -> Masks:
    """What trackers are shown of two arms, ``union`` or ``instances``; of one arm there is its mask alone.

    Raises:
        ConfigError: Masks of single arms are asked for, and a pair has not both; one line.
    """
    if arms == "single":
        if asked == "instances":
            raise ConfigError("--masks instances: is about two arms; use --arms dual")
        return "union"
    pairs = [dataset.sequence(unit.sequence) for unit in dataset.units("dual")]
    without = [sequence for sequence in pairs if sequence.instance_kinds is None]
    if asked != "instances":
        return "union" if asked == "union" or without else "instances"
    if without:
        first = without[0]
        has = [kind for kind in first.entry.kinds if kind.startswith("visible_")]
        what = f"only '{has[0]}'" if has else "no masks of what shows of each arm"
        raise ConfigError(
            f"--masks instances: sequence '{first.id}' of '{dataset.name}' has {what} (needed: 'visible_left' and "
            "'visible_right'); use --masks union"
        )
    return "instances"


def _check_view(view: str, arms: str, dataset: InstrumentDataset) -> None:
    """See that every sequence has an auxiliary view, of one arm alone or of both."""
    for sequence in dataset.sequences:
        there = sequence.entry.auxiliary
        if not there:
            raise ConfigError(f"--view {view}: '{dataset.name}' has no auxiliary views")
        if view not in there:
            raise ConfigError(f"--view {view}: {unknown_name('auxiliary view', view, there)}")
        if arms == "dual" and "both" not in there[view].kinds:
            raise ConfigError(f"--view {view}: shows each arm alone; use --arms single")
