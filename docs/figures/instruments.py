"""Draw ``docs/images/instruments.png``: the whole catalogue, to one scale.

    python docs/figures/instruments.py

Needs nothing but surgbench: it is what ``surgbench instrument show`` draws with.
"""

from __future__ import annotations

from pathlib import Path

import cv2

from surgbench.config import packaged_names
from surgbench.instrument import load_instrument
from surgbench.instrument.drawing import draw_catalogue

SHEET = Path(__file__).parents[1] / "images" / "instruments.png"

if __name__ == "__main__":
    picture = draw_catalogue([load_instrument(name) for name in packaged_names("instruments")])
    SHEET.write_bytes(cv2.imencode(".png", picture[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 9])[1].tobytes())
