"""Figures, drawn with Matplotlib where it is there."""

from __future__ import annotations

from surgbench.errors import SurgbenchError

FIGURE_PNG = "figure.png"


def check_matplotlib() -> None:
    """See whether figures can be drawn.

    Raises:
        SurgbenchError: Matplotlib is not installed.
    """
    try:
        import matplotlib  # noqa: F401
    except ImportError:
        raise SurgbenchError("figures need Matplotlib: pip install 'surgbench[plots]'") from None
