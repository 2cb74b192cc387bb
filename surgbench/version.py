"""The package's version, where modules can import it without the package's public names."""

from __future__ import annotations

__version__ = "0.2.0"
