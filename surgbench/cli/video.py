"""``surgbench video``: records to videos and pictures."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer


def video(
    directories: Annotated[list[Path], typer.Argument(metavar="DIR...", help="Folders of records.")],
    dataset: Annotated[
        Path | None, typer.Option(metavar="PATH", help="Where the dataset is, if it moved since the run.")
    ] = None,
    unit: Annotated[list[str] | None, typer.Option(metavar="ID", help="Draw only this unit; may be repeated.")] = None,
    row: Annotated[
        list[str] | None, typer.Option(metavar="ROW_ID", help="Draw only this row; may be repeated.")
    ] = None,
    frames: Annotated[int, typer.Option(min=1, max=50, help="Columns of the contact sheet.")] = 5,
    samples: Annotated[
        bool,
        typer.Option(
            "--samples",
            help="Also draw the best candidates of each iteration as skeletons; of camera runs, the sheet's moments.",
        ),
    ] = False,
    overlay: Annotated[
        bool, typer.Option("--overlay", help="All trackers in one panel of the video, not side by side.")
    ] = False,
    side_by_side: Annotated[
        bool,
        typer.Option("--side-by-side", help="What was observed comes first; masks are laid over, tips are dots."),
    ] = False,
    out: Annotated[Path | None, typer.Option(metavar="DIR", help="Default: folder 'video' in the first DIR.")] = None,
    fps: Annotated[
        float | None, typer.Option(min=0.1, max=240.0, help="Default: so many that the film is as fast as it was.")
    ] = None,
    every: Annotated[
        int | None,
        typer.Option(
            min=1, max=1000, metavar="N", help="Draw every N-th frame. Default: each; of camera runs 12 a second."
        ),
    ] = None,
) -> None:
    """Draw what trackers did over what they saw: an MP4 and a contact sheet per unit.

    The reference mask's contour is green; each tracker's has a colour of its own. Videos are H.264 where the extra
    ``video`` is installed. ``--side-by-side`` lays half transparent masks over the pictures, as articles do.

    Of runs of a camera: the scene in space, what both eyes see, and errors and rules over time, a film for each
    controller; ``--side-by-side`` puts those of a trial into one.

    Example: surgbench video runs --side-by-side --row cmaes --row hybrid --unit 000-left

    Example: surgbench video runs --side-by-side --row gaze --row autocam --unit 003 --out films
    """
    from surgbench.cli.progress import progress
    from surgbench.errors import ConfigError
    from surgbench.locks import sole_writer
    from surgbench.records.reader import only_task, read_records
    from surgbench.report.encoders import codec_note
    from surgbench.report.video_options import VideoOptions

    if overlay and side_by_side:
        raise ConfigError("--overlay and --side-by-side: all trackers in one panel, or one each; give one of the two")
    options = VideoOptions(tuple(unit or ()), tuple(row or ()), frames, samples, overlay, side_by_side, fps, every)
    records = read_records(directories)
    task = only_task(records, directories[0])
    note = codec_note()
    if note is not None:
        print(note, file=sys.stderr)
    folder = out or directories[0] / "video"
    with sole_writer(folder, "video"):
        for path in task.draw(records, options, dataset, folder, progress):
            print(path)
