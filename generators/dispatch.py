"""From a preset to the plan of its dataset, by the generator that makes such presets."""

from __future__ import annotations

from pathlib import Path

from surgbench.config import locate, read_yaml
from surgbench.errors import ConfigError
from surgbench.generation import GenerationPlan, GenerationRequest
from surgbench.registry import Found, create, discover, find
from surgbench.task import default_task


def plan_preset(name_or_path: str | Path, request: GenerationRequest = GenerationRequest()) -> GenerationPlan:  # noqa: B008
    """Load a preset, put what is asked for over it, and work out what it makes.

    Args:
        name_or_path: A built-in name, or a file.
        request: What is put over it.

    Raises:
        NotFoundError: No built-in preset has this name, or no generator the one that the preset names.
        ConfigError: The file is missing or wrong, or an option has a value that will not do; one line.
    """
    path = locate("presets", "preset", name_or_path)
    content = read_yaml(path, "preset")
    named = content.get("generator")
    found = _of_task(str(content.get("task", default_task().name)), path) if named is None else find("generator", named)
    plan: GenerationPlan = create(found, {}).plan(path, request)
    return plan


def _of_task(task: str, path: Path) -> Found:
    """The one generator of a task's presets."""
    fitting = [found for found in discover("generator").values() if found.cls is not None and found.task == task]
    if len(fitting) != 1:
        names = ", ".join(found.name for found in fitting) or "none"
        raise ConfigError(f"{path}: say which 'generator' makes it; those of the {task} task: {names}")
    return fitting[0]
