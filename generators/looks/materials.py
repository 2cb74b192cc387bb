"""What instruments are made of: scratched, worn steel, and a shaft with a dark coat and a bright ring."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from surgbench.generators.looks.look import Look
from surgbench.generators.looks.patterns import Pattern, noise, scratches, threshold

STEEL_PX = 512
SHAFT_PX = (2048, 256)
# Of the ring about the shaft, and of the bare steel that carries the wrist.
RING_M, CLEVIS_M = 0.0008, 0.0042
STAIN = (0.34, 0.24, 0.15)
STEEL_TINT = (1.0, 0.985, 0.955)


def steel(mi: Any, look: Look) -> dict[str, Any]:
    """Steel as a BSDF: a rough conductor, with what is worn off it scattering light."""
    rng = look.rng("steel")
    lines = scratches(STEEL_PX, int(30 + 170 * look["scratches"]), rng)
    fine = noise(STEEL_PX, 0.05, rng, octaves=6, fade=0.8)
    worn = threshold(noise(STEEL_PX, 0.25, rng, octaves=7, fade=0.65), 0.6 * look["wear"], 1.0)
    stained = threshold(noise(STEEL_PX, 0.2, rng, octaves=7, fade=0.65), 0.35 * look["wear"], 1.2)
    return _steel(mi, look, lines, fine, worn, stained)


def _steel(mi: Any, look: Look, lines: Pattern, fine: Pattern, worn: Pattern, stained: Pattern) -> dict[str, Any]:
    grey = look["steel_grey"] * (1.0 + 0.10 * fine + 0.25 * lines - 0.25 * worn)
    reflects = grey[..., None] * np.array(STEEL_TINT)
    reflects = reflects * (1.0 - 0.6 * stained[..., None] * (1.0 - np.array(STAIN) * 2.0))
    alpha = look["steel_roughness"] * (1.0 + 0.15 * fine + 0.6 * worn - 0.35 * lines)
    dull = np.clip(0.12 + 0.2 * worn + 0.2 * stained + 0.03 * fine, 0.05, 0.8)
    scatters = np.array(STEEL_TINT) * 0.16 * (1.0 - stained[..., None]) + np.array(STAIN) * 0.5 * stained[..., None]
    return {
        "type": "blendbsdf",
        "weight": texture(mi, dull),
        "shiny": {
            "type": "roughconductor",
            "material": "none",
            "distribution": "ggx",
            "specular_reflectance": texture(mi, np.clip(reflects, 0.02, 0.98)),
            "alpha": texture(mi, np.clip(alpha, 0.05, 0.9)),
        },
        "dull": {"type": "diffuse", "reflectance": texture(mi, np.clip(scatters, 0.01, 0.9))},
    }


def shaft(mi: Any, look: Look, low_m: float, high_m: float) -> dict[str, Any]:
    """The shaft's BSDF, its texture wound about it from ``low_m`` to ``high_m`` along z.

    Args:
        mi: Mitsuba, its variant set.
        look: Of the sequence.
        low_m: Where the shaft begins, in the wrist's frame.
        high_m: Where it ends.
    """
    rng = look.rng("shaft")
    rows, columns = SHAFT_PX
    along = low_m + (np.arange(rows) + 0.5) / rows * (high_m - low_m)

    def wound(pattern: Pattern) -> Pattern:
        return np.asarray(cv2.resize(pattern, (columns, rows), interpolation=cv2.INTER_LINEAR), np.float32)

    bare = (np.abs(along + look["ring_m"]) < RING_M / 2) | (along > -CLEVIS_M)
    metal = np.repeat(bare[:, None], columns, axis=1).astype(np.float32)
    streaks = wound(noise(512, 0.03, rng, octaves=6, fade=0.8))
    marks = wound(scratches(512, int(40 * look["scratches"]), rng, along=np.pi / 2))
    worn = wound(threshold(noise(512, 0.1, rng), 0.15 * look["wear"], 0.5))
    coat = look["shaft_grey"] * (1.0 + 0.15 * streaks + 1.5 * marks + 1.0 * worn)
    alpha = look["shaft_roughness"] * (1.0 + 0.1 * streaks + 0.3 * worn)
    plain = np.zeros_like(streaks)
    return {
        "type": "blendbsdf",
        "weight": texture(mi, metal),
        "coat": {
            "type": "principled",
            "base_color": texture(mi, np.clip(coat[..., None] * np.array([0.98, 1.0, 1.03]), 0.0, 0.8)),
            "roughness": texture(mi, np.clip(alpha, 0.05, 1.0)),
            "specular": 0.5,
        },
        "metal": _steel(mi, look, marks, streaks, plain, plain),
    }


def paint(colour: tuple[float, float, float]) -> dict[str, Any]:
    """The BSDF of dry paint of a linear colour."""
    return {"type": "diffuse", "reflectance": {"type": "rgb", "value": list(colour)}}


def texture(mi: Any, values: Any) -> dict[str, Any]:
    """A bitmap texture of ``(rows, columns)`` or ``(rows, columns, 3)`` linear values."""
    grid = np.asarray(values, np.float32)
    return {"type": "bitmap", "bitmap": mi.Bitmap(grid if grid.ndim == 3 else grid[..., None]), "raw": True}
