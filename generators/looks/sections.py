"""Part of a preset about images: what is rendered, and the ranges from which each sequence's look is drawn."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import AfterValidator, Field, model_validator

from surgbench.config import Finite, NotNegative, Positive, Section
from surgbench.tasks.instrument.format import ARMS, Arm

Fraction = Annotated[float, Field(ge=0, le=1)]
Variant = Literal["auto", "scalar_rgb", "llvm_ad_rgb", "cuda_ad_rgb"]
Backdrop = Literal["tissue", "drape"]


def _ordered(value: tuple[float, float]) -> tuple[float, float]:
    if value[0] > value[1]:
        raise ValueError("must be [least, most] with least <= most")
    return value


Between = Annotated[tuple[Finite, Finite], AfterValidator(_ordered)]
Share = Annotated[tuple[Fraction, Fraction], AfterValidator(_ordered)]
Amount = Annotated[tuple[NotNegative, NotNegative], AfterValidator(_ordered)]
Size = Annotated[tuple[Positive, Positive], AfterValidator(_ordered)]
Roughness = Annotated[
    tuple[Annotated[float, Field(ge=0.03, le=1)], Annotated[float, Field(ge=0.03, le=1)]], AfterValidator(_ordered)
]
Quality = Annotated[
    tuple[Annotated[int, Field(ge=1, le=100)], Annotated[int, Field(ge=1, le=100)]], AfterValidator(_ordered)
]


class LookRanges(Section):
    """Ranges of everything that one sequence's look may differ in from another's; each value is drawn evenly.

    Attributes:
        brightness: Mean of the brightest channel over the first frame, 1 being white: what the exposure is set to.
        light_radius_m: How far from the lens the light leaves the endoscope.
        light_red: Of the light's red against its green; its blue moves the other way.
        gap_m: From the deepest point that the instruments reach to the highest of what is behind them.
        relief_m: Height of what is behind them, from its lowest point to its highest.
        sway_m: How far that moves.
        sway_period_s: How long it takes for it.
        tissue_red: How red tissue is, between a pale pink and a dark red.
        tissue_fat: Share of yellow fat on it.
        tissue_wet: How bright its wet highlights are.
        tissue_roughness: How wide they are.
        vessels: How many vessels there are, 1 being a dense net.
        drape_grey: How far the drape's colour is from green to grey.
        steel_roughness: Of jaws and wrist.
        steel_grey: How bright they are.
        scratches: How many scratches there are.
        wear: How much of the surface is worn dull or stained.
        shaft_grey: How bright the shaft's coat is.
        shaft_roughness: Of the coat.
        ring_m: From the wrist to the bright ring about the shaft.
        lens_px: Standard deviation of the lens's blur.
        defocus_px: Additional blur at half and at twice the distance that is in focus.
        focus_m: Distance that is in focus.
        k1: First radial coefficient of the lens, which is taken out of the images again, as of recordings.
        fringe_px: How far red and blue are apart at the corners.
        vignette: How much darker it is as far from the middle of the light as the corners are from the image's.
        beam_x: Where the middle of the light is, from that of the image, as a share of the width.
        beam_y: The same down, as a share of the height.
        shutter: Share of the time between two frames for which the shutter is open.
        white_red: Gain of red after white balance.
        white_blue: Of blue.
        saturation: 1 leaves colours as they are.
        gamma: 1 is sRGB's own; more is more contrast.
        noise: Standard deviation of the sensor's noise in the dark, in levels of 255.
        shot: Of what grows with the root of the brightness, in levels at white.
        grain_px: Standard deviation of the blur that the noise has from colours being interpolated.
        sharpening: Of edges, by the camera.
        jpeg: Quality, where images are compressed.
        smoke: How much light smoke takes at its densest.
        blood: Share of the image that is behind blood on the lens.
    """

    brightness: Share = (0.37, 0.405)
    light_radius_m: Size = (0.003, 0.005)
    light_red: Size = (0.95, 1.08)
    gap_m: Size = (0.004, 0.02)
    relief_m: Amount = (0.008, 0.022)
    sway_m: Amount = (0.0005, 0.003)
    sway_period_s: Size = (2.5, 6.0)
    tissue_red: Share = (0.12, 0.36)
    tissue_fat: Share = (0.0, 0.25)
    tissue_wet: Share = (0.05, 0.22)
    tissue_roughness: Roughness = (0.22, 0.36)
    vessels: Share = (0.3, 1.0)
    drape_grey: Share = (0.0, 0.12)
    steel_roughness: Roughness = (0.14, 0.32)
    steel_grey: Share = (0.55, 0.85)
    scratches: Share = (0.2, 1.0)
    wear: Share = (0.1, 0.6)
    shaft_grey: Share = (0.04, 0.11)
    shaft_roughness: Roughness = (0.2, 0.4)
    ring_m: Size = (0.006, 0.012)
    lens_px: Amount = (0.75, 1.05)
    defocus_px: Amount = (0.5, 2.0)
    focus_m: Size = (0.12, 0.16)
    k1: Between = (-0.28, -0.2)
    fringe_px: Amount = (0.0, 0.6)
    vignette: Share = (0.78, 0.92)
    beam_x: Between = (-0.35, 0.35)
    beam_y: Between = (-0.35, 0.35)
    shutter: Share = (0.2, 0.6)
    white_red: Size = (0.95, 1.05)
    white_blue: Size = (0.95, 1.05)
    saturation: Amount = (0.86, 1.02)
    gamma: Size = (0.95, 1.1)
    noise: Amount = (2.8, 3.8)
    shot: Amount = (3.3, 5.8)
    grain_px: Amount = (0.5, 0.7)
    sharpening: Amount = (0.2, 0.6)
    jpeg: Quality = (75, 95)
    smoke: Share = (0.0, 0.0)
    blood: Share = (0.0, 0.0)


class Stereo(Section):
    """The other eye of a stereo endoscope, as the auxiliary view ``right-eye``.

    Attributes:
        baseline_m: From the left eye to the right one.
        vergence_rad: How far the right eye is turned towards the left one's axis.
    """

    baseline_m: Positive = 0.0055
    vergence_rad: Annotated[float, Field(ge=0, le=0.2)] = 0.0


class Images(Section):
    """Images beside the masks.

    Attributes:
        samples: Rays a pixel.
        variant: Of Mitsuba. ``auto``: the first of llvm_ad_rgb and scalar_rgb that loads.
        arms: Which arms are in the images; of the other one there are masks alone.
        backdrop: What lies behind the instruments, drawn for each sequence from these.
        compression: ``jpeg``: images are compressed as JPEG files are, and kept as PNG.
        stereo: The other eye; there is none unless told.
        depth: Whether ``truth`` has depth images.
        links: Whether ``truth`` has masks of the links.
        markers: Whether coloured markers are painted on the instruments: those of the instrument file, or else ours.
        look: Ranges of what differs from sequence to sequence.
    """

    samples: Annotated[int, Field(ge=1, le=1024)] = 8
    variant: Variant = "auto"
    arms: Annotated[tuple[Arm, ...], Field(min_length=1)] = ARMS
    backdrop: Annotated[tuple[Backdrop, ...], Field(min_length=1)] = ("tissue",)
    compression: Literal["none", "jpeg"] = "none"
    stereo: Stereo | None = None
    depth: bool = False
    links: bool = False
    markers: bool = False
    look: LookRanges = LookRanges()

    @model_validator(mode="after")
    def _once(self) -> Images:
        for name in ("arms", "backdrop"):
            if len(set(getattr(self, name))) < len(getattr(self, name)):
                raise ValueError(f"{name} names one twice")
        return self
