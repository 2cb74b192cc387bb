"""The look of one sequence: drawn from a preset's ranges, kept as part of the truth."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import yaml

from surgbench.generators.looks.sections import Backdrop, Images
from surgbench.randomness import generator

FORMAT = "surgbench-look-1"


@dataclass(frozen=True)
class Look:
    """What a sequence looks like.

    Attributes:
        backdrop: What lies behind the instruments.
        values: Name of a range (:class:`surgbench.generators.looks.sections.LookRanges`) to the value drawn from it.
        axes: Dataset and sequence, for what is drawn further.
    """

    backdrop: Backdrop
    values: Mapping[str, float]
    axes: Mapping[str, str | int]

    def __getitem__(self, name: str) -> float:
        return self.values[name]

    def rng(self, purpose: str, **axes: str | int) -> Any:
        """A generator of its own for something of this sequence."""
        return generator(**self.axes, **axes, look=purpose)


def draw_look(images: Images, **axes: str | int) -> Look:
    """Draw a sequence's look: each value on its own, so that none depends on another's range.

    Args:
        images: The preset's section.
        axes: Dataset and sequence.
    """
    values = {name: float(generator(**axes, look=name).uniform(low, high)) for name, (low, high) in images.look}
    values["jpeg"] = float(round(values["jpeg"]))
    backdrop = images.backdrop[int(generator(**axes, look="backdrop").integers(len(images.backdrop)))]
    return Look(backdrop, values, axes)


def encode_look(look: Look, images: Images, variant: str) -> bytes:
    """The bytes of ``look.yaml``.

    Args:
        look: What was drawn.
        images: The preset's section.
        variant: Of Mitsuba, as it was picked.
    """
    content = {
        "format": FORMAT,
        "backdrop": look.backdrop,
        "arms": list(images.arms),
        "compression": images.compression,
        "rays_per_pixel": images.samples,
        "variant": variant,
        "look": dict(sorted(look.values.items())),
    }
    return yaml.safe_dump(content, sort_keys=False, width=120).encode()
