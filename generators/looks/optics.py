"""From linear light to an image: the lens, the sensor, its processing, and compression.

In order: blur by distance (each pixel by its own depth, after rendering), smoke and blood, glare, the lens's blur,
fringes, vignette and distortion, exposure, white balance, tone curve, noise, sharpening, compression; at the end the
distortion is taken out, as of recordings, so that masks and truth are a pinhole camera's.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from surgbench.camera import Camera
from surgbench.generators.looks.haze import Haze
from surgbench.generators.looks.look import Look
from surgbench.geometry import FloatArray

Linear = NDArray[np.float32]
LUMA = np.array([0.2126, 0.7152, 0.0722], np.float32)
BLURS_PX = (0.0, 0.8, 1.6, 3.2)
# Share of what is brighter than white that spreads, and how far, as a share of the width.
GLARE, GLARE_WIDTH = 0.08, 1 / 50
# Linear light that just saturates, exposure applied: a knee bends what is brighter than half of white.
WHITE = 2.5
SHARPEN_PX = 1.3
# Share of the noise that all colours have in common, as their interpolation and denoising leaves it.
GREY_NOISE = 0.5
BISECTIONS = 40


class Optics:
    """Everything between the light and the file, of one sequence.

    Args:
        camera: Pinhole, whose image is wanted.
        look: Of the sequence.
        jpeg: Whether images are compressed.
    """

    def __init__(self, camera: Camera, look: Look, *, jpeg: bool) -> None:
        self._look, self._jpeg = look, jpeg
        self._haze = Haze(camera, look)
        rows, columns = np.mgrid[: camera.height, : camera.width].astype(np.float64)
        middle = (0.5 + look["beam_x"]) * (camera.width - 1), (0.5 + look["beam_y"]) * (camera.height - 1)
        off = np.stack([columns - middle[0], rows - middle[1]], axis=-1)
        far = np.hypot(camera.width, camera.height) / 2
        # The light is beside the lens: what it is darker towards its edge looks as if the lens did it.
        dark = (1.0 - look["vignette"]) ** ((off**2).sum(-1) / far**2)
        self._vignette = dark.astype(np.float32)[..., None]
        self._bent = self._straight = None
        if look["k1"] != 0.0:
            lens = camera.model_copy(update={"distortion": (look["k1"], 0.0, 0.0, 0.0)}).lens
            grid = np.stack([columns, rows], axis=-1)
            self._bent = _maps(lens.undistort(grid), grid)
            self._straight = lens.maps
        spread = look["fringe_px"] / far
        self._fringes = [
            np.array([[1 + s, 0, -s * (camera.width - 1) / 2], [0, 1 + s, -s * (camera.height - 1) / 2]])
            for s in (spread, -spread)
        ]
        self.gain = 1.0

    def expose(self, linear: Linear, depth_m: FloatArray) -> None:
        """Set the exposure so that this image is as bright as the look says; of the first frame of a sequence."""
        self.gain = 1.0
        seen = self._seen(linear, depth_m, 0.0)
        low, high = 1e-6, 1e6
        for _ in range(BISECTIONS):
            middle = float(np.sqrt(low * high))
            if float(self._toned(seen * np.float32(middle)).max(axis=2).mean()) < self._look["brightness"]:
                low = middle
            else:
                high = middle
        self.gain = float(np.sqrt(low * high))

    def image(
        self,
        linear: Linear,
        depth_m: FloatArray,
        time_s: float,
        rng: np.random.Generator,
        hidden: NDArray[np.bool_] | None = None,
    ) -> NDArray[np.uint8]:
        """The image of one frame.

        Args:
            linear: ``(height, width, 3)``.
            depth_m: ``(height, width)``; 0 where there is nothing.
            time_s: Of the frame, for smoke.
            rng: The only source of the sensor's noise.
            hidden: ``(height, width)`` where something close to the lens is in front.

        Returns:
            ``(height, width, 3)`` RGB.
        """
        look = self._look
        toned = self._toned(self._seen(linear, depth_m, time_s, hidden) * np.float32(self.gain))
        noise = np.float32(np.sqrt(1.0 - GREY_NOISE)) * rng.standard_normal(toned.shape, dtype=np.float32)
        noise += np.float32(np.sqrt(GREY_NOISE)) * rng.standard_normal(toned.shape[:2], dtype=np.float32)[..., None]
        if look["grain_px"] > 0.0:
            noise = _blurred(noise, look["grain_px"])
            noise /= max(float(noise.std()), 1e-6)
        spread = (look["noise"] + look["shot"] * np.sqrt(toned)) / np.float32(255.0)
        toned = np.asarray(toned + noise * spread, np.float32)
        if look["sharpening"] > 0.0:
            toned = toned + np.float32(look["sharpening"]) * (toned - _blurred(toned, SHARPEN_PX))
        image: NDArray[np.uint8] = np.rint(np.clip(toned, 0.0, 1.0) * 255.0).astype(np.uint8)
        if self._jpeg:
            image = compressed(image, int(look["jpeg"]))
        if self._straight is not None:
            straight = cv2.remap(image, *self._straight, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            image = np.asarray(straight, np.uint8)
        return image

    def _seen(
        self, linear: Linear, depth_m: FloatArray, time_s: float, hidden: NDArray[np.bool_] | None = None
    ) -> Linear:
        """Light on the sensor: everything that the lens does."""
        look = self._look
        light = np.ascontiguousarray(linear, np.float32)
        if look["defocus_px"] > 0.0:
            light = defocused(light, depth_m, look["focus_m"], look["defocus_px"])
        if hidden is not None and hidden.any():
            light = self._haze.cover(light, hidden)
        light = self._haze.over(light, time_s)
        excess = np.maximum(light * np.float32(self.gain) - 1.0, 0.0) / np.float32(self.gain)
        light = light + np.float32(GLARE) * _blurred(np.minimum(excess, 4.0 / self.gain), GLARE_WIDTH * light.shape[1])
        if look["lens_px"] > 0.0:
            light = _blurred(light, look["lens_px"])
        if look["fringe_px"] > 0.0:
            size = light.shape[1], light.shape[0]
            for channel, warp in zip((0, 2), self._fringes, strict=True):
                plane = np.ascontiguousarray(light[..., channel])
                light[..., channel] = cv2.warpAffine(
                    plane, warp, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
                )
        if self._bent is not None:
            light = np.asarray(cv2.remap(light, *self._bent, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))
        return np.asarray(light * self._vignette, np.float32)

    def _toned(self, light: Linear) -> Linear:
        """Exposed light as the camera's values, 0 to 1."""
        look = self._look
        white = np.array([look["white_red"], 1.0, look["white_blue"]], np.float32)
        grey = (light * LUMA).sum(axis=2, keepdims=True)
        colour = np.maximum(grey + look["saturation"] * (light - grey), 0.0) * white
        shoulder = np.minimum(colour * (1.0 + colour / np.float32(WHITE**2)) / (1.0 + colour), 1.0)
        low = shoulder * np.float32(12.92)
        curve = np.where(shoulder <= 0.0031308, low, 1.055 * np.power(shoulder, np.float32(1 / 2.4)) - 0.055)
        return np.asarray(np.power(np.maximum(curve, 0.0), np.float32(look["gamma"])), np.float32)


