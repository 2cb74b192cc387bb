"""Suites: rows from a file, from the command line, or from a file changed by the command line."""

from __future__ import annotations

import math
from copy import deepcopy
from functools import cache
from itertools import product
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, create_model

from surgbench.config import MOST_ROWS, locate, parse_model, parse_value, read_yaml
from surgbench.dataset.manifest import dataset_name
from surgbench.errors import ConfigError
from surgbench.registry import find
from surgbench.suite.asked import Conditions, RowRequest
from surgbench.suite.plan import any_row

# Key of a row in a suite file: options, each with the values that it takes one after the other.
GRID = "grid"


class Suite(Conditions):
    """A suite file: rows, what they share, and the datasets that they are run on unless the command line says others.

    Attributes:
        rows: What is run.
        datasets: Folders; in a file, relative to it.
    """

    datasets: tuple[Path, ...] = ()
    rows: Annotated[tuple[RowRequest, ...], Field(min_length=1)]


@cache
def _suite() -> type[Suite]:
    """A suite whose rows may be of any task."""
    row: Any = any_row()
    rows: Any = (Annotated[tuple[row, ...], Field(min_length=1)], ...)
    return create_model("Suite", __base__=Suite, rows=rows)


def load_suite(reference: str) -> Suite:
    """A suite by name (``surgbench list suites``) or from a YAML file.

    Raises:
        NotFoundError: No such suite.
        ConfigError: An unknown key or a wrong value; one line.
    """
    path = locate("suites", "suite", reference)
    content = read_yaml(path, "suite")
    rows = content.get("rows")
    if isinstance(rows, list):
        content["rows"] = [one for row in rows for one in _spread(row, str(path))]
    suite = parse_model(_suite(), content, str(path))
    return suite.model_copy(update={"datasets": tuple(path.parent / place for place in suite.datasets)})


def _spread(row: Any, source: str) -> list[Any]:
    """A row of a suite file as many times as its ``grid`` has combinations of values, each named by them.

    Raises:
        ConfigError: The grid does not map options to lists of values; one line.
    """
    if not isinstance(row, dict) or GRID not in row or not isinstance(row.get("options") or {}, dict):
        return [row]  # the suite's model says what is wrong with it
    grid, rest = row[GRID], {key: value for key, value in row.items() if key != GRID}
    if not isinstance(grid, dict) or not grid or not all(isinstance(one, list) and one for one in grid.values()):
        raise ConfigError(f"{source}: 'grid' maps options to lists of values, as {{cmaes.population: [50, 70, 100]}}")
    tracker = find("tracker", str(row.get("tracker", ""))).name
    count = math.prod(map(len, grid.values()))
    if count > MOST_ROWS:
        raise ConfigError(f"{source}: 'grid' has {count} combinations of values, more than {MOST_ROWS} rows")
    rows = []
    for values in product(*grid.values()):
        options, name = deepcopy(rest.get("options") or {}), str(rest.get("row_id") or tracker)
        for key, value in zip(grid, values, strict=True):
            plug, *path = str(key).split(".") if "." in str(key) else (tracker, str(key))
            _put(options, [plug, *path], value, f"{source}: 'grid': {key}")
            name += f"-{path[-1]}-{value}"
        rows.append({**rest, "options": options, "row_id": dataset_name(name)})
    return rows


def from_command_line(
    base: Suite | None, trackers: list[str], row: dict[str, Any], conditions: dict[str, Any]
) -> Suite:
    """Rows for the trackers of the command line, or a suite's rows with what the command line overrides.

    Args:
        base: The suite asked for, if any.
        trackers: References of ``--tracker``.
        row: Settings for every row; ``None`` where the command line says nothing.
        conditions: Seed and the like; ``None`` where the command line says nothing.

    Raises:
        ConfigError: Both or neither of suite and trackers.
    """
    if (base is None) == (not trackers):
        raise ConfigError("say what to run: --tracker NAME (see: surgbench list trackers), or --suite NAME, not both")
    given = {key: value for key, value in row.items() if value is not None}
    kept: dict[str, Any] = {}
    if base is None:
        rows = [{"tracker": tracker, **given} for tracker in trackers]
    else:
        rows = [{**one.model_dump(mode="json"), **given} for one in base.rows]
        kept = base.model_dump(mode="json", exclude={"rows", "datasets"})
    changed = {key: value for key, value in conditions.items() if value is not None}
    return parse_model(_suite(), {"rows": rows, **kept, **changed}, "command line")


def parse_sets(sets: list[str]) -> dict[str, dict[str, Any]]:
    """``["cmaes.loss.keypoints=0"]`` to ``{"cmaes": {"loss": {"keypoints": 0}}}``; values are YAML.

    Raises:
        ConfigError: A text that is not ``NAME.option=value``.
    """
    options: dict[str, dict[str, Any]] = {}
    for text in sets:
        key, equals, value = text.partition("=")
        name, *path = key.strip().split(".")
        if not equals or not path or not all([name, *path]):
            raise ConfigError(f"--set {text}: must be NAME.option=value, for example cmaes.iterations=5")
        try:
            parsed = parse_value(value)
        except ValueError:
            raise ConfigError(f"--set {text}: '{value}' is not a value") from None
        _put(options, [name, *path], parsed, f"--set {text}")
    return options


def _put(options: dict[str, Any], path: list[str], value: Any, source: str) -> None:
    """Set a value within dictionaries within dictionaries.

    Raises:
        ConfigError: One of them is a value; ``source`` says who asks.
    """
    here = options
    for part in path[:-1]:
        here = here.setdefault(part, {})
        if not isinstance(here, dict):
            raise ConfigError(f"{source}: '{part}' is set to a value already")
    here[path[-1]] = value
