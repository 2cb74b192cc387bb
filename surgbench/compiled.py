"""How inner loops are compiled: the engine's, and those of plug-ins that call them."""

from __future__ import annotations

import hashlib
import inspect
from functools import cache
from pathlib import Path
from typing import Any

from numba import njit
from numba.core import event

from surgbench.caches import announce_cache
from surgbench.errors import ConfigError
from surgbench.leftovers import without_leftovers
from surgbench.processes.compiling import announce_compilation


class _Announcer(event.Listener):
    """Tells of every function that is compiled, also of those of plug-ins that use numba themselves."""

    def on_start(self, event: Any) -> None:
        announce_compilation()

    def on_end(self, event: Any) -> None:
        announce_compilation()


_register: Any = event.register  # numba has no types
_register("numba:compile", _Announcer())

ENGINE = Path(__file__).parent
announce_cache(ENGINE)  # before anything is compiled: numba refuses to where it cannot keep it


@cache
def sources(folders: tuple[Path, ...]) -> str:
    """Hash of all modules of some folders.

    Raises:
        ConfigError: A folder is not there, or holds no module: code would outlive what it was compiled from.
    """
    files: list[Path] = []
    for folder in folders:
        own = sorted(without_leftovers(folder.glob("*.py")))
        if not own:
            raise ConfigError(f"{folder}: holds no modules that compiled code could depend on")
        files += own
    return hashlib.sha256(b"\0".join(file.read_bytes() for file in files)).hexdigest()


def compiled(function: Any = None, *, inline: str = "never", makes_arrays: bool = False, calls: str = "") -> Any:
    """The ``njit`` of numba as all inner loops use it.

    Compiled once per machine, without the interpreter's lock, dividing as NumPy does. And without counting references
    (atomic, at every slice), which took 40 % of a silhouette's time; so that a function that made an array would not
    compile, unless it ``makes_arrays``.

    Args:
        function: What to compile.
        inline: As numba's.
        makes_arrays: It has arrays of its own, or calls a function that has.
        calls: The engine's package with the compiled functions that it calls, where it is not in it: ``"viewpoint"``.

    Raises:
        ConfigError: There is no such package.
    """
    options: dict[str, Any] = {"cache": True, "nogil": True, "error_model": "numpy", "inline": inline}
    if not makes_arrays:
        options["_nrt"] = False
    decorator: Any = njit(**options)

    def decorate(function: Any) -> Any:
        dispatcher = decorator(function)
        # numba keeps compiled code as long as the function's own file stays the same, even where a function of another
        # file that it calls, and has swallowed, has changed. Here it is the whole package that has to stay the same.
        home = Path(inspect.getfile(function)).parent
        folders = (home, ENGINE / calls) if calls else (home,)
        dispatcher._cache._cache_file._source_stamp = sources(folders)
        return dispatcher

    return decorate if function is None else decorate(function)