def defocused(light: Linear, depth_m: FloatArray, focus_m: float, blur_px: float) -> Linear:
    """Blur by distance: each pixel a mixture of images of equal blur.

    Args:
        light: ``(height, width, 3)``.
        depth_m: ``(height, width)``; 0 where there is nothing, which is not blurred.
        focus_m: Distance in focus.
        blur_px: Standard deviation at half and at twice that distance.
    """
    wanted = blur_px * np.abs(np.log2(np.where(depth_m > 0, depth_m, focus_m) / focus_m))
    sigma_px = _blurred(np.clip(wanted, 0.0, BLURS_PX[-1]).astype(np.float32), 1.0)
    result = np.zeros_like(light)
    for level, sigma in enumerate(BLURS_PX):
        weight = np.interp(sigma_px, BLURS_PX, np.eye(len(BLURS_PX))[level]).astype(np.float32)
        if weight.any():
            result += weight[..., None] * _blurred(light, sigma)
    return result


def compressed(image: NDArray[np.uint8], quality: int) -> NDArray[np.uint8]:
    """An image as it comes out of a JPEG file."""
    done, data = cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])
    assert done
    decoded: Any = cv2.imdecode(data, cv2.IMREAD_COLOR)
    return np.ascontiguousarray(decoded[..., ::-1])


def _maps(wanted: FloatArray, grid: FloatArray) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    places = np.where(np.isfinite(wanted), wanted, grid).astype(np.float32)
    return np.ascontiguousarray(places[..., 0]), np.ascontiguousarray(places[..., 1])


def _blurred(image: Linear, sigma: float) -> Linear:
    if sigma <= 0.0:
        return image
    return np.asarray(cv2.GaussianBlur(image, (0, 0), float(sigma), borderType=cv2.BORDER_REPLICATE), np.float32)
