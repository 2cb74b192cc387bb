"""``surgbench import``: a command for every importer, its options those of the importer."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperGroup

from surgbench.cli.progress import progress

if TYPE_CHECKING:
    from surgbench.registry import Found


class _Importers(TyperGroup):
    """Importers are looked for when one is asked for: they load what they read with."""

    def list_commands(self, ctx: Any) -> list[str]:
        """Their names."""
        from surgbench.registry import discover

        return sorted(name for name, found in discover("importer").items() if found.cls is not None)

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """One of them, if it is there."""
        from surgbench.registry import discover

        if cmd_name not in self.list_commands(ctx):
            return None
        app = typer.Typer(rich_markup_mode=None, add_completion=False)
        app.command(cmd_name)(_command(discover("importer")[cmd_name]))
        return typer.main.get_command(app)


import_app = typer.Typer(cls=_Importers, no_args_is_help=True, rich_markup_mode=None)


@import_app.callback()
def _import() -> None:
    """Turn recordings into datasets.

    Example: surgbench import masks recordings/suturing --out data/suturing
    """


def import_recordings(found: Found, options: dict[str, Any], source: Path | tuple[Path, ...], out: Path) -> None:
    """Make a dataset of recordings, and say what was made of them.

    Args:
        found: The importer.
        options: Its own.
        source: The recordings; several for an importer that says that it takes ``several``.
        out: The dataset's folder: new or empty.

    Raises:
        SurgbenchError: Something in them is missing or wrong, or nothing can be written there; one line.
    """
    from surgbench.dataset.open import open_dataset
    from surgbench.dataset.storage import check_new
    from surgbench.locks import sole_writer
    from surgbench.registry import create

    importer = create(found, options)
    with sole_writer(out, "import"):
        check_new(out)
        with progress("frames", importer.frames(source)) as advance:
            lines = importer.run(source, out, advance)
    for line in lines or ():
        print(line, file=sys.stderr)
    open_dataset(out)  # before it is called one


def _command(found: Found) -> Any:
    from surgbench.cli.options import field_options, with_options

    def command(
        options: dict[str, Any],
        source: Annotated[Path, typer.Argument(metavar="SRC", help="The recording.")],
        out: Annotated[Path, typer.Option(help="The dataset's folder: new or empty.")],
    ) -> None:
        import_recordings(found, options, source, out)
        print(out)

    def commands(
        options: dict[str, Any],
        source: Annotated[list[Path], typer.Argument(metavar="SRC...", help="The recordings, each a part of its own.")],
        out: Annotated[Path, typer.Option(help="The dataset's folder: new or empty.")],
    ) -> None:
        import_recordings(found, options, tuple(source), out)
        print(out)

    model = getattr(found.cls, "Config", None)
    example = f"Example: surgbench import {found.name} recordings/suturing --out data/suturing"
    further = (f"Example: {one}" for one in getattr(found.cls, "examples", ()))
    doc = "\n\n".join((f"Make a dataset of a recording: {getattr(found.cls, 'summary', '')}.", example, *further))
    taken = commands if getattr(found.cls, "several", False) else command
    return with_options(taken, field_options({} if model is None else {model: ""}), "options", doc)
