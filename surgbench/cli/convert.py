"""``surgbench convert``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

convert_app = typer.Typer(no_args_is_help=True, rich_markup_mode=None)


@convert_app.callback()
def _convert() -> None:
    """Bring checkpoints of others into the layout that plug-ins read.

    Example: surgbench convert sam2 sam2.1_hiera_tiny.pt --config tiny --out models/sam2.1-tiny
    """


@convert_app.command("sam2")
def sam2(
    checkpoint: Annotated[Path, typer.Argument(metavar="CHECKPOINT.pt", help="Of SAM 2, 2.1 or Surgical SAM 2.")],
    config: Annotated[
        Literal["tiny", "small", "base-plus", "large"], typer.Option(help="The size of its image encoder.")
    ],
    out: Annotated[Path, typer.Option(help="A new or empty folder.")],
    image_size: Annotated[
        int, typer.Option(min=64, help="Side of the square that pictures are resized to; Surgical SAM 2: 512.")
    ] = 1024,
) -> None:
    """Convert a checkpoint of SAM 2's own repository, or of Surgical SAM 2, for the mask source `sam2`.

    Example: surgbench convert sam2 sam2.1_hiera_tiny.pt --config tiny --out models/sam2.1-tiny

    Use the result with --masks sam2 --set sam2.model=models/sam2.1-tiny. The file is read as tensors alone: nothing
    that is pickled in it runs.
    """
    from surgbench.errors import SurgbenchError
    from surgbench.files import PARTIAL_SUFFIX
    from surgbench.locks import sole_writer
    from surgbench.trackers.masks.sam2_video.checkpoint import CONFIG, WEIGHTS
    from surgbench.trackers.masks.sam2_video.original import convert, read_original, video_config, write_checkpoint

    with sole_writer(out, "convert"):
        names = sorted(path.name for path in out.iterdir() if not path.name.endswith(PARTIAL_SUFFIX))
        # Weights alone are of a conversion that was interrupted.
        strangers = names if CONFIG in names else [name for name in names if name != WEIGHTS]
        if strangers:
            raise SurgbenchError(f"{out}: holds something else ('{strangers[0]}'); --out needs a new or empty folder")
        tensors = read_original(checkpoint)
        described = video_config(config, image_size, tensors)
        write_checkpoint(out, convert(tensors, described, str(checkpoint)), described)
    print(out)
