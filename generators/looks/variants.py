"""Which variant of Mitsuba renders images: the fastest that loads, or the one that is asked for."""

from __future__ import annotations

import sys
import warnings
from typing import Any

from surgbench.errors import ConfigError
from surgbench.rendering.depth import load_mitsuba

# Older versions of LLVM kill the process.
LEAST_LLVM = 17
PREFERRED = ("llvm_ad_rgb", "scalar_rgb")


def pick(wanted: str) -> str:
    """The variant that a preset's ``images.variant`` means on this machine.

    Args:
        wanted: A variant, or ``auto``.

    Raises:
        ConfigError: The one that is asked for does not load here; one line.
        SurgbenchError: Mitsuba cannot be loaded at all.
    """
    load_mitsuba()
    if wanted == "auto":
        return next(variant for variant in PREFERRED if loads(variant))
    if not loads(wanted):
        raise ConfigError(f"images.variant: {wanted} does not load on this machine; scalar_rgb does everywhere")
    return wanted


def loads(variant: str) -> bool:
    """Whether a variant of Mitsuba works here, without trying what would end the process."""
    import drjit

    if variant.startswith("llvm"):
        version = _llvm_version(drjit)
        return version is not None and version[0] >= LEAST_LLVM
    if variant.startswith("cuda"):
        return bool(drjit.has_backend(drjit.JitBackend.CUDA))
    return True


def _llvm_version(drjit: Any) -> tuple[int, ...] | None:
    if not drjit.has_backend(drjit.JitBackend.LLVM):
        return None
    version = drjit.detail.llvm_version()
    return None if version is None else tuple(version)


def use(variant: str) -> Any:
    """Mitsuba with this variant set."""
    mi = sys.modules.get("mitsuba")
    # To change it there and back compiles a dozen of Mitsuba's integrators anew.
    if mi is None or mi.variant() != variant:
        mi = load_mitsuba()
        with warnings.catch_warnings():  # and after some hundred frames it says that this takes time
            warnings.filterwarnings("ignore", message="The AST-transforming decorator", category=RuntimeWarning)
            mi.set_variant(variant)
    return mi
