"""``surgbench import``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from surgbench.cli.progress import progress


def masks(
    source: Annotated[
        Path,
        typer.Argument(
            metavar="SRC", help="Folder with masks/*.png, camera.json; optional images/, joints.csv, tips.csv."
        ),
    ],
    out: Annotated[Path, typer.Option(help="The dataset's folder: new or empty.")],
    name: Annotated[str | None, typer.Option(help="The dataset's name; the source folder's unless told.")] = None,
    fps: Annotated[float, typer.Option(help="Frames per second.")] = 30.0,
    instrument: Annotated[str, typer.Option(help="Instrument: a name, or an instrument file.")] = "large_needle_driver",
    arm: Annotated[Literal["left", "right"], typer.Option(help="Which arm the masks show.")] = "left",
    single_images: Annotated[
        bool, typer.Option("--single-images", help="The masks are unrelated: each becomes a sequence of one frame.")
    ] = False,
) -> None:
    """Turn a recording's masks into a dataset without ground truth.

    Example: surgbench import masks recordings/suturing --out data/suturing --fps 25
    """
    from surgbench.dataset.import_masks import import_masks, read_recording

    total = len(read_recording(source, single_images=single_images).numbers)
    with progress("frames", total) as advance:
        import_masks(
            source,
            out,
            name=name,
            fps=fps,
            instrument=instrument,
            arm=arm,
            single_images=single_images,
            progress=advance,
        )
    print(out)
