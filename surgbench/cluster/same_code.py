"""Whether two machines would compute the same: by the version of this package, and all of its text."""

from __future__ import annotations

import hashlib
from importlib import import_module
from pathlib import Path

from surgbench.errors import SurgbenchError
from surgbench.files import HASH_DIGITS
from surgbench.leftovers import without_leftovers
from surgbench.version import __version__

# They lie apart from each other in a checkout.
_PACKAGES = ("surgbench", "surgbench.trackers", "surgbench.generators", "surgbench.configs")
_SUFFIXES = (".py", ".yaml")


def own_code() -> str:
    """Version of this package, and the start of the SHA-256 of its text as it lies on this machine."""
    files: dict[str, Path] = {}
    for package in _PACKAGES:
        for folder in map(Path, import_module(package).__path__):
            for path in without_leftovers(folder.rglob("*"), folder):
                if path.suffix in _SUFFIXES:
                    files[f"{package}/{path.relative_to(folder).as_posix()}"] = path
    digest = hashlib.sha256()
    for name, path in sorted(files.items()):
        digest.update(f"{name}\0".encode() + path.read_bytes())
    return f"{__version__} ({digest.hexdigest()[:HASH_DIGITS]})"


def check_code(expected: str) -> None:
    """See that this machine has the code that another one asks for.

    Raises:
        SurgbenchError: It has not.
    """
    found = own_code()
    if found != expected:
        raise SurgbenchError(
            f"a worker has surgbench {found}, this command {expected}; install the same, and start the workers anew"
        )
