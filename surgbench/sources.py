"""The code that estimates are made by: modules and what they import, found in their text, without running them.

Imports inside functions count; what is imported by a name made up at run time does not.
"""

from __future__ import annotations

import ast
import hashlib
import sys
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from surgbench.files import HASH_DIGITS, sha256_file
from surgbench.leftovers import without_leftovers
from surgbench.plugin_files import PREFIX, lies_beside
from surgbench.syntax import parse_file

ENGINE = "surgbench"
# Plug-ins lie in packages of the engine's, and are no part of it. What they consist of is their own.
PLUGGED_IN = ("trackers", "generators", "exchange", "tasks")
# Rooms of the engine that move estimates about, and make none.
PLUMBING = (
    "board", "caches", "cli", "cluster", "comparison", "configs", "conformance", "errors", "exporting", "extras",
    "files", "generation", "kinds", "leftovers", "locks", "plugin_files", "processes", "recordings", "records",
    "registry", "report", "reproduce", "sources", "suite", "task",
)  # fmt: skip


@dataclass(frozen=True)
class Module:
    """A module as text.

    Attributes:
        name: Dotted; of a plug-in's file and of what lies beside it, as seen from their folder.
        path: Its file.
        folder: That folder; ``None`` for modules of installed packages.
    """

    name: str
    path: Path
    folder: Path | None = None

    @property
    def home(self) -> tuple[Path | None, str]:
        """Folder or package whose modules belong together: of the engine's, those of plug-ins stand for themselves."""
        parts = self.name.split(".")
        if self.folder is not None:
            return self.folder, ""
        if parts[0] != ENGINE or not set(parts[1:2]) & set(PLUGGED_IN):
            return None, parts[0]
        return None, ".".join(parts[: 3 if parts[1] == "tasks" else 2])

    @property
    def is_plumbing(self) -> bool:
        """Whether it is of the engine, and makes no estimates."""
        parts = self.name.split(".")
        return self.home == (None, ENGINE) and (len(parts) == 1 or parts[1] in PLUMBING)


def own_modules(names: Iterable[str]) -> frozenset[Module]:
    """What a plug-in consists of: some modules, and what they import of their own package or folder.

    Args:
        names: Of modules that are imported.
    """
    starts = list(filter(None, map(_imported, names)))
    homes = {module.home for module in starts}
    return _reached(starts, lambda module: module.home in homes)


def engine_modules(plugins: Iterable[str], task: Iterable[str]) -> frozenset[Module]:
    """What makes estimates and errors besides plug-ins: modules of a task, and of the engine all but its plumbing.

    Args:
        plugins: Names of imported modules of plug-ins; what these import of the engine counts.
        task: Names of a task's modules; no others of its package count.
    """
    named = [Module(name, path) for name in task if (path := _installed(name.split("."))) is not None]
    starts = [*filter(None, map(_imported, plugins)), *named]
    homes = {module.home for module in starts} - {module.home for module in named}

    def is_engine(module: Module) -> bool:
        return module in named or (module.home == (None, ENGINE) and not module.is_plumbing)

    return frozenset(filter(is_engine, _reached(starts, lambda module: module.home in homes or is_engine(module))))


def package_modules(name: str) -> tuple[str, ...]:
    """Names of all modules of the package that an imported module is in, or of itself where it is in none."""
    package = name.rpartition(".")[0]
    found = _imported(package) if package else None
    if found is None:
        return (name,)
    folder = found.path.parent
    inside = (
        path.relative_to(folder).with_suffix("").parts
        for path in sorted(without_leftovers(folder.rglob("*.py"), folder))
    )
    return tuple(".".join((package, *(parts[:-1] if parts[-1] == "__init__" else parts))) for parts in inside)


def hash_modules(modules: Iterable[Module]) -> str:
    """Start of the SHA-256 of modules' names and bytes."""
    digest = hashlib.sha256()
    for module in sorted(modules, key=lambda module: (module.name, str(module.path))):
        digest.update(f"{module.name}\0{_read(module.path, *_stamp(module.path))[0]}\n".encode())
    return digest.hexdigest()[:HASH_DIGITS]


