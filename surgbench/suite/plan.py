"""What is to be run: rows of settings, checked and complete, times the units of a dataset."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import cache
from typing import Any

from pydantic import create_model

from surgbench.dataset.base import Dataset
from surgbench.errors import ConfigError
from surgbench.registry import find
from surgbench.sources import engine_modules, hash_modules, package_modules
from surgbench.suite.asked import Conditions, RowRequest
from surgbench.suite.settings import Job, Settings
from surgbench.suite.slices import spread
from surgbench.task import Task, all_tasks, find_task


@cache
def any_row() -> type[RowRequest]:
    """A row of any task: what it may ask for is what one of them takes. Its task is known with its dataset."""
    own = {task.row: None for task in all_tasks() if task.row is not RowRequest}
    return create_model("AnyRow", __base__=tuple(own)) if own else RowRequest


def complete(row: RowRequest, conditions: Conditions, dataset: Dataset[Any]) -> Settings:
    """Look up everything a row names, check its options, and fill in the defaults.

    Args:
        row: Of the dataset's task, or of any (:func:`any_row`).
        conditions: What all rows of the run share.
        dataset: What it is to be run on.

    Raises:
        NotFoundError: A name that is not registered.
        ConfigError: An option that no plug-in of the row takes, a wrong value, or a device that is not there.
    """
    settings = _look_up(row, conditions, dataset)
    _check_part(row.options, _names(settings))
    return settings


def complete_all(
    rows: Sequence[RowRequest], conditions: Conditions, dataset: Dataset[Any], overrides: dict[str, dict[str, Any]]
) -> list[Settings]:
    """Complete several rows, each with those options of the command line that are for a plug-in of its own.

    Args:
        rows: As :func:`complete` takes them. An option that a row itself has must be for a plug-in of that row.
        conditions: What all rows of the run share.
        dataset: What they are to be run on.
        overrides: Plug-in name to its options, which count before the rows' own.

    Raises:
        NotFoundError: A name that is not registered.
        ConfigError: As :func:`complete`, or an override for what takes part in no row.
    """
    completed = []
    for row in rows:
        settings = _look_up(row.model_copy(update={"options": _merged(row.options, overrides)}), conditions, dataset)
        _check_part(row.options, _names(settings))
        completed.append(settings)
    _check_part(overrides, dict.fromkeys(name for settings in completed for name in _names(settings)))
    return completed


def _look_up(row: RowRequest, conditions: Conditions, dataset: Dataset[Any]) -> Settings:
    """A row's settings; options of plug-ins that take no part in it are passed over."""
    task = find_task(dataset.task)
    settings = task.complete(_own(row, task.row, dataset), conditions, dataset)
    return replace(settings, engine=_engine(task, settings))


def _names(settings: Settings) -> list[str]:
    return [one.name for one in settings.plugs]


def _check_part(options: Iterable[str], names: Iterable[str]) -> None:
    """See that every plug-in with options takes part.

    Raises:
        ConfigError: One does not.
    """
    taking_part = list(names)
    for name in options:
        if name not in taking_part:
            raise ConfigError(
                f"--set {name}.…: '{name}' takes no part in this run (taking part: {', '.join(taking_part)})"
            )


def _merged(base: dict[str, Any], over: dict[str, Any]) -> dict[str, Any]:
    merged = dict(base)
    for key, value in over.items():
        both = isinstance(value, dict) and isinstance(merged.get(key), dict)
        merged[key] = _merged(merged[key], value) if both else value
    return merged


def _engine(task: Task, settings: Settings) -> str:
    """Hash of the code besides plug-ins that makes the estimates and errors of a row."""
    plugins = [name for plug in settings.plugs for name in find(plug.kind, plug.reference).modules]
    return hash_modules(engine_modules(plugins, task.made_by or package_modules(type(task).__module__)))


def _own(row: RowRequest, model: type[RowRequest], dataset: Dataset[Any]) -> RowRequest:
    """The row as its task takes it.

    Raises:
        ConfigError: It asks for what another task takes.
    """
    for name, field in type(row).model_fields.items():
        if name not in model.model_fields and getattr(row, name) != field.default:
            owner = next((task.name for task in all_tasks() if name in task.row.model_fields), "other")
            raise ConfigError(f"'{name}' is for the {owner} task; '{dataset.name}' is of the {dataset.task} task")
    return model.model_validate(row.model_dump(include=set(model.model_fields)))


def jobs(settings: Settings, dataset: Dataset[Any]) -> list[Job]:
    """One job per unit of the row's slice and repeat, in the dataset's order.

    Raises:
        DatasetError: The dataset has nothing to run with this number of arms.
    """
    units = dataset.units(settings.conditions.arms)
    lengths = [dataset.length(unit.sequence) for unit in units]
    return [
        Job(
            settings,
            dataset.name,
            dataset.hash,
            units[place],
            min(lengths[place], settings.frames_limit or lengths[place]),
            sum(lengths),
            repeat,
        )
        for place in spread(len(units), settings.sequences)
        for repeat in range(settings.conditions.repeats)
    ]
