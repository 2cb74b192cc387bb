"""Figures, drawn with Matplotlib where it is there."""

from __future__ import annotations

from surgbench.errors import SurgbenchError
from surgbench.extras import not_installed

FIGURE_PNG = "figure.png"


def check_matplotlib() -> None:
    """See whether figures can be drawn.

    Raises:
        SurgbenchError: Matplotlib, or what it needs, is not installed; one line that names it.
    """
    try:
        import matplotlib  # noqa: F401
    except ModuleNotFoundError as error:
        raise SurgbenchError(f"figures need Matplotlib: {not_installed([error.name or 'matplotlib'])}") from None
    except ImportError as error:
        raise SurgbenchError(f"figures need Matplotlib, which does not load ({error})") from None
