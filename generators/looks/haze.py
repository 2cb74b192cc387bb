"""What is between the scene and the sensor: smoke that drifts, and blood on the lens."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from surgbench.camera import Camera
from surgbench.generators.looks.look import Look
from surgbench.generators.looks.patterns import noise, threshold

Linear = NDArray[np.float32]
SIZE_PX = 256
# Shares of the image's width that two layers of smoke drift in a second, and how bright smoke is against the image.
DRIFT = ((0.11, -0.07), (-0.05, -0.16))
SMOKE_BRIGHTNESS = 0.9
BLOOD = (0.55, 0.06, 0.05)
# Tissue near the lens, and where it is darker, against the light of the image; its wet shine, and how much darker it is
# at its edges.
NEAR, NEAR_DARK = (1.3, 0.42, 0.32), (0.55, 0.06, 0.05)
NEAR_SHINE, EDGE_DARK = 1.2, 0.9


class Haze:
    """Smoke and blood of one sequence; nothing where the look has neither.

    Args:
        camera: Of the images.
        look: Of the sequence.
    """

    def __init__(self, camera: Camera, look: Look) -> None:
        self._rng = look.rng("near tissue")
        self._near: Linear | None = None
        self._smoke, self._blood = look["smoke"], look["blood"]
        self._size = camera.width, camera.height
        if self._smoke > 0.0:
            rng = look.rng("smoke")
            self._layers = [noise(SIZE_PX, 0.4, rng, octaves=5, fade=0.5) for _ in DRIFT]
        if self._blood > 0.0:
            spots = noise(SIZE_PX, 0.3, look.rng("blood"), octaves=2, fade=0.4)
            stain = cv2.GaussianBlur(threshold(spots, self._blood, 0.6), (0, 0), SIZE_PX / 64)
            self._stain = cv2.resize(stain, self._size, interpolation=cv2.INTER_LINEAR)[..., None]

    def cover(self, light: Linear, hidden: NDArray[np.bool_]) -> Linear:
        """Linear light behind tissue that is in front of the instruments, too near to be sharp.

        Args:
            light: ``(height, width, 3)``.
            hidden: ``(height, width)`` where it is.
        """
        if self._near is None:
            self._near = self._flesh()
        cover = hidden.astype(np.float32)
        edge = cv2.GaussianBlur(cover, (0, 0), self._size[0] / 250)[..., None]
        # It is round: towards its edges less light comes back.
        lit = 1.0 - EDGE_DARK * (1.0 - cv2.GaussianBlur(cover, (0, 0), self._size[0] / 22)[..., None])
        flesh = np.float32(np.quantile(light, 0.7)) * lit * self._near
        return np.asarray(light + edge * (flesh - light), np.float32)

    def _flesh(self) -> Linear:
        """``(height, width, 3)`` of tissue near the lens, against the light of the image: folds, and a wet shine."""
        wide, fine, shine = (
            cv2.resize(noise(SIZE_PX, scale, self._rng, octaves), self._size, interpolation=cv2.INTER_LINEAR)[..., None]
            for scale, octaves in ((0.3, 4), (0.06, 2), (0.15, 3))
        )
        redness = np.clip(0.5 + 0.3 * wide, 0.0, 1.0)
        colour = np.array(NEAR, np.float32) + redness * (np.array(NEAR_DARK, np.float32) - np.array(NEAR, np.float32))
        folds = np.clip(1.0 + 0.25 * wide + 0.2 * fine, 0.2, 2.0)
        return np.asarray(colour * folds + NEAR_SHINE * np.clip(shine - 1.3, 0.0, 1.0), np.float32)

    def over(self, light: Linear, time_s: float) -> Linear:
        """Linear light ``(height, width, 3)`` through smoke and blood."""
        if self._smoke > 0.0:
            veil = self._veil(time_s)
            white = np.float32(SMOKE_BRIGHTNESS * float(np.quantile(light, 0.9)))
            light = light * (1.0 - veil) + white * veil
        if self._blood > 0.0:
            # Far out of focus, it tints what is behind it and blurs it a little.
            soft = cv2.GaussianBlur(light, (0, 0), self._size[0] / 120)
            light = light + self._stain * (soft * np.array(BLOOD, np.float32) - light)
        return np.asarray(light, np.float32)

    def _veil(self, time_s: float) -> Linear:
        """``(height, width, 1)`` share of the light that smoke takes."""
        width, height = self._size
        columns, rows = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
        scale = np.float32(SIZE_PX / (1.3 * width))
        total = np.zeros((height, width), np.float32)
        for layer, (across, down) in zip(self._layers, DRIFT, strict=True):
            u = columns * scale + np.float32(across * time_s * SIZE_PX)
            v = rows * scale + np.float32(down * time_s * SIZE_PX)
            total += cv2.remap(layer, np.mod(u, SIZE_PX - 1), np.mod(v, SIZE_PX - 1), cv2.INTER_LINEAR)
        return np.asarray(self._smoke * np.clip(0.45 + 0.3 * total, 0.0, 1.0), np.float32)[..., None]
