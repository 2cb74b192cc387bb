"""Where libraries keep what they have worked out, on machines where the home folder cannot be written.

Compiled functions (numba), kernels (Dr.Jit) and lists of fonts (Matplotlib, fontconfig) are kept below the home folder,
and numba's beside the sources where those can be written. In a container that is run by somebody else than its owner,
neither can: numba then refuses to compile at all, and the others complain in lines of their own. They get a temporary
folder there.
"""

from __future__ import annotations

import atexit
import os
import shutil
import stat
import sys
import tempfile
from functools import cache
from pathlib import Path

from surgbench.errors import ConfigError

# The library's own variable, which is left alone where it is set, and the folder below the home that it stands for.
_BELOW_HOME = {"XDG_CACHE_HOME": ".cache", "MPLCONFIGDIR": ".config", "DRJIT_CACHE_DIR": ".drjit"}


def usable(folder: Path) -> bool:
    """Whether files can be written in a folder, which need not be there yet. Nothing is made."""
    there = next((place for place in (folder, *folder.parents) if os.path.lexists(place)), None)
    return there is not None and there.is_dir() and os.access(there, os.W_OK | os.X_OK)


@cache
def settle_caches() -> Path | None:
    """Send the libraries' caches to a temporary folder, those that would be below a home that cannot be written.

    By the environment, which child processes inherit; once per process, before the libraries are loaded.

    Returns:
        The folder; ``None`` where it is not needed, or cannot be had.
    """
    lost = [variable for variable in _BELOW_HOME if not usable(_usual(variable))]
    folder = _temporary() if lost else None
    if folder is not None:
        os.environ.update(dict.fromkeys(lost, str(folder)))
    return folder


def announce_cache(sources: Path) -> None:
    """Say so where compiled code is kept in the temporary folder, where it may be gone the next time.

    Args:
        sources: A folder whose functions are compiled.

    Raises:
        ConfigError: It can be kept nowhere.
    """
    folder = settle_caches()
    named = os.environ.get("NUMBA_CACHE_DIR")
    if (named and usable(Path(named))) or usable(sources / "__pycache__"):
        return
    if folder is not None and usable(folder):
        print(
            f"surgbench: neither the home folder nor {sources} can be written: compiled code is kept in {folder}; "
            "set NUMBA_CACHE_DIR to a folder that lasts",
            file=sys.stderr,
        )
    elif not usable(_usual("XDG_CACHE_HOME")):
        raise ConfigError(
            f"compiled code can be kept nowhere: neither the home folder nor {sources} nor a temporary folder "
            "can be written; set NUMBA_CACHE_DIR to a folder that can"
        )


def _usual(variable: str) -> Path:
    """Where a library keeps its files as the environment is; a place that cannot be where there is no home."""
    if os.environ.get(variable):
        return Path(os.environ[variable])
    if variable == "MPLCONFIGDIR" and os.environ.get("XDG_CONFIG_HOME"):
        return Path(os.environ["XDG_CONFIG_HOME"])
    try:
        return Path.home() / _BELOW_HOME[variable]
    except RuntimeError:  # a user whom the system does not know; libraries would make a folder called '~'
        return Path(os.devnull) / _BELOW_HOME[variable]


def _temporary() -> Path | None:
    """This user's own folder, the same every time; one for this process where somebody else has taken that name.

    What lies there is run, so that nobody else may write in it.
    """
    try:
        lasting = Path(tempfile.gettempdir()) / f"surgbench-{os.geteuid()}"
        lasting.mkdir(mode=0o700, exist_ok=True)
        found = lasting.lstat()
        if stat.S_ISDIR(found.st_mode) and found.st_uid == os.geteuid() and not found.st_mode & 0o022:
            return lasting
    except OSError:
        pass
    try:
        passing = Path(tempfile.mkdtemp(prefix="surgbench-"))
    except OSError:
        return None
    atexit.register(shutil.rmtree, passing, ignore_errors=True)
    return passing
