"""Absences: an instrument is drawn back along its shaft until nothing of it is in the picture, and put in again.

As a surgeon does to clean a tool or to make room. The jaws leave the picture last, on the side from which
the shaft enters.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Literal

import numpy as np

from surgbench.camera import Camera
from surgbench.generators.place import Place, clearance_m
from surgbench.generators.sections import Absences
from surgbench.geometry import FloatArray, look_at_rotation
from surgbench.instrument import Instrument
from surgbench.state import ANGLES, POSITION

# How far beyond the picture's edge: more than a lens bends (presets with a mismatch) or a blob covers.
BEYOND_M = 0.003
# A wrist nearer to the camera's plane than this would be beside the camera itself.
NEAREST_M = 0.01


def with_absences(
    settings: Absences, places: Sequence[Place], states: FloatArray, rng: np.random.Generator
) -> FloatArray | None:
    """Draw both arms back now and then, each when its turn comes.

    Args:
        settings: How often and for how long.
        places: Of the arms, for the side that their shafts enter from.
        states: ``(frames, 2, 9)``, in the picture.
        rng: The only source of randomness.

    Returns:
        ``(frames, 2, 9)``, of which only positions differ; ``None`` where an arm would come too near to the camera or
        to the other arm.
    """
    moved = states.copy()
    for index, place in enumerate(places):
        own = states[:, index]
        axis = look_at_rotation(own[:, ANGLES])[..., 2]
        moved[:, index, POSITION] -= _way_back_m(settings, way_out_m(place, own), rng)[:, None] * axis
    if moved[..., POSITION][..., 2].min() < NEAREST_M:
        return None
    apart = clearance_m(places[0].instrument, moved[:, 0], moved[:, 1])
    return moved if apart.min() >= places[0].workspace.clearance_m else None


def way_out_m(place: Place, states: FloatArray) -> FloatArray:
    """How far an arm is to be drawn back along its shaft until nothing of it is in the picture.

    It is out where all its vertices are beyond the plane through the camera's centre and the picture's edge on its own
    side. Of a vertex ``v``, the shaft's axis ``a`` and the plane's normal ``n``, pointing into the picture, that is
    ``v . n / a . n``.

    Args:
        place: Of the arm.
        states: ``(frames, 9)``.

    Returns:
        ``(frames,)`` metres.
    """
    inwards = inwards_of(place.camera, "left" if place.side < 0 else "right")
    way: FloatArray = (_depths_m(place.instrument, states, inwards).max(axis=-1) + BEYOND_M) / _along(states, inwards)
    return way


def way_past_m(
    instrument: Instrument, states: FloatArray, inwards: FloatArray, links: Collection[str], share: float
) -> FloatArray:
    """How far an instrument is to be drawn back along its shaft until a share of some links is out of the picture.

    Args:
        instrument: Which.
        states: ``(frames, 9)``.
        inwards: ``(3,)`` from :func:`inwards_of` the edge over which it leaves.
        links: Their vertices are counted.
        share: 0 to 1: until the first, or the last of them, is on the edge.

    Returns:
        ``(frames,)`` metres; below 0 where more than that is out already.
    """
    depths = _depths_m(instrument, states, inwards, links)
    way: FloatArray = np.quantile(depths, share, axis=-1) / _along(states, inwards)
    return way


def inwards_of(camera: Camera, edge: Literal["left", "right", "bottom"]) -> FloatArray:
    """Unit normal ``(3,)`` of the plane through the camera's centre and an edge of the picture, pointing into it."""
    if edge == "bottom":
        inwards = np.array([0.0, -1.0, (camera.height - 0.5 - camera.cy) / camera.fy])
    else:
        edge_u, side = (-0.5, -1.0) if edge == "left" else (camera.width - 0.5, 1.0)
        inwards = -side * np.array([1.0, 0.0, -(edge_u - camera.cx) / camera.fx])
    inwards /= np.linalg.norm(inwards)
    return inwards


def _depths_m(
    instrument: Instrument, states: FloatArray, inwards: FloatArray, names: Collection[str] | None = None
) -> FloatArray:
    """How far inside a plane through the camera the vertices of links are, all unless named: ``(frames, vertices)``."""
    links = instrument.link_transforms(states)
    depths = [
        (mesh.vertices_m @ np.swapaxes(link[..., :3, :3], -1, -2) + link[..., None, :3, 3]) @ inwards
        for name, mesh in instrument.meshes.items()
        if names is None or name in names
        for link in [links[..., instrument.link_index[name], :, :]]
    ]
    return np.concatenate(depths, axis=-1)


def _along(states: FloatArray, inwards: FloatArray) -> FloatArray:
    along: FloatArray = look_at_rotation(states[:, ANGLES])[..., 2] @ inwards
    return along


def _way_back_m(settings: Absences, way_out: FloatArray, rng: np.random.Generator) -> FloatArray:
    """How far an arm is drawn back in each frame, ``(frames,)`` metres."""
    frames = len(way_out)
    back = np.zeros(frames)

    def draw(bounds: tuple[int, int]) -> int:
        return int(rng.integers(bounds[0], bounds[1], endpoint=True))

    start = draw(settings.every_frames)
    while start < frames:
        there, out, again = draw(settings.travel_frames), draw(settings.out_frames), draw(settings.travel_frames)
        leaving, gone, coming = start, start + there, start + there + out
        # As far as the frame that needs most; where the sequence ends on the way, as far as its last frames need.
        way = way_out[min(gone, frames - 1) : coming].max()
        course = np.concatenate([ease(there), np.ones(out), ease(again)[::-1]])[: frames - leaving]
        back[leaving : leaving + len(course)] = way * course
        start = coming + again + draw(settings.every_frames)
    return back


def ease(frames: int) -> FloatArray:
    """From 0 to 1 with the least jerk (Flash and Hogan 1985), ends left out, ``(frames,)``."""
    share = np.arange(1, frames + 1) / (frames + 1)
    eased: FloatArray = share**3 * (10.0 - 15.0 * share + 6.0 * share**2)
    return eased
