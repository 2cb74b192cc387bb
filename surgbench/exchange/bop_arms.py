"""Which arm each object of a BOP scene is, and the states that a scene's poses follow from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from surgbench.errors import ConfigError, DatasetError
from surgbench.geometry import FloatArray
from surgbench.instrument import Instrument
from surgbench.recordings.bop import JOINTS_FILE, Link, Scene
from surgbench.state import STATE_SIZE
from surgbench.tasks.instrument.format import ARMS, Arm

# Files have so many digits, and models are rounded; states and poses that differ by more are not of one another.
# Angles and metres of a state are not nearly as large.
_LARGEST = 1e3
AGREEMENT_M = 1e-5


@dataclass(frozen=True)
class ObjectsTold:
    """What is told of objects.

    Attributes:
        objects: Object's id to arm; several may be of one.
        order: Arms of a scene's objects by their place in ``scene_gt.json``.
        only: The arm of the only object.
    """

    objects: Mapping[int, Arm]
    order: tuple[Arm, ...]
    only: Arm


def arms_of_objects(scene: Scene, links: Mapping[int, Link], told: ObjectsTold) -> list[list[Arm | None]]:
    """Of each image the arm of each of its objects; ``None`` of what is no instrument.

    Raises:
        ConfigError: More must be told; one line that names the option.
        DatasetError: What the scene says of its arms is not what it says of its objects; one line.
    """
    if told.objects:
        arms = [[told.objects.get(one) for one in objects] for objects in scene.objects]
        for image, objects, own in zip(scene.images, scene.objects, arms, strict=True):
            for one, arm in zip(objects, own, strict=True):
                if arm is not None and objects.count(one) > 1:
                    raise ConfigError(
                        f"{scene.folder}: image {image} has {objects.count(one)} objects {one}; --order left,right "
                        "says which of them is which arm"
                    )
        return arms
    if told.order:
        return [[told.order[place] if place < len(told.order) else None for place in range(len(one))]
                for one in scene.objects]  # fmt: skip
    if scene.joints is not None and links:
        return [_blocks(scene, place, links) for place in range(len(scene.images))]
    ids = sorted({one for objects in scene.objects for one in objects})
    if len(ids) == 1 and all(len(objects) <= 1 for objects in scene.objects):
        return [[told.only] * len(objects) for objects in scene.objects]
    if len(ids) == 1:
        raise ConfigError(f"{scene.folder}: has object {ids[0]} twice; --order left,right says which is which arm")
    if not ids:
        raise DatasetError(f"{scene.folder}: holds no objects")
    raise ConfigError(
        f"{scene.folder}: has the objects {', '.join(map(str, ids[:8]))}; --objects {ids[0]}=left,{ids[1]}=right says "
        "which is which arm (several may be parts of one)"
    )


def states_of_scene(
    scene: Scene, arms: list[list[Arm | None]], links: Mapping[int, Link], instruments: Mapping[Arm, Instrument]
) -> dict[Arm, FloatArray] | None:
    """Arm to ``(images, 9)`` states; ``None`` where the scene does not say of all images what joints there are.

    Raises:
        DatasetError: They are not what the poses of its objects say; one line.
    """
    if scene.joints is None or not links or not all(scene.joints):
        return None
    path = scene.folder / JOINTS_FILE
    names = [one.get("arm") for one in scene.joints[0]]
    states: dict[Arm, FloatArray] = {}
    for arm in ARMS:
        if arm not in names:
            continue
        try:
            rows = [next(one["state"] for one in entries if one["arm"] == arm) for entries in scene.joints]
            states[arm] = np.array(rows, dtype=np.float64).reshape(len(scene.images), STATE_SIZE)
            if not (np.abs(states[arm]) < _LARGEST).all():
                raise ValueError
        except (KeyError, StopIteration, TypeError, ValueError):
            raise DatasetError(f"{path}: must have 'arm' and nine numbers 'state' of each image and arm") from None
        _check(scene, arm, states[arm], arms, links, instruments[arm])
    return states


def _blocks(scene: Scene, place: int, links: Mapping[int, Link]) -> list[Arm | None]:
    """Objects come arm by arm, so that the next arm begins where a link comes again."""
    assert scene.joints is not None
    blocks: list[int] = []
    seen: set[tuple[str, str]] = set()
    number = 0
    for one in scene.objects[place]:
        if one not in links:
            raise DatasetError(f"{scene.folder}: object {one} is not in models/objects.json")
        key = (links[one].instrument, links[one].link)
        if key in seen or any(instrument != key[0] for instrument, _ in seen):
            number, seen = number + 1, set()
        seen.add(key)
        blocks.append(number)
    names = [one.get("arm") for one in scene.joints[place]]
    if number + 1 != len(names) or not all(name in ARMS for name in names):
        raise DatasetError(
            f"{scene.folder / JOINTS_FILE}: image {scene.images[place]}: arms {names} are not those of the objects"
        )
    return [names[block] for block in blocks]


def _check(
    scene: Scene,
    arm: Arm,
    states: FloatArray,
    arms: list[list[Arm | None]],
    links: Mapping[int, Link],
    instrument: Instrument,
) -> None:
    """See that an arm's states put its links where the poses have them."""
    transforms = instrument.link_transforms(states)
    for place, objects in enumerate(scene.objects):
        for one, own, pose in zip(objects, arms[place], scene.poses[place], strict=True):
            link = links.get(one)
            if own != arm or link is None:
                continue
            if link.link not in instrument.link_index:
                raise DatasetError(
                    f"{scene.folder}: object {one} is the link '{link.link}', which {instrument.name} has not; "
                    "--instrument FILE names the instrument"
                )
            T_cam_link = transforms[place, instrument.link_index[link.link]]
            origin = T_cam_link[:3, 3] + T_cam_link[:3, :3] @ link.link_from_model_m
            apart = np.abs(origin - pose[:3, 3]).max()
            turned = np.abs(T_cam_link[:3, :3] - pose[:3, :3]).max()
            if apart > AGREEMENT_M or turned > 1e-3:
                raise DatasetError(
                    f"{scene.folder / JOINTS_FILE}: image {scene.images[place]}: the {arm} arm's state puts "
                    f"'{link.link}' {1e3 * apart:.3g} mm from its pose in scene_gt.json; is it another --instrument?"
                )