def _imported(name: str) -> Module | None:
    """An imported module; ``None`` for one without a file."""
    found = sys.modules.get(name)
    path = getattr(found, "__file__", None)
    if path is None or not Path(path).is_file():
        return None
    if not name.startswith(PREFIX):
        return Module(name, Path(path))
    package, _, within = name.partition(".")
    return Module(within, Path(path), Path(sys.modules[package].__path__[0]))


def _reached(starts: Iterable[Module], within: Callable[[Module], bool]) -> frozenset[Module]:
    """Modules, and all that they import of the ones ``within``."""
    reached: set[Module] = set()
    waiting = list(starts)
    while waiting:
        module = waiting.pop()
        if module not in reached:
            reached.add(module)
            waiting += filter(within, _imports(module))
    return frozenset(reached)


def _imports(module: Module) -> tuple[Module, ...]:
    return _imports_of(module, *_stamp(module.path))


@lru_cache(maxsize=4096)
def _imports_of(module: Module, *_stamp: int) -> tuple[Module, ...]:
    """What a module imports of its own package or folder and of the engine, and the packages that it is in."""
    return tuple(dict.fromkeys(found for name in _imported_names(module) for found in _locate(name, module)))


def _imported_names(module: Module) -> Iterator[str]:
    """Names that a module imports, some of them not of modules; those of the packages that it is in."""
    parts = module.name.split(".")
    for count in range(1, len(parts)):
        yield ".".join(parts[:count])
    package = parts if module.path.name == "__init__.py" else parts[:-1]
    for level, name, members in _read(module.path, *_stamp(module.path))[1]:
        base = [*package[: len(package) - level + 1], *([name] if name else [])] if level else [name]
        whole = ".".join(base)
        yield whole
        for member in members:
            yield f"{whole}.{member}" if whole else member


def _locate(name: str, importer: Module) -> list[Module]:
    """The modules of a dotted name, those of its packages too, where they are of the importer's home or the engine."""
    parts = name.split(".")
    if importer.folder is not None and lies_beside(importer.folder, parts[0]):
        return [
            Module(".".join(parts[:count]), path, importer.folder)
            for count in range(1, len(parts) + 1)
            if (path := _file(importer.folder, parts[:count])) is not None
        ]
    if parts[0] not in (ENGINE, importer.name.split(".")[0]):
        return []
    found = []
    for count in range(1, len(parts) + 1):
        path = _installed(parts[:count])
        if path is not None:
            found.append(Module(".".join(parts[:count]), path))
    return found


def _installed(parts: list[str]) -> Path | None:
    """The file of a module below a package that is imported."""
    for count in range(len(parts) - (len(parts) > 1), 0, -1):
        package = sys.modules.get(".".join(parts[:count]))
        if package is not None:
            for folder in getattr(package, "__path__", []):
                path = _file(Path(folder), parts[count:])
                if path is not None:
                    return path
            return None
    return None


def _file(folder: Path, parts: list[str]) -> Path | None:
    place = folder.joinpath(*parts)
    for path in (place / "__init__.py", *([place.with_name(f"{place.name}.py")] if parts else [])):
        if path.is_file():
            return path
    return None


def _stamp(path: Path) -> tuple[int, int]:
    """What changes with a file's text."""
    found = path.stat()
    return found.st_mtime_ns, found.st_size


@lru_cache(maxsize=4096)
def _read(path: Path, *_stamp: int) -> tuple[str, tuple[tuple[int, str, tuple[str, ...]], ...]]:
    """Hash of a file, and its imports: level, name and members."""
    imports: list[tuple[int, str, tuple[str, ...]]] = []
    try:
        tree = parse_file(path)
    except (SyntaxError, ValueError):  # then it cannot be imported, either
        return sha256_file(path), ()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            imports += [(0, alias.name, ()) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            imports.append((node.level, node.module or "", tuple(alias.name for alias in node.names)))
    return sha256_file(path), tuple(dict.fromkeys(imports))
