"""``surgbench list``."""

from __future__ import annotations

from typing import Annotated, Literal

import typer


def list_names(
    what: Annotated[
        Literal[
            "trackers", "initialisers", "filters", "keypoints", "presets", "suites", "tables", "training", "instruments"
        ],
        typer.Argument(help="What to list."),
    ],
) -> None:
    """List what there is by name, with the options of each plug-in and their defaults.

    Example: surgbench list trackers
    """
    from surgbench.registry import Kind, describe, discover

    kinds: dict[str, Kind] = {
        "trackers": "tracker",
        "initialisers": "initialiser",
        "filters": "filter",
        "keypoints": "keypoints",
    }
    if what in kinds:
        for name, found in sorted(discover(kinds[what]).items()):
            mark = "" if found.task == "instrument" else f"[{found.task}] "
            print(f"{name:18} {mark}{found.problem or getattr(found.cls, 'summary', '')}")
            if found.unavailable is not None:
                print(f"  not available here: {found.unavailable}")
            for option, default, meaning in describe(found):
                print(f"  {name}.{option} = {default}" + (f"   {meaning}" if meaning else ""))
        return
    from surgbench.config import packaged_names

    for name in packaged_names(what):
        print(name)
