"""Rows of the instrument task, complete."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar

from surgbench.errors import ConfigError, NotFoundError, unknown_name
from surgbench.registry import find
from surgbench.suite.asked import Conditions
from surgbench.suite.plug import plug
from surgbench.suite.settings import Plug, Settings, flat
from surgbench.suite.slices import cut
from surgbench.tasks.instrument.asked import OF_DATASET, InstrumentRow, Masks, Readings, Scored, ToldPrompts
from surgbench.tasks.instrument.dataset import InstrumentDataset
from surgbench.tasks.instrument.told_prompts import read


@dataclass(frozen=True)
class InstrumentSettings(Settings):
    """Settings of a row of the instrument task.

    Attributes:
        view: Auxiliary view that the tracker is given besides the endoscope's.
        masks: What it is shown of the dataset's: the mask of all arms alone (``union``), or ``instances`` besides.
        mask_source: What makes the masks instead, and is measured; ``None``: they are the dataset's.
        prompts: Points in the first pictures for it, told in a file.
        scored: Which state is scored.
    """

    initialiser: Plug
    filter: Plug
    keypoints: Plug
    readings: Readings
    view: str | None = None
    masks: Masks = "union"
    scored: Scored = "raw"
    mask_source: Plug | None = None
    prompts: ToldPrompts = field(default_factory=dict)

    task: ClassVar[str] = "instrument"

    @property
    def plugs(self) -> tuple[Plug, ...]:
        """All plug-ins of the row."""
        usual = self.tracker, self.initialiser, self.filter, self.keypoints
        return usual if self.mask_source is None else (*usual, self.mask_source)

    @property
    def floor(self) -> bool:
        """Whether the filter or the masks knew the truth."""
        return self.filter.needs_truth or (self.mask_source is not None and self.mask_source.needs_truth)

    def spec(self) -> dict[str, Any]:
        """Adds the readings, and a view besides the endoscope's, masks of single arms and a scored state where set."""
        spec = {**super().spec(), "readings": self.readings}
        if self.scored != "raw":
            spec["scored"] = self.scored
        if self.masks != "union":
            spec["masks"] = self.masks
        if self.prompts:
            spec["prompts"] = self.prompts
        return spec if self.view is None else {**spec, "view": self.view, "views": 2}

    def words(self) -> list[str]:
        """Adds the other plug-ins."""
        words = ["FLOOR, NOT FOR RANKING: every search starts from the truth"] if self.filter.needs_truth else []
        words += super().words()
        if self.readings != "none":
            words.append(f"{self.readings} readings")
        if self.view is not None:
            words.append(f"also the view {self.view}")
        if self.masks == "instances":
            words.append("a mask for each arm")
        if self.mask_source is not None:
            words.append(
                "true masks, NOT FOR RANKING" if self.mask_source.needs_truth else f"masks {_named(self.mask_source)}"
            )
        if self.prompts:
            words.append("prompts from a file")
        if self.scored == "filtered":
            words.append("the filtered state is scored")
        if self.conditions.device != "cpu":
            words.append(f"device {self.conditions.device}")
        usual_keypoints = usual_keypoint_source(self.readings, shows_own(self.mask_source))
        for one, usual in ((self.filter, "kalman"), (self.keypoints, usual_keypoints), (self.initialiser, "truth")):
            if one.name != usual or one.changed:
                words.append(f"{one.kind} {_named(one)}")
        return words


def _named(one: Plug) -> str:
    changed = ", ".join(f"{key}={value}" for key, value in flat(one.changed))
    return one.name + (f" ({changed})" if changed else "")


