"""Points on the first pictures, from a file, a recording's marks or the first estimate, for mask sources."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from surgbench.contract import Observation, Scene
from surgbench.errors import ConfigError
from surgbench.geometry import FloatArray
from surgbench.mask_sources import Prompts
from surgbench.prompts import OWN_VIEW, Pictures, check_on_instrument, prompts_from_state, read_prompts
from surgbench.tasks.instrument.asked import ToldPrompts
from surgbench.tasks.instrument.dataset import InstrumentDataset, Sequence
from surgbench.tasks.instrument.format import Arm

BOTH = "both"


def read(path: Path, dataset: InstrumentDataset) -> ToldPrompts:
    """Points of a file, of some or all of a dataset's sequences.

    Raises:
        ConfigError: Something in it is wrong, or a point lies on the background of a first picture whose true mask is
            known; one line that names the file.
    """
    pictures = {
        sequence.id: Pictures(
            {OWN_VIEW: sequence.camera, **{name: sequence.auxiliary(name).camera for name in sequence.entry.auxiliary}},
            sequence.arms,
        )
        for sequence in dataset.sequences
    }
    found = read_prompts(path, pictures)
    for id_, views in found.items():
        sequence = dataset.sequence(id_)
        for view, prompts in views.items():
            problem = _off(prompts, sequence, view)
            if problem is not None:
                where = f"sequence '{id_}'" if view == OWN_VIEW else f"sequence '{id_}', view '{view}'"
                raise ConfigError(f"{path}: {where}: {problem}")
    return {
        id_: {view: _listed(prompts, dataset.sequence(id_).arms) for view, prompts in views.items()}
        for id_, views in found.items()
    }


def _off(prompts: Prompts, sequence: Sequence, view: str) -> str | None:
    """One line on a point that is not on its arm in a first picture of which the truth is known."""
    if not sequence.entry.truth:
        return None
    shown = sequence if view == OWN_VIEW else sequence.auxiliary(view)
    kinds = shown.entry.kinds
    if BOTH not in kinds:
        return None
    visible = [f"visible_{arm}" for arm in sequence.arms]
    alone = [shown.clean_mask(kind, 0) for kind in visible] if set(visible) <= set(kinds) else None
    return check_on_instrument(prompts, shown.clean_mask(BOTH, 0), alone)


def _listed(prompts: Prompts, arms: tuple[Arm, ...]) -> dict[str, list[tuple[float, float, bool]]]:
    return {
        arm: [(float(u), float(v), bool(on)) for (u, v), on in zip(points, inside, strict=True)]
        for arm, points, inside in zip(arms, prompts.points_px, prompts.inside, strict=True)
    }


def told(
    prompts: ToldPrompts, sequence: Sequence, arms: tuple[Arm, ...], frame: int, view: str | None
) -> tuple[Prompts | None, ...]:
    """What is told of a sequence's first pictures: of its own view and, where it is in use, of an auxiliary one.

    Args:
        prompts: Of all sequences, from a file; empty where there is none.
        sequence: One of them.
        arms: Those of the scene, in order. Where it is of one arm alone, points on the other one are not to be taken
            for it.
        frame: The frame that tracking begins with, of whose marks the points are where no file has any.
        view: The auxiliary view.

    Returns:
        ``None`` for a view of which nothing is told.
    """
    own = prompts.get(sequence.id, {})
    names = [OWN_VIEW] if view is None else [OWN_VIEW, view]
    given = [_of_arms(own[name], arms) if name in own else None for name in names]
    return (given[0] or _marked(sequence, arms, frame), *given[1:])


def _of_arms(points: dict[str, list[tuple[float, float, bool]]], arms: tuple[Arm, ...]) -> Prompts:
    others = [(u, v, False) for arm, own in points.items() if arm not in arms for u, v, inside in own if inside]
    per_arm = [np.array([*points.get(arm, []), *others], dtype=np.float64).reshape(-1, 3) for arm in arms]
    return Prompts([one[:, :2] for one in per_arm], [one[:, 2] > 0 for one in per_arm])


def _marked(sequence: Sequence, arms: tuple[Arm, ...], frame: int) -> Prompts | None:
    points = []
    for arm in arms:
        marks = [label[frame] for label in sequence.labels(arm).values()]
        known = np.array(marks, dtype=np.float64).reshape(-1, 2)
        points.append(known[np.isfinite(known).all(axis=1)])
    if not any(len(one) for one in points):
        return None
    return Prompts(points, [np.ones(len(one), dtype=bool) for one in points])


def of_views(
    prompts: tuple[Prompts | None, ...], scene: Scene, observation: Observation, state: FloatArray | None
) -> tuple[Prompts | None, ...]:
    """Points for each view: those that are told, else from the first estimate.

    Args:
        prompts: Told, of each view.
        scene: The sequence's constants.
        observation: The first frame.
        state: ``(9 * arms,)`` its estimate, where there is one before there are masks.
    """
    made = [None if state is None else prompts_from_state(scene, view, state) for view in observation.views]
    return tuple(one or other for one, other in zip(prompts, made, strict=True))
