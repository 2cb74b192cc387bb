"""Finds plug-ins of every kind (:mod:`surgbench.kinds`) by name, ours and strangers' alike.

A plug-in is a class with a ``name``: in a module of its kind's package, behind an entry point of its kind's group, or
in a file, asked for as ``FILE.py:Class``. Its options are the fields of its nested pydantic model ``Config``, where it
has one.
"""

from __future__ import annotations

import importlib
import inspect
import pkgutil
import re
from dataclasses import dataclass
from functools import cache
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from surgbench.config import parse_model
from surgbench.errors import ConfigError, NotFoundError, unknown_name
from surgbench.kinds import KINDS, NAME_PATTERN
from surgbench.plugin_files import load_file
from surgbench.sources import hash_modules, own_modules


@dataclass(frozen=True)
class Found:
    """A plug-in, or why it could not be loaded.

    Attributes:
        name: What it is asked for by.
        source: Module, entry point or file it comes from.
        cls: The class; ``None`` where loading failed.
        problem: One line that says why, else ``None``.
        module: The module that was looked into for it; the class may be from another one.
    """

    name: str
    source: str
    cls: type | None
    problem: str | None = None
    module: str = ""

    @property
    def task(self) -> str:
        """What it works on: what its class says, else the default task."""
        return str(getattr(self.cls, "task", None) or default_task_name())

    @property
    def hash(self) -> str:
        """Hash of all of its own modules (:func:`surgbench.sources.own_modules`): another text is another plug-in."""
        own = own_modules(self.modules)
        return hash_modules(own) if own else "unknown"

    @property
    def modules(self) -> tuple[str, ...]:
        """Names of the modules that it was found in, and that its class is from."""
        return tuple(dict.fromkeys(filter(None, (self.module, getattr(self.cls, "__module__", "")))))

    @property
    def unavailable(self) -> str | None:
        """One line on why it cannot run on this machine; ``None`` where it can, as far as it says."""
        ask = getattr(self.cls, "unavailable", None)
        if ask is None:
            return None
        try:
            reason = ask()
        except Exception as error:  # then it cannot tell, and cannot be trusted to run
            reason = f"unavailable() raised {type(error).__name__}: {error}"
        return None if reason is None else " ".join(str(reason).split())


def _plugin_classes(module: Any, kind: str) -> list[type]:
    """Classes of the module itself that have a name and the kind's methods."""
    methods = KINDS[kind].methods()
    return [
        cls
        for _, cls in inspect.getmembers(module, inspect.isclass)
        if cls.__module__ == module.__name__
        and isinstance(vars(cls).get("name"), str)
        and all(callable(getattr(cls, method, None)) for method in methods)
    ]


@cache
def discover(kind: str) -> dict[str, Found]:
    """All plug-ins of a kind by name. One that fails to import is listed with its problem, and harms no other.

    So are two of one name.
    """
    found: list[Found] = []
    place = KINDS[kind]
    package = importlib.import_module(place.package)
    for info in pkgutil.iter_modules(package.__path__):
        if info.ispkg != bool(place.inside):
            continue
        source = ".".join(filter(None, (place.package, info.name, place.inside)))
        try:
            module = importlib.import_module(source)
            found += [
                Found(str(vars(cls)["name"]), source, _checked(cls, kind, source), module=source)
                for cls in _plugin_classes(module, kind)
            ]
        except Exception as error:  # a broken plug-in is listed as such, whatever breaks it
            found.append(Found(info.name, source, None, f"{type(error).__name__}: {error}"))
    for point in entry_points(group=place.group):
        try:
            cls: Any = _checked(point.load(), kind, point.value)
            if kind == "task" and cls.name != point.name:  # datasets name their task
                raise ConfigError(f"the entry point is called '{point.name}', its class '{cls.name}'")
            found.append(Found(point.name, point.value, cls, module=point.module))
        except Exception as error:
            found.append(Found(point.name, point.value, None, f"{type(error).__name__}: {error}"))
    by_name: dict[str, Found] = {}
    for one in found:
        if one.name in by_name:  # neither is meant, and the others are as good as before
            problem = f"two {kind}s are named '{one.name}': {by_name[one.name].source} and {one.source}"
            one = Found(one.name, one.source, None, problem)
        by_name[one.name] = one
    return by_name


def default_task_name() -> str:
    """The task of what names none."""
    names = [name for name, found in discover("task").items() if getattr(found.cls, "default", False)]
    if len(names) != 1:
        raise ConfigError(f"one task has to be the default one, not {len(names)} ({', '.join(names) or 'none'})")
    return names[0]


