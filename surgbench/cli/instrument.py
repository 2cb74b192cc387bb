"""``surgbench instrument``: look at an instrument file."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from surgbench.cli.completion import files

# The command's name is this file's: it isn't the task of that name, which nothing here may know.
INSTRUMENT = __name__.rpartition(".")[2]
instrument_app = typer.Typer(no_args_is_help=True, rich_markup_mode=None)

Reference = Annotated[
    str, typer.Argument(metavar="NAME|FILE", help="Of the catalogue, or a file.", autocompletion=files("instruments"))
]


@instrument_app.callback()
def _instrument() -> None:
    """See what an instrument file describes, and what is wrong with it.

    Example: surgbench instrument show large_needle_driver --out driver.png
    """


@instrument_app.command("show")
def show(
    reference: Reference,
    out: Annotated[Path, typer.Option(metavar="FILE.png", help="The picture.")],
) -> None:
    """Draw an instrument to scale: four views, and each joint swept over its limits.

    Example: surgbench instrument show prograsp_forceps --out prograsp.png
    """
    import cv2

    from surgbench.cli.written import write_text
    from surgbench.errors import ConfigError
    from surgbench.instrument import load_instrument
    from surgbench.instrument.drawing import draw_instrument

    if out.suffix.lower() != ".png":
        raise ConfigError(f"--out {out}: expected a file FILE.png")
    picture = draw_instrument(load_instrument(reference))
    write_text(cv2.imencode(".png", picture[..., ::-1])[1].tobytes(), out, "instrument show")
    print(out)


@instrument_app.command("check")
def check(reference: Reference) -> None:
    """Say what is wrong with an instrument file, and what it is as a person with a ruler would measure it.

    Exit code 2 if anything is wrong: bodies that are not closed or of another scale, tips off the body, limits in
    degrees, a symmetry that its silhouettes have not.

    Example: surgbench instrument check mine/instrument.yaml
    """
    from surgbench.errors import SurgbenchError
    from surgbench.instrument.inspection import inspect

    found = inspect(reference)
    for what, measures in found.facts:
        print(f"{what:14} {measures}")
    for remark in found.remarks:
        print(f"note: {remark}")
    for problem in found.wrong:
        print(f"wrong: {problem}")
    if found.wrong:
        count = len(found.wrong)
        raise SurgbenchError(f"{reference}: {count} thing{'s are' if count > 1 else ' is'} wrong with it (see above)")
    print("nothing is wrong with it")
