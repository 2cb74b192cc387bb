"""From a preset of whichever task to the plan of its dataset."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from surgbench.config import locate, parse_model, read_yaml
from surgbench.errors import ConfigError
from surgbench.generators.generate import Part, plan_dataset
from surgbench.generators.presets import load_preset
from surgbench.generators.resumable import Job
from surgbench.generators.wire_chaser.job import WirePlan
from surgbench.generators.wire_chaser.presets import WireChaser


def plan_preset(
    name_or_path: str | Path,
    *,
    sequences: int | None = None,
    frames: int | None = None,
    seed: int | None = None,
    corruption: str | None = None,
    part: tuple[tuple[str, ...], int] | None = None,
) -> Job:
    """Load a preset, put the given options over it, and work out what it makes.

    Args:
        name_or_path: A built-in name, or a file.
        sequences: Pairs of trajectories or trials, instead of the preset's.
        frames: Frames or samples of each, instead of the preset's.
        seed: Instead of the preset's.
        corruption: Level of the masks' corruption; of the instrument task.
        part: Ids of sequences, and how many frames of each, where no more is needed. Of the viewpoint task all trials
            up to the last of them are made, whole: they take no time.

    Raises:
        NotFoundError: No built-in preset has this name.
        ConfigError: The file is missing or wrong, or an option has a value that will not do; one line.
    """
    path = locate("presets", "preset", name_or_path)
    if read_yaml(path, "preset").get("task", "instrument") == "instrument":
        preset = load_preset(name_or_path, pairs=sequences, frames=frames, seed=seed, corruption=corruption)
        plan: Job = plan_dataset(preset, None if part is None else Part(*part))
        return plan
    if corruption is not None:
        raise ConfigError(f"--corruption: '{name_or_path}' is of the viewpoint task, which has no masks")
    if part is not None:
        sequences = 1 + max(int(name) for name in part[0])
    wire_plan: Job = WirePlan(load_wire_chaser(path, trials=sequences, samples=frames, seed=seed))
    return wire_plan


def load_wire_chaser(
    name_or_path: str | Path, *, trials: int | None = None, samples: int | None = None, seed: int | None = None
) -> WireChaser:
    """Load a preset of the viewpoint task and put the given options over it; errors as :func:`plan_preset`'s."""
    path = locate("presets", "preset", name_or_path)
    content = read_yaml(path, "preset")
    preset = parse_model(WireChaser, content, str(path))
    options = (("trials", "--sequences", trials), ("samples", "--frames", samples), ("seed", "--seed", seed))
    given: dict[str, Any] = {}
    for key, option, value in options:
        if value is None:
            continue
        given[key] = value
        # One at a time, so that the message names the option and not the file.
        try:
            parse_model(WireChaser, {**content, key: value}, option)
        except ConfigError as error:
            raise ConfigError(str(error).replace(f"'{key}': ", "", 1)) from None
    return parse_model(WireChaser, {**content, **given}, str(path)) if given else preset
