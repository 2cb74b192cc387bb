"""Patterns on surfaces: noise of several scales, scratches, vessels, and cloth."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Pattern = NDArray[np.float32]


def noise(size: int, scale: float, rng: np.random.Generator, octaves: int = 5, fade: float = 0.5) -> Pattern:
    """Noise of several scales, which repeats at its edges.

    Args:
        size: Pixels a side.
        scale: Of its coarsest part, as a share of the side.
        rng: The only source of randomness.
        octaves: How many scales, each half of the one before.
        fade: Amplitude of each against the one before.

    Returns:
        ``(size, size)``, mean 0, standard deviation 1.
    """
    total = np.zeros((size, size), np.float32)
    weight = 1.0
    cells = max(2, round(1.0 / scale))
    for _ in range(octaves):
        if cells > size:
            break
        grid = rng.standard_normal((cells, cells)).astype(np.float32)
        wide = np.pad(grid, 2, mode="wrap")
        step = size / cells
        at = (np.arange(size, dtype=np.float32) + 0.5) / step - 0.5 + 2.0
        columns, rows = np.meshgrid(at, at)
        total += weight * cv2.remap(wide, columns, rows, cv2.INTER_CUBIC)
        weight *= fade
        cells *= 2
    total -= total.mean()
    return total / max(float(total.std()), 1e-6)


def threshold(pattern: Pattern, share: float, softness: float) -> Pattern:
    """Where a pattern is among its highest, 0 to 1.

    Args:
        pattern: Any.
        share: Of the area that is to be more than one half.
        softness: Width of the edges, in the pattern's own units.
    """
    if share <= 0.0:
        return np.zeros_like(pattern)
    level = float(np.quantile(pattern, 1.0 - min(share, 1.0)))
    return np.asarray(np.clip((pattern - level) / max(softness, 1e-6) + 0.5, 0.0, 1.0), np.float32)


def scratches(size: int, count: int, rng: np.random.Generator, along: float | None = None) -> Pattern:
    """Fine straight scratches, 0 to 1.

    Args:
        size: Pixels a side.
        count: How many.
        rng: The only source of randomness.
        along: Direction that they keep to, radians; any unless told.
    """
    canvas = np.zeros((size, size), np.float32)
    for _ in range(count):
        start = rng.uniform(0, size, 2)
        angle = rng.uniform(0, np.pi) if along is None else along + rng.normal(0.0, 0.1)
        end = start + rng.uniform(0.02, 0.25) * size * np.array([np.cos(angle), np.sin(angle)])
        line = np.zeros((size, size), np.uint8)
        cv2.line(line, _point(start), _point(end), 255, 1, cv2.LINE_AA)
        np.maximum(canvas, line.astype(np.float32) / 255.0 * rng.uniform(0.2, 1.0), out=canvas)
    return canvas


def vessels(size: int, count: int, rng: np.random.Generator) -> tuple[Pattern, Pattern]:
    """Branching vessels.

    Args:
        size: Pixels a side.
        count: How many trunks.
        rng: The only source of randomness.

    Returns:
        How much of each pixel is vessel, and how high it stands, both 0 to 1.
    """
    canvas, height = np.zeros((size, size), np.uint8), np.zeros((size, size), np.uint8)
    trunks = [(rng.uniform(0, size, 2), rng.uniform(0, 2 * np.pi), rng.uniform(3.0, 9.0) * size / 1024, 0)]
    trunks += [
        (rng.uniform(0, size, 2), rng.uniform(0, 2 * np.pi), rng.uniform(1.5, 6.0) * size / 1024, 0)
        for _ in range(count - 1)
    ]
    while trunks:
        place, angle, width, depth = trunks.pop()
        turn = 0.0
        for _ in range(int(rng.uniform(20, 60))):
            turn = 0.8 * turn + rng.normal(0.0, 0.12)
            angle += turn
            onward = place + 0.012 * size * np.array([np.cos(angle), np.sin(angle)])
            thick = max(1, round(width))
            strength = int(np.clip(70 + 185 * min(1.0, width / 3.0), 0, 255))
            cv2.line(canvas, _point(place), _point(onward), strength, thick, cv2.LINE_AA)
            if width > 2.0:
                cv2.line(height, _point(place), _point(onward), strength, thick, cv2.LINE_AA)
            place = onward
            width *= 0.985
            if depth < 3 and rng.random() < 0.06:
                trunks.append((place, angle + rng.choice([-1, 1]) * rng.uniform(0.4, 1.0), 0.6 * width, depth + 1))
            if width < 0.5 * size / 1024:
                break
    soft = cv2.GaussianBlur(canvas.astype(np.float32) / 255.0, (0, 0), 1.2)
    tall = cv2.GaussianBlur(height.astype(np.float32) / 255.0, (0, 0), 2.5)
    return np.asarray(soft, np.float32), np.asarray(tall, np.float32)


def weave(size: int, threads: int, rng: np.random.Generator) -> Pattern:
    """Cloth of crossing threads, mean 0, standard deviation 1.

    Args:
        size: Pixels a side.
        threads: How many in a side.
        rng: The only source of randomness.
    """
    bend = 0.35 * noise(size, 0.1, rng, octaves=3), 0.35 * noise(size, 0.1, rng, octaves=3)
    rows, columns = np.mgrid[:size, :size].astype(np.float32) * np.float32(2 * np.pi * threads / size)
    across, down = columns + bend[0], rows + bend[1]
    over = np.sin(across) * np.sin(down)
    cloth = np.where(over > 0, np.cos(across / 1.0), np.cos(down)) * (0.8 + 0.2 * noise(size, 0.02, rng, octaves=3))
    cloth = cloth.astype(np.float32) + 0.35 * noise(size, 1.0 / threads, rng, octaves=2)
    cloth -= cloth.mean()
    return np.asarray(cloth / cloth.std(), np.float32)


def _point(place: NDArray[np.float64]) -> tuple[int, int]:
    return int(np.rint(place[0])), int(np.rint(place[1]))
