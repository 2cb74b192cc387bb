"""From a preset to the plan of its dataset, by the generator that makes such presets.

A preset says which one with ``generator``: a name, or ``FILE.py:Class`` relative to the preset file. Else it is the one
generator of its ``task``, the default task unless told.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from surgbench.config import locate, read_yaml
from surgbench.dataset.manifest import Manifest
from surgbench.errors import ConfigError, SurgbenchError
from surgbench.generation import GenerationPlan, GenerationRequest, Workers
from surgbench.registry import Found, create, default_task_name, discover, find
from surgbench.task import find_task


def plan_preset(name_or_path: str | Path, request: GenerationRequest = GenerationRequest()) -> GenerationPlan:  # noqa: B008
    """Load a preset, put what is asked for over it, and work out what it makes.

    Args:
        name_or_path: A built-in name, or a file.
        request: What is put over it.

    Raises:
        NotFoundError: No built-in preset has this name, or no generator or task the one that the preset names.
        ConfigError: The file is missing or wrong, or an option has a value that will not do; one line.
    """
    path = locate("presets", "preset", name_or_path)
    content = read_yaml(path, "preset")
    try:
        found = _generator(content, path.parent)
        generator = create(found, {})
    except SurgbenchError as error:
        raise type(error)(f"{path}: {error}") from None
    try:
        plan: GenerationPlan = generator.plan(path, request)
        if request.set and plan.marker == generator.plan(path, replace(request, set={})).marker:
            raise ConfigError(f"--set: generator '{generator.name}' takes no settings")
    except SurgbenchError:
        raise
    except Exception as error:  # a stranger's generator
        raise ConfigError(f"{path}: generator '{generator.name}' raised {type(error).__name__}: {error}") from error
    if not hasattr(plan, "write"):
        raise ConfigError(f"{path}: generator '{generator.name}' gave {type(plan).__name__}, which is no plan")
    # A dataset of a task's usual generator says no more than its preset does.
    usual = [one.source for one in discover("generator").values() if one.cls is not None and one.task == found.task]
    told: dict[str, Any] = {} if usual == [found.source] else {"generator": f"{found.source}@{found.hash}"}
    if request.set:
        told["set"] = dict(request.set)
    return ToldPlan(plan, told) if told else plan


@dataclass(frozen=True)
class ToldPlan:
    """A plan of which the configuration tells more than its generator does.

    Attributes:
        plan: The generator's.
        told: ``generator``, where a preset names it: where it is from, and the hash of its source, for another text
            makes another dataset; and what was ``set``.
    """

    plan: GenerationPlan
    told: dict[str, Any]

    @property
    def name(self) -> str:
        """The dataset's."""
        return self.plan.name

    @property
    def counts(self) -> str:
        """How much there will be."""
        return self.plan.counts

    @property
    def frames(self) -> int:
        """Frames or samples in all."""
        return self.plan.frames

    @property
    def paths(self) -> list[str]:
        """Every file but the manifest."""
        return self.plan.paths

    @property
    def disk_bytes(self) -> int:
        """Disk that the whole dataset takes."""
        return self.plan.disk_bytes

    @property
    def marker(self) -> dict[str, Any]:
        """Effective configuration, with what is told."""
        return {**self.plan.marker, **self.told}

    def write(self, out: Path, workers: Workers, progress: Callable[[float], None]) -> Manifest:
        """Write everything but the manifest."""
        manifest = self.plan.write(out, workers, progress)
        return manifest.model_copy(update={"configuration": {**manifest.configuration, **self.told}})


def _generator(preset: dict[str, Any], folder: Path) -> Found:
    """The one that a preset names, or the one of its task."""
    if "generator" not in preset:
        return _of_task(str(preset.get("task", default_task_name())))
    named = preset["generator"]
    if not isinstance(named, str):
        raise ConfigError(f"'generator': must be a name or FILE.py:Class, not {named!r}")
    return find("generator", str(folder / named) if ".py" in named else named)


def _of_task(task: str) -> Found:
    """The one generator of a task's presets."""
    find_task(task)
    every = discover("generator").values()
    fitting = [found.name for found in every if found.cls is not None and found.task == task]
    if len(fitting) == 1:
        return find("generator", fitting[0])
    # One of those may be the one that is missed.
    broken = "".join(f"; '{found.name}' cannot be loaded: {found.problem}" for found in every if found.cls is None)
    names = ", ".join(sorted(fitting)) or "none"
    raise ConfigError(f"say which 'generator' makes it; those of the {task} task: {names}{broken}")
