"""The generator of the viewpoint task's datasets."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

from surgbench.config import locate, parse_model, read_yaml
from surgbench.contract import Plugin
from surgbench.errors import ConfigError, unknown_name
from surgbench.generation import GenerationPlan, GenerationRequest, with_settings
from surgbench.generators.wire_chaser.job import WirePlan
from surgbench.generators.wire_chaser.presets import WireChaser


class WireChasers(Plugin):
    """A ring that a hand leads along a wire, in the workspace of a camera arm."""

    name: ClassVar[str] = "wire-chaser"
    summary: ClassVar[str] = "a ring led along a wire, in the workspace of a camera arm"
    task: ClassVar[str] = "viewpoint"

    def plan(self, preset: Path, request: GenerationRequest) -> GenerationPlan:
        """What a preset makes. The trials of a part are made whole.

        Raises:
            ConfigError: The file is wrong, an option has a value that will not do, or the part names a trial that the
                preset has not; one line.
        """
        if request.corruption is not None:
            raise ConfigError(f"--corruption: '{preset}' is of the viewpoint task, which has no masks")
        loaded = load_wire_chaser(
            preset, trials=request.sequences, samples=request.frames, seed=request.seed, settings=request.set
        )
        if request.part is not None:
            ids = list(WirePlan(loaded).samples)
            for wanted in request.part[0]:
                if wanted not in ids:
                    raise ConfigError(unknown_name("trial", wanted, ids))
        plan: GenerationPlan = WirePlan(loaded, () if request.part is None else request.part[0])
        return plan


def load_wire_chaser(
    name_or_path: str | Path,
    *,
    trials: int | None = None,
    samples: int | None = None,
    seed: int | None = None,
    settings: Mapping[str, Any] | None = None,
) -> WireChaser:
    """Load a preset of the viewpoint task and put the given options over it; errors as :meth:`WireChasers.plan`'s."""
    path = locate("presets", "preset", name_or_path)
    content = {key: value for key, value in read_yaml(path, "preset").items() if key != "generator"}
    preset = parse_model(WireChaser, content, str(path))
    if settings:
        content = with_settings(preset.model_dump(mode="json"), settings)
        preset = parse_model(WireChaser, content, "--set")
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
