"""Files that plug-ins are asked for as ``FILE.py:Class``, loaded with the modules beside them.

A folder becomes a package that only its own files know: ``import helper`` in one of them, at the top or inside a
function, is the ``helper.py`` beside it, whatever another folder has of that name, and nobody else's import finds it.
"""

from __future__ import annotations

import builtins
import importlib
import importlib.util
import sys
from collections.abc import Mapping, Sequence
from functools import cache, partial
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder, SourceFileLoader
from pathlib import Path
from types import ModuleType
from typing import Any

from surgbench.files import sha256_text

PREFIX = "surgbench_plugin_"


def load_file(path: Path) -> ModuleType:
    """The module of a file, loaded once; its classes are findable by name, so that instances can be pickled."""
    package = _package(path.parent)
    name = f"{package}.{path.stem.replace('.', '_')}"
    if name not in sys.modules:
        importlib.invalidate_caches()  # what lies beside it may have been written a moment ago
        spec = importlib.util.spec_from_file_location(name, path, loader=_FileLoader(name, str(path)))
        assert spec is not None
        module = importlib.util.module_from_spec(spec)
        sys.modules[name] = module
        try:
            _FileLoader(name, str(path)).exec_module(module)
        except BaseException:
            del sys.modules[name]
            raise
    return sys.modules[name]


@cache
def lies_beside(folder: Path, name: str) -> bool:
    """Whether the files of a folder mean something in it by the top-level module ``name``.

    As for a script, what lies beside it comes first; but it does not replace the standard library or surgbench, nor
    does a folder without ``__init__.py`` replace what is installed.
    """
    if name in sys.stdlib_module_names or name == "surgbench":
        return False
    found = PathFinder.find_spec(name, [str(folder)])
    if found is None or found.origin is not None:
        return found is not None
    try:
        elsewhere = importlib.util.find_spec(name)
    except (ImportError, ValueError):
        elsewhere = None
    return elsewhere is None or elsewhere.origin is None


def _package(folder: Path) -> str:
    """The name of the package that a folder is."""
    name = f"{PREFIX}{sha256_text(str(folder))[:16]}"
    if name not in sys.modules:
        package = ModuleType(name)
        package.__path__ = [str(folder)]
        sys.modules[name] = package
    return name


class _FileLoader(SourceFileLoader):
    """Loads a file whose imports look beside it first."""

    def exec_module(self, module: ModuleType) -> None:
        package = module.__name__.partition(".")[0]
        vars(module)["__builtins__"] = {**vars(builtins), "__import__": partial(_import, package)}
        super().exec_module(module)


def _import(
    package: str,
    name: str,
    globals: Mapping[str, Any] | None = None,
    locals: Mapping[str, Any] | None = None,
    fromlist: Sequence[str] | None = (),
    level: int = 0,
) -> ModuleType:
    """The import statement of a package's files."""
    top = name.partition(".")[0]
    if level or not lies_beside(Path(sys.modules[package].__path__[0]), top):
        return builtins.__import__(name, globals, locals, fromlist or (), level)
    importlib.import_module(f"{package}.{name}")
    if not fromlist:
        return sys.modules[f"{package}.{top}"]
    return builtins.__import__(f"{package}.{name}", globals, locals, fromlist, 0)


class _Finder(MetaPathFinder):
    """Finds what lies in the packages that folders are."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if not fullname.startswith(PREFIX):
            return None
        if not path:
            # Numba imports the module of code that it has kept, of which the code needs nothing. Its folder may have
            # had another name then.
            return ModuleSpec(fullname, _NothingLoader(), is_package=True)
        spec = PathFinder.find_spec(fullname, path)
        if spec is not None and isinstance(spec.loader, SourceFileLoader):
            spec.loader = _FileLoader(fullname, spec.loader.path)
        return spec


class _NothingLoader(Loader):
    def create_module(self, spec: ModuleSpec) -> ModuleType | None:
        return None

    def exec_module(self, module: ModuleType) -> None:
        pass


if not any(isinstance(finder, _Finder) for finder in sys.meta_path):
    sys.meta_path.insert(0, _Finder())
