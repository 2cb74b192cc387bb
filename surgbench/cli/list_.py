"""``surgbench list``."""

from __future__ import annotations

from typing import Annotated

import typer

from surgbench.kinds import KINDS

FILES = ("presets", "suites", "tables", "training", "instruments", "arms", "camera_arms")


def list_names(
    what: Annotated[str, typer.Argument(metavar=f"{'|'.join([*(k.plural for k in KINDS.values()), *FILES])}")],
) -> None:
    """List what there is by name, with the options of each plug-in and their defaults.

    Example: surgbench list trackers
    """
    from surgbench.config import packaged_names
    from surgbench.errors import NotFoundError, unknown_name
    from surgbench.registry import default_task_name, describe, discover

    kind = next((kind.name for kind in KINDS.values() if kind.plural == what), None)
    if kind is None:
        if what not in FILES:
            raise NotFoundError(unknown_name("list", what, [*(kind.plural for kind in KINDS.values()), *FILES]))
        for name in packaged_names(what):
            print(name if what != "instruments" else f"{name:28} {_instrument_line(name)}")
        return
    for name, found in sorted(discover(kind).items()):
        mark = f"[{found.task}] " if kind != "task" and found.task != default_task_name() else ""
        print(f"{name:18} {mark}{found.problem or getattr(found.cls, 'summary', '')}")
        if found.unavailable is not None:
            print(f"  not available here: {found.unavailable}")
        for option, default, meaning in describe(found):
            print(f"  {name}.{option} = {default}" + (f"   {meaning}" if meaning else ""))


def _instrument_line(name: str) -> str:
    from surgbench.instrument import load_instrument
    from surgbench.instrument.measures import summary

    return summary(load_instrument(name))
