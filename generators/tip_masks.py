"""Masks with known tips, to train keypoint detectors on: the hypothesis space of Liang et al., corrupted.

Poses are those of :mod:`surgbench.search.hypotheses`, the wrist anywhere in the image. Every mask has its own stream of
random numbers, so that it does not depend on which others are made. Masks are painted by the engine's silhouettes,
which give the same pixels as the renderer of datasets (``tests/silhouette/test_silhouette.py``) without Mitsuba.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import lru_cache
from typing import Annotated, Literal

import cv2
import numpy as np
from pydantic import Field, model_validator

from surgbench.camera import Camera
from surgbench.config import NotNegative, Positive, Section
from surgbench.contract import Mask
from surgbench.errors import ConfigError
from surgbench.generators.corruption import corrupt
from surgbench.generators.mismatch import real_instrument
from surgbench.generators.presets import CORRUPTION_LEVELS, PAPER_CAMERA, Corruption, Morphology
from surgbench.generators.sections import Fraction, Mismatch
from surgbench.geometry import FloatArray
from surgbench.instrument import Instrument, load_instrument
from surgbench.instrument.spec import LinkPoint
from surgbench.keypoints.labelled import LabelledMask
from surgbench.randomness import generator
from surgbench.search.hypotheses import hypothesis_states
from surgbench.silhouette import Reference, SilhouetteEvaluator

# That of Liang et al.'s recordings (arXiv:2503.05953), with the principal point far to the left.
LIANG_CAMERA = Camera(width=640, height=480, fx=1025.88223, fy=1025.88223, cx=167.919017, cy=234.152707)
# A wider lens, in which instruments are smaller.
WIDE_CAMERA = Camera(width=640, height=480, fx=700.0, fy=700.0, cx=319.5, cy=239.5)

Range = tuple[float, float]
JawExtra = Annotated[float, Field(ge=-0.005, le=0.02)]
Kind = Literal["none", "published", "strong", "smooth"]
SHARES: dict[Kind, float] = {"none": 0.1, "published": 0.5, "strong": 0.15, "smooth": 0.25}
# A segmentation network's mask: too fat, thin parts above all, and computed at a lower resolution, so that its corners
# are round. On the real masks that we know, the jaws are twice as wide as they are.
FATTER = Corruption(
    morphology=(Morphology(kernel_px=7, probability=0.3), Morphology(kernel_px=5, probability=0.3)),
    dilation_share=1.0,
    blobs=(),
)
NEARLY_CLOSED_RAD = 0.2
TRIES = 1000
# A tip nearer than this to the silhouette of shaft and wrist hardly sticks out of it; and where no pixel of the mask is
# left so near to a tip, the corruption has eaten it.
CLEAR_M = 0.001
# A tip seen nearer than this to its jaw's axis does not stick out of its own hinge: the jaw points at the camera.
HINGE_M = 0.0035
# A jaw is 1.2 mm across, and corruption makes it a little fatter. A tip farther from the background is under a disc.
OUTLINE_M = 0.00075
FATTER_PX = 4.0


class TipMaskSettings(Section):
    """What the masks are drawn from; the defaults are those that the model that comes with the package was trained on.

    Attributes:
        instrument: Built-in name or instrument file.
        variants: So many instruments of slightly different dimensions are drawn.
        body_scale: Range of the size of wrist and jaws.
        shaft_radius_scale: Range of the thickness of the shaft.
        jaw_extra_m: Range of how much longer the jaws are.
        cameras: Each mask is of one of them.
        distance_m: Of the wrist along the optical axis.
        elevation_deg: Tilt of the shaft against the optical axis.
        margin: How far outside the image the wrist may be, in shares of its width and height.
        pitch_rad: Largest absolute q1.
        yaw_rad: Largest absolute q2.
        jaw_rad: Range of q3.
        closed_share: How often the jaws are nearly closed (q3 below 0.2) instead.
        corruption: How often each kind occurs: the levels of presets, and ``smooth``, rounded like a segmentation
            network's masks. The shares sum to 1.
        smooth_px: Range of the rounding's standard deviation, at a width of 700 pixels.
    """

    instrument: str = "large_needle_driver"
    variants: Annotated[int, Field(ge=1, le=64)] = 48
    body_scale: tuple[Positive, Positive] = (0.94, 1.08)
    shaft_radius_scale: tuple[Positive, Positive] = (0.94, 1.06)
    jaw_extra_m: tuple[JawExtra, JawExtra] = (-0.0005, 0.001)
    cameras: Annotated[tuple[Camera, ...], Field(min_length=1)] = (PAPER_CAMERA, LIANG_CAMERA, WIDE_CAMERA)
    distance_m: tuple[Positive, Positive] = (0.08, 0.20)
    elevation_deg: Range = (20.0, 75.0)
    margin: Fraction = 0.0
    pitch_rad: Positive = 1.3963
    yaw_rad: Positive = 1.3963
    jaw_rad: tuple[NotNegative, NotNegative] = (0.0, 1.2)
    closed_share: Fraction = 0.2
    corruption: dict[Kind, Fraction] = SHARES
    smooth_px: tuple[NotNegative, NotNegative] = (0.5, 2.5)

    @model_validator(mode="after")
    def _in_order(self) -> TipMaskSettings:
        for name in ("body_scale", "shaft_radius_scale", "jaw_extra_m", "distance_m", "elevation_deg", "jaw_rad",
                     "smooth_px"):  # fmt: skip
            low, high = getattr(self, name)
            if not low <= high:
                raise ValueError(f"{name} must be [lower, upper]")
        if not np.isclose(sum(self.corruption.values()), 1.0):
            raise ValueError("the shares of corruption must sum to 1")
        return self


def in_published_space(settings: TipMaskSettings) -> TipMaskSettings:
    """The same instrument, cameras and corruption in the poses that accuracies are told on.

    They are those that the paper's network is trained on (released code; the wrist there is within 1 cm of the optical
    axis, here anywhere).
    """
    return settings.model_copy(
        update={
            "distance_m": (0.10, 0.17),
            "elevation_deg": (30.0, 60.0),
            "pitch_rad": 1.3,
            "yaw_rad": 1.1,
            "jaw_rad": (0.0, 1.2),
        }
    )


HELD_OUT = in_published_space(TipMaskSettings())


class TipMasks:
    """So many masks of one seed and purpose.

    Args:
        settings: What they are drawn from.
        count: How many there are.
        seed: 0 is a seed like any other.
        part: Name of the set, for example ``"training"``; sets of different names share no mask and no instrument.
    """

    def __init__(self, settings: TipMaskSettings, count: int, seed: int, part: str) -> None:
        self.settings, self.count, self.seed, self.part = settings, count, seed, part

    def __len__(self) -> int:
        """How many masks."""
        return self.count

    def __iter__(self) -> Iterator[LabelledMask]:
        """All of them in order."""
        return (self[index] for index in range(self.count))

    def __getitem__(self, index: int) -> LabelledMask:
        """One mask; the same number is the same mask.

        Raises:
            IndexError: There are not so many.
            ConfigError: The settings hardly ever place the instrument in the image.
        """
        if not 0 <= index < self.count:
            raise IndexError(index)
        settings = self.settings
        rng = generator(purpose="tip masks", part=self.part, seed=self.seed, index=index)
        camera = settings.cameras[rng.integers(len(settings.cameras))]
        painter = _painter(settings, self.part, int(rng.integers(settings.variants)), camera)
        for _ in range(TRIES):
            state = self._state(camera, rng)
            clean = painter.mask(state)
            if clean.any():
                break
        else:
            raise ConfigError(f"data: no instrument in the image in {TRIES} tries; see distance_m and margin")
        kind = str(rng.choice(list(settings.corruption), p=list(settings.corruption.values())))
        mask = self._corrupted(clean, kind, rng)
        return LabelledMask(
            mask=mask,
            camera=camera,
            tips_px=camera.project(painter.instrument.tips_cam(state)),
            shows=painter.shows(state, mask),
            opening_rad=float(state[-1]),
            corruption=kind,
        )

    def _state(self, camera: Camera, rng: np.random.Generator) -> FloatArray:
        settings = self.settings
        closed = rng.random() < settings.closed_share
        jaw = rng.uniform(0.0, NEARLY_CLOSED_RAD) if closed else rng.uniform(*settings.jaw_rad)
        joints = np.array(
            [
                rng.uniform(-settings.pitch_rad, settings.pitch_rad),
                rng.uniform(-settings.yaw_rad, settings.yaw_rad),
                jaw,
            ]
        )
        share = rng.uniform(-settings.margin, 1.0 + settings.margin, 2)
        low, high = settings.elevation_deg
        state: FloatArray = hypothesis_states(
            camera,
            rng.uniform(0, 2 * np.pi, 1),
            np.deg2rad(rng.uniform(low, high, 1)),
            rng.uniform(0, 2 * np.pi, 1),
            rng.uniform(*settings.distance_m, 1),
            (share[:1] * camera.width, share[1:] * camera.height),
            joints[None],
        )[0]
        return state

    def _corrupted(self, mask: Mask, kind: str, rng: np.random.Generator) -> Mask:
        if kind != "smooth":
            corrupted: Mask = corrupt(mask, CORRUPTION_LEVELS[kind], rng)
            return corrupted
        sigma = rng.uniform(*self.settings.smooth_px) * mask.shape[1] / PAPER_CAMERA.width
        blurred = cv2.GaussianBlur(corrupt(mask, FATTER, rng).astype(np.float32), (0, 0), max(sigma, 0.1))
        rounded: Mask = blurred > 0.5
        return rounded


class Painter:
    """Paints one instrument in one camera, and tells which tips its masks show.

    Args:
        instrument: With exactly two tips, on links of their own.
        camera: What sees it.
    """

    def __init__(self, instrument: Instrument, camera: Camera) -> None:
        self.instrument, self._camera = instrument, camera
        jaws = {tip.link for tip in instrument.spec.tips}
        self._hinges = tuple(LinkPoint(link=tip.link, point_m=(0.0, 0.0, 0.0)) for tip in instrument.spec.tips)
        self._whole = SilhouetteEvaluator([instrument], camera)
        self._body = SilhouetteEvaluator([_with(instrument, set(instrument.meshes) - jaws)], camera)
        self._other_jaws = [
            SilhouetteEvaluator([_with(instrument, jaws - {tip.link})], camera) for tip in instrument.spec.tips
        ]

    def mask(self, state: FloatArray) -> Mask:
        """``(H, W)`` bool."""
        return self._whole.mask(state)

    def shows(self, state: FloatArray, mask: Mask) -> np.ndarray:
        """Which tips can be seen in a mask, ``(2,)`` bool; see :class:`~surgbench.keypoints.labelled.LabelledMask`.

        Args:
            state: ``(9,)`` true state.
            mask: ``(H, W)`` what became of its mask.
        """
        tips = self.instrument.tips_cam(state)
        tips_px = self._camera.project(tips)
        hinges_px = self._camera.project(self.instrument.points_cam(state, self._hinges))
        px_per_m = float(self._camera.fx / max(tips[:, 2].mean(), 1e-3))
        clear_px, outline_px = CLEAR_M * px_per_m, OUTLINE_M * px_per_m + FATTER_PX
        shows = np.zeros(len(tips_px), dtype=bool)
        for tip, (other_jaw, place) in enumerate(zip(self._other_jaws, tips_px, strict=True)):
            sticks_out = np.linalg.norm(place - hinges_px[tip]) >= HINGE_M * px_per_m
            shows[tip] = (
                self._camera.contains(place)
                and sticks_out
                and not self._touches(other_jaw, state, place, 0)
                and not self._touches(self._body, state, place, round(clear_px))
                and _any_within(mask, place, clear_px)
                and _any_within(~mask, place, outline_px)
            )
        return shows

    def _touches(self, part: SilhouetteEvaluator, state: FloatArray, place: FloatArray, radius_px: int) -> bool:
        disc = np.zeros((self._camera.height, self._camera.width), dtype=np.uint8)
        cv2.circle(disc, (round(place[0]), round(place[1])), radius_px, 1, thickness=-1)
        return bool(part.score(state[None], Reference(disc > 0)).overlap[0] > 0)


def _with(instrument: Instrument, links: set[str]) -> Instrument:
    """An instrument of which only some links have a body."""
    return replace(instrument, meshes={name: mesh for name, mesh in instrument.meshes.items() if name in links})


def _any_within(pixels: Mask, place_px: FloatArray, radius_px: float) -> bool:
    """Whether any of some pixels lies within ``radius_px`` of a place."""
    low = np.maximum(np.floor(place_px - radius_px).astype(int), 0)
    high = np.ceil(place_px + radius_px).astype(int) + 1
    rows, columns = np.nonzero(pixels[low[1] : max(high[1], 0), low[0] : max(high[0], 0)])
    away = np.hypot(columns + low[0] - place_px[0], rows + low[1] - place_px[1])
    return bool((away <= radius_px).any())


def _painter(settings: TipMaskSettings, part: str, variant: int, camera: Camera) -> Painter:
    ranges = (settings.body_scale, settings.shaft_radius_scale, settings.jaw_extra_m)
    return _cached_painter(settings.instrument, part, variant, ranges, camera)


@lru_cache(maxsize=256)
def _cached_painter(name: str, part: str, variant: int, ranges: tuple[Range, Range, Range], camera: Camera) -> Painter:
    rng = generator(purpose="tip masks", part=part, variant=variant)
    body, shaft, jaw = (rng.uniform(*bounds) for bounds in ranges)
    dimensions = Mismatch(body_scale=body, shaft_radius_scale=shaft, jaw_extra_m=jaw)
    return Painter(real_instrument(load_instrument(name), dimensions), camera)
