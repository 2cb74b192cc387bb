"""Pictures of moments, and films of the time around them, as they stand in the page itself."""

from __future__ import annotations

import base64
import tempfile
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import cv2

from surgbench.dataset.open import open_dataset
from surgbench.errors import DatasetError, SurgbenchError
from surgbench.records.format import Record
from surgbench.report.drawing import Picture
from surgbench.report.encoders import browsers_play
from surgbench.report.filmed import Filmed
from surgbench.report.movie import write_video
from surgbench.report.page.content import Filmstrip, Gallery, clipped
from surgbench.report.page.moments import Choice, Drawing, described, row_name
from surgbench.task import find_task

AROUND_S = 1.0  # that a film shows before and after its moment
AROUND_BYTES = 1000  # that the page has beside a picture: its caption, its place
QUALITY = 80  # of WebP
NO_FILMS = (
    "There are no films: this page was made without an encoder for what browsers play, H.264 or VP9 "
    "(pip install 'surgbench[video]')."
)
FULL = "Some pictures or films are left out: the page would be larger than {} MB."

Progress = Callable[[str, float], Any]


class Still(NamedTuple):
    """A picture as a ``data:`` URI, its width and height."""

    data: str
    size: tuple[int, int]


class Pictures:
    """Draws moments until there is no more room for them.

    Args:
        room: Bytes that all of them may take on the page.
        known: Hashes of the datasets that there are runs on.
        moved: Where the dataset of some of the runs is now.
        tell: Takes each problem in one line, for whoever makes the page.

    Raises:
        DatasetError: There is no dataset where it is said to be, or none that any of them was made on.

    Attributes:
        problems: Why some runs have no pictures, one line each.
        full: Something was left out.
    """

    def __init__(
        self,
        room: int,
        known: Collection[str],
        moved: Path | None = None,
        tell: Callable[[str], None] = lambda problem: None,
    ) -> None:
        self.problems: list[str] = []
        self.full = False
        self._room = room
        self._moved = moved
        self._tell = tell
        self._moved_hash = None if moved is None else open_dataset(moved).hash
        if self._moved_hash is not None and self._moved_hash not in known:
            raise DatasetError(f"{moved}: not the dataset of any of these runs (its hash differs)")
        self._missing: set[str] = set()

    def draw(self, drawings: Sequence[Drawing], progress: Progress) -> list[Gallery]:
        """Draw stills of all, then films as far as there is room."""
        stills: dict[str, Still] = {}
        clips: dict[str, str] = {}
        legends: dict[int, str] = {}
        films = browsers_play()
        total = sum(len(one.choices) for one in drawings) * (2 if films else 1)
        if not total:
            return []
        with progress("pictures drawn", total) as advance:
            runs: list[tuple[Drawing, Filmed]] = []
            for number, drawing in enumerate(drawings):
                filmed = self._filmed(drawing.record)
                if filmed is None:
                    advance(len(drawing.choices) * (2 if films else 1))
                    continue
                runs.append((drawing, filmed))
                legends[number] = filmed.legend
                for choice in drawing.choices:
                    picture = self._still(filmed, drawing, choice)
                    data = None if picture is None else self._kept(_webp(picture))
                    if picture is not None and data is not None:
                        stills[drawing.anchor(choice)] = Still(data, (picture.shape[1], picture.shape[0]))
                    advance(1)
            for drawing, filmed in runs if films else ():
                for choice in drawing.choices:
                    if drawing.anchor(choice) in stills and not self.full:
                        clip = self._kept(self._clip(filmed, drawing, choice))
                        if clip is not None:
                            clips[drawing.anchor(choice)] = clip
                    advance(1)
        return _galleries(drawings, stills, clips, legends)

    def _filmed(self, record: Record) -> Filmed | None:
        dataset = record.spec.dataset
        if dataset.sha256 in self._missing:
            return None
        task = find_task(record.spec.task)
        try:
            return task.filmed(record, self._moved if dataset.sha256 == self._moved_hash else None)
        except DatasetError as error:
            self._missing.add(dataset.sha256)
            self._tell(f"no pictures: {error}")
            self.problems.append(
                f"Dataset '{clipped(dataset.name)}' is not where it was when the runs were made, or has changed: "
                "there are no pictures of them (surgbench report … --dataset PATH)."
            )
        except SurgbenchError as error:
            self._say(str(error), record)
        return None

    def _still(self, filmed: Filmed, drawing: Drawing, choice: Choice) -> Picture | None:
        try:
            frame = drawing.record.frames.index[choice.place]
            return filmed.picture(frame) if 0 <= frame < filmed.frames else None
        except SurgbenchError as error:
            self._say(f"{drawing.record.spec.row_id}, {drawing.unit}: {error}", drawing.record)
            return None

    def _clip(self, filmed: Filmed, drawing: Drawing, choice: Choice) -> bytes | None:
        frame = drawing.record.frames.index[choice.place]
        around = max(1, round(AROUND_S / filmed.dt_s / filmed.every)) * filmed.every
        frames = [one for one in range(frame - around, frame + around + 1, filmed.every) if 0 <= one < filmed.frames]
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "clip.mp4"
            try:
                write_video(path, _pictures(filmed, frames), 1.0 / (filmed.every * filmed.dt_s))
            except SurgbenchError as error:
                self._say(f"{drawing.record.spec.row_id}, {drawing.unit}: {error}", drawing.record)
                return None
            return path.read_bytes()

    def _kept(self, data: bytes | None) -> str | None:
        """As a ``data:`` URI, where there is room for it."""
        if data is None:
            return None
        kind = "image/webp" if data[:4] == b"RIFF" else "video/mp4"
        text = f"data:{kind};base64,{base64.b64encode(data).decode()}"
        needed = len(text) + AROUND_BYTES
        if needed > self._room:
            self.full = True
            return None
        self._room -= needed
        return text

    def _say(self, problem: str, record: Record) -> None:
        """To the user, and on the page without where files lie: that is nobody's business whom it is sent to."""
        written = problem
        for place in filter(None, (record.dataset_path, self._moved)):
            written = written.replace(str(place), f"dataset '{record.spec.dataset.name}'")
        written = clipped(written)
        if written not in self.problems:
            self.problems.append(written)
            self._tell(problem)


def _pictures(filmed: Filmed, frames: Sequence[int]) -> Iterator[Picture]:
    for frame in frames:
        yield filmed.picture(frame)


def _webp(picture: Picture) -> bytes:
    done, data = cv2.imencode(".webp", picture[..., ::-1], [cv2.IMWRITE_WEBP_QUALITY, QUALITY])
    if not done:
        raise SurgbenchError("pictures cannot be encoded: OpenCV has no WebP encoder")
    return data.tobytes()


def _galleries(
    drawings: Sequence[Drawing], stills: dict[str, Still], clips: dict[str, str], legends: dict[int, str]
) -> list[Gallery]:
    """What was drawn, table by table, unit by unit."""
    strips: dict[int, list[Filmstrip]] = {}
    titles: dict[int, str] = {}
    for number, drawing in enumerate(drawings):
        moments = [
            replace(described(drawing, choice), still=still.data, size=still.size, clip=clips.get(anchor))
            for choice in drawing.choices
            if (still := stills.get(anchor := drawing.anchor(choice))) is not None
        ]
        if moments:
            group = drawing.curves.group
            titles[group.number] = group.title
            row = row_name(drawing.curves, drawing.row)
            strips.setdefault(group.number, []).append(
                Filmstrip(row, clipped(drawing.unit), legends[number], tuple(moments))
            )
    return [Gallery(titles[number], tuple(own)) for number, own in strips.items()]
