"""The package's version, where modules can import it without the package's public names."""

from __future__ import annotations

__version__ = "0.2.0"

# As which generated datasets say that they were made: the version since which a preset gives the same bytes, raised
# when it gives others. A dataset's hash holds it, on which records and tables depend.
DATA_VERSION = "0.1.0"
