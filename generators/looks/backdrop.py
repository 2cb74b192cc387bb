"""What lies behind the instruments: moist tissue with folds, fat and vessels, or a surgical drape."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from surgbench.camera import Camera
from surgbench.generators.looks.look import Look
from surgbench.generators.looks.materials import texture
from surgbench.generators.looks.patterns import Pattern, noise, threshold, vessels, weave
from surgbench.geometry import FloatArray

LARGEST_TEXTURE_PX = 1024
# Cells of the mesh across what is in view, and how much further it goes, as a share of that.
CELLS = 224
MARGIN = 0.12
# Around that a skirt closes in towards the camera, which steel reflects.
SKIRT = (1.25, 1.6, 2.2)
SKIRT_RISE = (0.04, 0.25, 0.75)
PALE, RED, DARK = (0.62, 0.26, 0.19), (0.44, 0.075, 0.05), (0.20, 0.02, 0.02)
FAT = (0.70, 0.40, 0.20)
VESSEL = (0.26, 0.015, 0.025)
DRAPE, GREY = (0.03, 0.20, 0.22), (0.14, 0.15, 0.155)


@dataclass(frozen=True)
class Backdrop:
    """A surface, its look, and how it moves.

    Attributes:
        vertices_m: ``(V, 3)`` in the camera's frame, at rest.
        faces: ``(F, 3)``.
        places: ``(V, 2)`` in the texture.
        bsdf: Its material.
        shapes: ``(2, V)`` how each vertex takes part in two slow motions, metres along the view.
        period_s: Of these.
        phase: ``(2,)`` of these, radians.
    """

    vertices_m: FloatArray
    faces: NDArray[np.uint32]
    places: FloatArray
    bsdf: dict[str, Any]
    shapes: FloatArray
    period_s: float
    phase: FloatArray

    def at(self, time_s: float) -> FloatArray:
        """``(V, 3)`` where its vertices are at a time."""
        turn = 2 * np.pi * time_s / self.period_s
        # Breathing, and a slower motion across it, which never repeat together.
        amount = np.sin(np.array([turn, 0.618 * turn]) + self.phase)
        moved = self.vertices_m.copy()
        moved[:, 2] += amount @ self.shapes
        return moved


def make_backdrop(mi: Any, look: Look, camera: Camera, nearest_m: float) -> Backdrop:
    """What lies behind the instruments of a sequence.

    Args:
        mi: Mitsuba, its variant set.
        look: Of the sequence.
        camera: Pinhole.
        nearest_m: No part of it comes nearer to the camera's plane, where it is in view.
    """
    relief = look["relief_m"] * (0.35 if look.backdrop == "drape" else 1.0)
    middle = nearest_m + look["sway_m"] + 0.5 * relief
    low = (np.array([-0.5, -0.5]) - [camera.cx, camera.cy]) / [camera.fx, camera.fy] * middle
    high = (np.array([camera.width, camera.height]) - 0.5 - [camera.cx, camera.cy]) / [camera.fx, camera.fy] * middle
    centre, half = (low + high) / 2, (high - low) / 2 * (1 + MARGIN)
    cells = min(CELLS, camera.width // 2)
    rows = round(cells * half[1] / half[0])
    inner = [np.linspace(-1.0, 1.0, count + 1) for count in (cells, max(2, rows))]
    outer = [np.concatenate([-np.array(SKIRT)[::-1], line, SKIRT]) for line in inner]
    across, down = np.meshgrid(*outer)
    far = np.maximum(np.abs(across), np.abs(down))
    rise = np.interp(far, [1.0, *SKIRT], [0.0, *SKIRT_RISE]) * middle
    size = texture_px(camera)
    fold = noise(size, 0.45, look.rng("relief"), octaves=5 if look.backdrop == "tissue" else 2, fade=0.58)
    patterns = _tissue(look, size) if look.backdrop == "tissue" else _drape(look, size)
    shape = fold + patterns.lifts
    shape = (shape - shape.min()) / max(float(np.ptp(shape)), 1e-6) - 0.5
    places = np.stack([0.5 + 0.5 * across / (1 + MARGIN / 2), 0.5 + 0.5 * down / (1 + MARGIN / 2)], axis=-1)
    depth = middle + relief * _sampled(shape, places) - rise
    vertices = np.stack([centre[0] + half[0] * across, centre[1] + half[1] * down, depth], axis=-1).reshape(-1, 3)
    sway = look["sway_m"] * 0.5
    ramp = np.stack([np.cos(1.1 * across + 0.4 * down), np.sin(0.9 * down - 0.5 * across)]).reshape(2, -1) * sway
    phase = look.rng("sway").uniform(0, 2 * np.pi, 2)
    return Backdrop(
        vertices,
        _grid_faces(*across.shape),
        places.reshape(-1, 2),
        patterns.bsdf(mi),
        ramp,
        look["sway_period_s"],
        phase,
    )


def texture_px(camera: Camera) -> int:
    """Pixels a side of a backdrop's texture: enough for the camera's own."""
    size = 128
    while size < camera.width and size < LARGEST_TEXTURE_PX:
        size *= 2
    return size


@dataclass(frozen=True)
class _Patterns:
    """What a backdrop is covered with.

    Attributes:
        colour: ``(n, n, 3)`` linear.
        roughness: ``(n, n)``.
        bumps: ``(n, n)`` height of what is too fine for the mesh.
        lifts: ``(n, n)`` what stands out of the mesh, in standard deviations of its folds; negative is out.
        wet: How strongly a film of liquid reflects.
    """

    colour: Any
    roughness: Pattern
    bumps: Pattern
    lifts: Pattern
    wet: float

    def bsdf(self, mi: Any) -> dict[str, Any]:
        surface: dict[str, Any] = {
            "type": "principled",
            "base_color": texture(mi, np.clip(self.colour, 0.001, 0.95)),
            "roughness": texture(mi, np.clip(self.roughness, 0.08, 1.0)),
            "specular": 0.25 + 0.5 * self.wet,
            "clearcoat": self.wet,
            "clearcoat_gloss": 0.85,
        }
        return {"type": "bumpmap", "bump": texture(mi, self.bumps), "scale": 1.0, "bsdf": surface}


def _tissue(look: Look, size: int) -> _Patterns:
    rng = look.rng("tissue")
    wide, fine = noise(size, 0.4, rng, octaves=6, fade=0.55), noise(size, 0.06, rng, octaves=6, fade=0.75)
    redness = np.clip(look["tissue_red"] + 0.22 * wide + 0.07 * fine, 0.0, 1.0)[..., None]
    colour = np.array(PALE) + np.clip(redness * 2, 0, 1) * (np.array(RED) - np.array(PALE))
    colour = colour + np.clip(redness * 2 - 1, 0, 1) * (np.array(DARK) - np.array(RED))
    fat = threshold(noise(size, 0.22, rng, octaves=7, fade=0.6), look["tissue_fat"], 0.9)
    lobes = np.abs(noise(size, 0.035, rng, octaves=3))
    lump = fat * np.clip(1.0 - 0.8 * lobes, 0.0, 1.0)
    colour = colour + (0.8 * fat * (0.75 + 0.25 * (1 - np.clip(lobes, 0, 1))))[..., None] * (np.array(FAT) - colour)
    net, tall = vessels(size, int(4 + 26 * look["vessels"]), rng)
    colour = colour + (0.75 * net)[..., None] * (np.array(VESSEL) - colour)
    colour = colour * (1.0 + 0.24 * fine)[..., None]
    roughness = np.asarray(look["tissue_roughness"] * (1.0 + 0.25 * wide + 0.15 * fine), np.float32)
    ripples, grain = noise(size, 0.05, rng, octaves=3, fade=0.45), noise(size, 0.012, rng, octaves=2)
    bumps = 0.00035 * ripples + 0.00003 * grain - 0.0006 * tall - 0.0006 * lump
    return _Patterns(colour, roughness, bumps.astype(np.float32), -0.25 * lump - 0.1 * tall, look["tissue_wet"])


def _drape(look: Look, size: int) -> _Patterns:
    rng = look.rng("drape")
    cloth, wide = weave(size, 150, rng), noise(size, 0.3, rng)
    base = np.array(DRAPE) + look["drape_grey"] * (np.array(GREY) - np.array(DRAPE))
    colour = base * (1.0 + 0.40 * cloth + 0.06 * wide)[..., None]
    roughness = np.full((size, size), 0.9, np.float32)
    return _Patterns(colour, roughness, np.asarray(0.00008 * cloth, np.float32), np.zeros_like(cloth), 0.0)


def _sampled(pattern: Pattern, places: FloatArray) -> FloatArray:
    """A pattern at places as a bitmap has it there; its edge goes on where they lie beyond it."""
    at = np.clip(places, 0.0, 1.0).astype(np.float32) * pattern.shape[0] - 0.5
    found = cv2.remap(pattern, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(found, np.float64)


def _grid_faces(rows: int, columns: int) -> NDArray[np.uint32]:
    index = np.arange(rows * columns, dtype=np.uint32).reshape(rows, columns)
    # Towards the camera.
    one = [index[:-1, :-1], index[1:, :-1], index[:-1, 1:]]
    other = [index[:-1, 1:], index[1:, :-1], index[1:, 1:]]
    return np.concatenate([np.stack(part, axis=-1).reshape(-1, 3) for part in (one, other)])
