"""``surgbench track``: from masks to poses in one go, for who wants poses and no benchmark."""

from __future__ import annotations

import shutil
import sys
import tempfile
from pathlib import Path
from typing import Annotated, Any

import typer

from surgbench.cli.completion import plugins

IMPORTER = "masks"  # whose options are those of this command, too
OF_VIDEO = "video"  # what reads a recording whose masks are to be made
# What every tracking has for itself.
NOT_ASKED = ("name", "single_images")


def track(
    options: dict[str, Any],
    source: Annotated[
        Path,
        typer.Argument(
            metavar="VIDEO|MASKS",
            help="A video of masks, a folder of masks, or one that holds masks/ and what it may; with --masks a video "
            "of a camera.",
        ),
    ],
    out: Annotated[Path, typer.Option(metavar="FILE.csv", help="The poses; replaced if it is there.")],
    tracker: Annotated[
        str, typer.Option(metavar="NAME|FILE.py:Class", help="The tracker.", autocompletion=plugins("tracker"))
    ] = "hybrid",
    masks: Annotated[
        str | None, typer.Option(metavar="NAME|FILE.py:Class", help="A mask source: makes the masks of a video.")
    ] = None,
    prompts: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Points on the instruments in the first picture, for --masks.")
    ] = None,
    joints: Annotated[bool, typer.Option("--joints", help="With the readings in the folder's joints.csv.")] = False,
    set_: Annotated[
        list[str] | None, typer.Option("--set", metavar="NAME.option=value", help="An option; may be repeated.")
    ] = None,
    video: Annotated[
        bool, typer.Option("--video/--no-video", help="Draw the estimates over the masks, as FILE.mp4.")
    ] = True,
) -> None:
    """Track the instrument in a recording's masks and write its poses, with a video beside them.

    Example: surgbench track recordings/suturing --camera camera.json --out poses.csv

    Example: surgbench track suturing.mp4 --masks learned --camera camera.json --out poses.csv

    This is import, run and export in one go: nothing is kept but the poses and the video.
    """
    from surgbench.cli.tracking import Tracking
    from surgbench.locks import in_use, locked_beside
    from surgbench.report.encoders import codec_note

    if out.suffix.lower() != ".csv":
        from surgbench.errors import ConfigError

        raise ConfigError(f"--out {out}: must end in .csv")
    note = codec_note() if video else None
    if note is not None:
        print(note, file=sys.stderr)
    out.absolute().parent.mkdir(parents=True, exist_ok=True)
    # Beside the result, so that it is put in its place at once; not in memory, where temporary folders may lie.
    scratch = Path(tempfile.mkdtemp(prefix=f".{out.name}.", suffix=".tracking", dir=out.absolute().parent))
    try:
        work = Tracking(scratch, IMPORTER if masks is None else OF_VIDEO)
        with locked_beside(out) as ours:
            if not ours:
                raise in_use(out, "track")
            work.read(source, options)
            row = {"readings": "noisy" if joints else None, "masks": masks, "prompts": prompts}
            work.run(tracker, {key: value for key, value in row.items() if value is not None}, set_ or [])
            made = [(work.poses(), out)]
            if video:
                made.append((work.video(), out.with_suffix(".mp4")))
            for path, place in made:
                path.replace(place)
                print(place)
    finally:
        shutil.rmtree(scratch, ignore_errors=True)