def usual_keypoint_source(readings: Readings, has_tips: bool = True) -> str:
    """The keypoint source of rows that name none: without readings, or with masks made of images, what those show."""
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
    if row.view is not None:
        _check_view(row.view, conditions.arms, dataset)
    has_truth = all(sequence.entry.truth for sequence in dataset.sequences)
    has_readings = all(sequence.entry.readings for sequence in dataset.sequences)
    tracker = plug("tracker", row.tracker, row.options, "instrument")
    initialiser = plug(
        "initialiser", row.initialiser or ("truth" if has_truth else "random"), row.options, "instrument"
    )
    state_filter = plug("filter", row.filter, row.options, "instrument")
    has_tips = all(sequence.entry.keypoints for sequence in dataset.sequences)
    source = _mask_source(row, initialiser, dataset)
    keypoints_name = row.keypoints or usual_keypoint_source(row.readings, has_tips and shows_own(source))
    keypoints = plug("keypoints", keypoints_name, row.options, "instrument")
    for one, other in ((initialiser, "random"), (state_filter, "kalman")):
        if one.needs_truth and not has_truth:
            raise ConfigError(
                f"{one.kind} '{one.name}' needs ground truth, which '{dataset.name}' has not; use --{one.kind} {other}"
            )
    if row.readings == "true" and not has_truth:
        raise ConfigError(f"--readings true needs ground truth, which '{dataset.name}' has not; use --joints")
    if row.readings == "noisy" and not has_readings:
        raise ConfigError(f"'{dataset.name}' has no joint readings; leave --joints out")
    if row.view is not None and getattr(find("tracker", row.tracker).cls, "one_view", False):
        raise ConfigError(f"--view {row.view}: tracker '{tracker.name}' looks at one view alone")
    _check_images(tracker, row.tracker, row.view, dataset)
    joints, seen = "-joints" if row.readings != "none" else "", "" if row.view is None else f"-{row.view}"
    made = "" if source is None else f"-{source.name}"
    return InstrumentSettings(
        row_id=row.row_id or f"{tracker.name}{joints}{seen}{made}",
        tracker=tracker,
        conditions=conditions,
        sequences=row.sequences,
        frames_limit=cut(row, [sequence.frames for sequence in dataset.sequences]),
        initialiser=initialiser,
        filter=state_filter,
        keypoints=keypoints,
        readings=row.readings,
        view=row.view,
        masks=shown_masks(_of_dataset(row.masks), conditions.arms, dataset) if shows_own(source) else "union",
        scored=row.scored,
        mask_source=source,
        prompts=_prompts(row, source, dataset),
    )


def _of_dataset(masks: str) -> Masks:
    return next((one for one in OF_DATASET if one == masks), "auto")


def shows_own(source: Plug | None) -> bool:
    """Whether the masks that are shown are the dataset's."""
    return source is None or not getattr(find("mask_source", source.reference).cls, "reads_images", False)


def _mask_source(row: InstrumentRow, initialiser: Plug, dataset: InstrumentDataset) -> Plug | None:
    """What makes the masks; ``None`` where they are the dataset's.

    Raises:
        NotFoundError: No such source.
        ConfigError: The dataset has not what it needs; one line.
    """
    if row.mask_source is None:
        lacking = next((sequence for sequence in dataset.sequences if not sequence.entry.kinds), None)
        if lacking is not None:
            raise ConfigError(
                f"sequence '{lacking.id}' of '{dataset.name}' has no masks; import it again with --masks, or have them "
                "made from its images: --masks NAME (surgbench list masks)"
            )
        return None
    try:
        source = plug("mask_source", row.mask_source, row.options, "instrument")
    except NotFoundError as error:
        raise NotFoundError(f"--masks: {error} (or auto, union, instances)") from None
    cls = find("mask_source", row.mask_source).cls
    with_truth = all(sequence.entry.truth for sequence in dataset.sequences)
    if source.needs_truth and not with_truth:
        raise ConfigError(f"--masks {source.name} needs ground truth, which '{dataset.name}' has not")
    if getattr(cls, "reads_images", False):
        _check_has_images(f"--masks {source.name}", row.view, dataset)
    elif not all(sequence.entry.kinds for sequence in dataset.sequences):
        raise ConfigError(
            f"--masks {source.name}: '{dataset.name}' has no masks; surgbench list masks has other sources"
        )
    if getattr(cls, "needs_prompts", False) and not _has_points(row, initialiser):
        unmarked = next((sequence for sequence in dataset.sequences if not sequence.entry.labels), None)
        if unmarked is not None:
            raise ConfigError(
                f"--masks {source.name} needs points in the first pictures: --prompts FILE (sequence '{unmarked.id}' "
                f"of '{dataset.name}' has no marked points)"
            )
    return source


def _has_points(row: InstrumentRow, initialiser: Plug) -> bool:
    return row.prompts is not None or bool(row.told_prompts) or initialiser.needs_truth


def _prompts(row: InstrumentRow, source: Plug | None, dataset: InstrumentDataset) -> ToldPrompts:
    if row.prompts is None:
        return row.told_prompts
    if source is None or shows_own(source):
        raise ConfigError("--prompts: is for a mask source that reads images; give one by --masks NAME")
    return read(row.prompts, dataset)


def _check_images(tracker: Plug, reference: str, view: str | None, dataset: InstrumentDataset) -> None:
    if getattr(find("tracker", reference).cls, "reads_images", False):
        _check_has_images(f"tracker '{tracker.name}'", view, dataset)


def _check_has_images(who: str, view: str | None, dataset: InstrumentDataset) -> None:
    for sequence in dataset.sequences:
        if not sequence.entry.images:
            raise ConfigError(f"{who} works on images, and sequence '{sequence.id}' of '{dataset.name}' has none")
        if view is not None and not sequence.entry.auxiliary[view].images:
            raise ConfigError(f"{who} works on images, and view '{view}' of '{dataset.name}' has none")


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
