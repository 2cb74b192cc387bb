"""Articulated instruments as data: kinematics, limits, tips, and closed meshes for every link."""

from surgbench.instrument.files import load_instrument, save_instrument
from surgbench.instrument.model import Instrument

__all__ = ["Instrument", "load_instrument", "save_instrument"]