def _checked(cls: Any, kind: str, source: str) -> type:
    if not inspect.isclass(cls):
        raise ConfigError(f"{source}: not a class")
    name = getattr(cls, "name", None)
    if not isinstance(name, str) or not re.fullmatch(NAME_PATTERN, name):
        raise ConfigError(f"{source}: needs a 'name' of letters, digits, '.', '_' and '-', not {name!r}")
    task = getattr(cls, "task", None)
    if task is not None and kind != "task" and task not in discover("task"):
        raise ConfigError(f"{source}: {unknown_name('task', str(task), discover('task'))}")
    config = getattr(cls, "Config", None)
    if config is not None and not (inspect.isclass(config) and issubclass(config, BaseModel)):
        raise ConfigError(f"{source}: 'Config' must be a pydantic model")
    for method in KINDS[kind].methods():
        if not callable(getattr(cls, method, None)):
            raise ConfigError(f"{source}: needs a method '{method}'")
    if kind == "filter" and getattr(cls, "needs_truth", False) and not callable(getattr(cls, "give_truth", None)):
        raise ConfigError(f"{source}: needs a method 'give_truth', for it has 'needs_truth'")
    return cls


@cache
def _load_file(path: Path) -> Any:
    try:
        return load_file(path)
    except BaseException as error:  # a file that exits is no better than one that raises
        raise ConfigError(f"{path}: cannot be imported ({type(error).__name__}: {error})") from error


def find(kind: str, reference: str) -> Found:
    """The plug-in called ``reference``.

    Args:
        kind: What it should be.
        reference: A registered name, or ``path/to/file.py:Class``.

    Raises:
        NotFoundError: No such name, file or class; the message offers the nearest.
        ConfigError: The plug-in cannot be loaded, or lacks a method.
    """
    path_text, colon, class_name = reference.rpartition(":")
    if colon and path_text.endswith(".py"):
        path = Path(path_text).resolve()
        if not path.is_file():
            raise NotFoundError(f"{path_text}: no such file (asked for as --{kind} {reference})")
        module = _load_file(path)
        if not hasattr(module, class_name):
            names = [cls.__name__ for cls in _plugin_classes(module, kind)]
            raise NotFoundError(f"{path_text}: {unknown_name('class', class_name, names)}")
        cls = _checked(getattr(module, class_name), kind, reference)
        name = str(getattr(cls, "name", class_name))
        return Found(name, f"{path.name}:{class_name}", cls, module=module.__name__)
    if reference.endswith(".py"):
        raise NotFoundError(f"{reference}: say which class, as {reference}:ClassName")
    available = discover(kind)
    if reference not in available:
        raise NotFoundError(unknown_name(kind.replace("_", " "), reference, available) + "; or FILE.py:Class")
    found = available[reference]
    if found.cls is None:
        raise ConfigError(f"{kind} '{reference}' ({found.source}) cannot be loaded: {found.problem}")
    return found


def absolute(reference: str) -> str:
    """The same reference as seen from any folder: files with their whole paths, names as they are."""
    path_text, colon, class_name = reference.rpartition(":")
    return f"{Path(path_text).resolve()}:{class_name}" if colon and path_text.endswith(".py") else reference


def configure(found: Found, options: dict[str, Any]) -> BaseModel | None:
    """Check options against the plug-in's ``Config`` and fill in defaults.

    Returns:
        The effective configuration, or ``None`` where the plug-in takes no options.

    Raises:
        ConfigError: An unknown option or a value of the wrong type, in one line.
    """
    model = getattr(found.cls, "Config", None)
    if model is None:
        if options:
            raise ConfigError(f"'{found.name}' takes no options (got '{next(iter(options))}')")
        return None
    config: BaseModel = parse_model(model, options, f"options of '{found.name}'")
    return config


def describe(found: Found) -> list[tuple[str, Any, str]]:
    """Options of a plug-in: dotted name, default, and what it means."""
    model = getattr(found.cls, "Config", None)
    return [] if model is None else _describe(model, "")


def _describe(model: type[BaseModel], prefix: str) -> list[tuple[str, Any, str]]:
    options: list[tuple[str, Any, str]] = []
    for key, info in model.model_fields.items():
        value = "(required)" if info.is_required() else info.get_default(call_default_factory=True)
        if isinstance(value, BaseModel):
            options += _describe(type(value), f"{prefix}{key}.")
        else:
            options.append((f"{prefix}{key}", value, info.description or ""))
    return options


def create(found: Found, options: dict[str, Any]) -> Any:
    """An instance with its options.

    Raises:
        ConfigError: As :func:`configure`.
    """
    config = configure(found, options)
    assert found.cls is not None
    return found.cls() if config is None else found.cls(config)
