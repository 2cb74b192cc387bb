"""YAML files as typed models, with errors of one line that name the file, the key and what would be right."""

from __future__ import annotations

import difflib
import json
import re
from importlib import resources
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, TypeVar, Union, get_args, get_origin

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from surgbench.errors import ConfigError, NotFoundError, unknown_name
from surgbench.files import MOST_YAML_BYTES, read_whole
from surgbench.kinds import NAME_PATTERN
from surgbench.syntax import parse_yaml

Model = TypeVar("Model", bound=BaseModel)

# Types of values that files and options hold.
Finite = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
# Between frames, seconds: from a microsecond to a day.
Step = Annotated[float, Field(ge=1e-6, le=86_400, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Count = Annotated[int, Field(ge=1)]
# Of datasets, sequences, views and arms: they become names of files.
LONGEST_NAME = 100
# So many of anything that is asked for: none are needed, and more would only fill the memory before they are missed.
MOST_REPEATS, MOST_ROWS = 10_000, 10_000
Name = Annotated[str, Field(pattern=f"^{NAME_PATTERN}$", max_length=LONGEST_NAME)]


def one_line(text: str) -> str:
    r"""A text by a stranger as a terminal may show it: one line, without characters that it would take for orders.

    Example:
        >>> from surgbench.config import one_line
        >>> one_line("fine\x1b[2J\nfits: all")
        'fine [2J fits: all'
    """
    return "".join(letter if letter.isprintable() else " " for letter in text)


class Section(BaseModel):
    """Base of what files and options say: unknown keys are errors, values never change."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class _UniqueKeyLoader(yaml.SafeLoader):
    """Refuses a key that is given twice, of which YAML would silently take the last."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        keys = [self.construct_object(key, deep=True) for key, _ in node.value]
        for key in keys:
            if keys.count(key) > 1:
                raise yaml.constructor.ConstructorError(None, None, f"key '{key}' is given twice", node.start_mark)
        mapping: dict[Any, Any] = super().construct_mapping(node, deep)
        return mapping


# As in YAML 1.2: PyYAML, which follows 1.1, takes 1e-4 for a text.
_UniqueKeyLoader.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(r"[-+]?[0-9]+(\.[0-9]*)?[eE][-+]?[0-9]+$"), list("-+0123456789")
)

SUFFIXES = (".yaml", ".yml")


def packaged_names(folder: str) -> list[str]:
    """Names of the YAML files that come with the package in ``configs/<folder>/``, sorted."""
    entries = resources.files(f"surgbench.configs.{folder}").iterdir()
    return sorted(entry.name.removesuffix(".yaml") for entry in entries if entry.name.endswith(".yaml"))


def is_file(name_or_path: str | Path) -> bool:
    """Whether a reference means a user's own file: any ``Path``, or a string with a slash or ending in ``.yaml``."""
    return isinstance(name_or_path, Path) or "/" in name_or_path or name_or_path.lower().endswith(SUFFIXES)


def locate(folder: str, what: str, name_or_path: str | Path) -> Path:
    """The file behind a packaged name, or a user's own file.

    Args:
        folder: Below ``configs/``.
        what: What it is, for the message, for example ``"preset"``.
        name_or_path: A name of :func:`packaged_names`, or a file: any ``Path``, or a string with a slash or
            ending in ``.yaml`` or ``.yml``.

    Raises:
        NotFoundError: No packaged file has this name; the message offers the nearest.
    """
    if is_file(name_or_path):
        return Path(name_or_path)
    name, names = str(name_or_path), packaged_names(folder)
    if name not in names:
        raise NotFoundError(unknown_name(what, name, names) + "; or a FILE.yaml")
    return Path(str(resources.files(f"surgbench.configs.{folder}") / f"{name}.yaml"))


def read_yaml(path: Path, what: str) -> dict[str, Any]:
    """Read a YAML file that holds a mapping.

    Args:
        path: The file.
        what: What it is, for the message, for example ``"preset"``.

    Raises:
        ConfigError: It is missing, not YAML, or not a mapping; one line.
    """
    try:
        content = parse_value(read_whole(path, MOST_YAML_BYTES).decode())
    except OSError as error:
        raise ConfigError(f"{path}: {what} file cannot be read ({error.strerror})") from None
    except ValueError as error:
        raise ConfigError(f"{path}: not valid YAML ({' '.join(str(error).split())})") from None
    if not isinstance(content, dict):
        raise ConfigError(f"{path}: a {what} file must be a mapping of keys")
    return content


def parse_value(text: str) -> Any:
    """A value as it would stand in a YAML file.

    Raises:
        ValueError: It is none.
    """
    return parse_yaml(text, _UniqueKeyLoader)


def parse_model(model: type[Model], content: Any, source: str) -> Model:
    """Build a model from what a file or option says.

    Args:
        model: A pydantic model with ``extra="forbid"``.
        content: The parsed YAML.
        source: File or option, for the message.

    Raises:
        ConfigError: A key is unknown (the nearest valid one is named), missing, or has a wrong value; one line.
    """
    try:
        # As JSON, where strictness still takes a list for a tuple and a whole number for a float, but no
        # "2" and no true for a number.
        return model.model_validate_json(json.dumps(content, default=str), strict=True)
    except ValidationError as error:
        raise ConfigError(f"{source}: {explain(model, error)}") from None


def explain(model: type[BaseModel], error: ValidationError) -> str:
    """The first problem of a validation error, in one line with the key and what would be right."""
    problems = error.errors()
    # A misspelt key is also a missing one; the misspelling says more.
    first = next((problem for problem in problems if problem["type"] == "extra_forbidden"), problems[0])
    place = first["loc"]
    key = ".".join(str(part) for part in place)
    if first["type"] == "extra_forbidden":
        valid = sorted(_keys_at(model, place[:-1]))
        close = difflib.get_close_matches(str(place[-1]), valid, n=1, cutoff=0.5)
        hint = f"; did you mean '{close[0]}'?" if close else ""
        return f"unknown key '{key}'{hint}" + (f" (valid: {', '.join(valid)})" if valid else "")
    if first["type"] == "missing":
        return f"key '{key}' is missing"
    message = first["msg"].removeprefix("Value error, ")
    value = first["input"]
    own_words = first["type"] == "value_error"
    shown = f", not {value!r}" if isinstance(value, str | int | float | bool | None) and not own_words else ""
    return f"'{key}': {message[:1].lower()}{message[1:]}{shown}" if key else message


def _keys_at(model: type[BaseModel], place: tuple[int | str, ...]) -> set[str]:
    """Keys of the model found by following ``place`` from ``model``; empty where that leads to no model."""
    here: set[type[BaseModel]] = {model}
    for part in place:
        following: set[type[BaseModel]] = set()
        for candidate in here:
            field = candidate.model_fields.get(str(part))
            if field is not None:
                following |= _models_in(field.annotation)
        # Positions in lists lead nowhere new, names of union members to that member.
        tagged = {
            one for one in here if str(part) in get_args(getattr(one.model_fields.get("kind"), "annotation", None))
        }
        here = following or tagged or here
    return {name for candidate in here for name in candidate.model_fields}


def _kinds(model: type[BaseModel]) -> tuple[Any, ...]:
    """What the ``kind`` of a member of a union may be."""
    kind = model.model_fields.get("kind")
    return () if kind is None else get_args(kind.annotation)


def _models_in(annotation: Any) -> set[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return {annotation}
    if get_origin(annotation) in (Union, UnionType, tuple, list, dict) or get_args(annotation):
        return {model for part in get_args(annotation) for model in _models_in(part)}
    return set()
